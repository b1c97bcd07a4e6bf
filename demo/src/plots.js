// Plots of the last 30 s on a canvas.

const SECONDS = 30;
const MARGIN = { left: 30, right: 4, top: 4, bottom: 4 };

/** Lines over time; several values per sample. */
export class Plot {
  /**
   * @param {HTMLCanvasElement} canvas
   * @param {string[]} colors CSS variables, one per line
   * @param {{signed: boolean, least: number, limit?: number}} scale whether values may be below 0;
   *   the least range; a value to mark
   */
  constructor(canvas, colors, scale) {
    this.canvas = canvas;
    this.colors = colors;
    this.scale = scale;
    /** @type {[number, number[]][]} times, s, and values */
    this.samples = [];
  }

  clear() {
    this.samples = [];
  }

  /** @param {number} time @param {number[]} values */
  add(time, values) {
    this.samples.push([time, values]);
    while (this.samples[0][0] < time - SECONDS) {
      this.samples.shift();
    }
  }

  draw() {
    const ratio = Math.min(devicePixelRatio, 2);
    const width = this.canvas.clientWidth;
    const height = this.canvas.clientHeight;
    if (this.canvas.width !== Math.round(width * ratio) || this.canvas.height !== Math.round(height * ratio)) {
      this.canvas.width = Math.round(width * ratio);
      this.canvas.height = Math.round(height * ratio);
    }
    const context = this.canvas.getContext("2d");
    if (!context) {
      return;
    }
    const style = getComputedStyle(this.canvas);
    const color = (/** @type {string} */ name) => style.getPropertyValue(name);
    context.setTransform(ratio, 0, 0, ratio, 0, 0);
    context.clearRect(0, 0, width, height);
    const greatest = Math.max(...this.samples.flatMap(([, values]) => values.map(Math.abs)), this.scale.least);
    const range = [0.5, 1, 2, 4, 8, 16, 32, 64, 128, 180].find((x) => x >= greatest) ?? 180;
    const low = this.scale.signed ? -range : 0;
    const top = MARGIN.top;
    const bottom = height - MARGIN.bottom;
    const y = (/** @type {number} */ value) => bottom + ((value - low) / (range - low)) * (top - bottom);
    const now = this.samples.length ? this.samples[this.samples.length - 1][0] : 0;
    const first = MARGIN.left;
    const last = width - MARGIN.right;
    const x = (/** @type {number} */ time) => last + ((time - now) / SECONDS) * (last - first);
    context.font = "11px system-ui, sans-serif";
    context.textAlign = "right";
    context.lineWidth = 1;
    for (const value of [low, (low + range) / 2, range]) {
      const place = Math.round(y(value)) + 0.5;
      line(context, color("--line"), [[first, place], [last, place]]);
      context.fillStyle = color("--quiet");
      context.textBaseline = value === range ? "top" : value === low ? "bottom" : "middle";
      context.fillText(String(value), first - 6, place);
    }
    const { limit } = this.scale;
    if (limit !== undefined && limit <= range) {
      context.setLineDash([4, 4]);
      line(context, color("--bad"), [[first, y(limit)], [last, y(limit)]]);
      context.setLineDash([]);
    }
    context.lineWidth = 1.5;
    context.lineJoin = "round";
    this.colors.forEach((name, k) => {
      line(context, color(name), this.samples.map(([time, values]) => [x(time), y(values[k])]));
    });
  }
}

/**
 * @param {CanvasRenderingContext2D} context
 * @param {string} color
 * @param {number[][]} points
 */
function line(context, color, points) {
  context.strokeStyle = color;
  context.beginPath();
  points.forEach(([x, y], k) => (k ? context.lineTo(x, y) : context.moveTo(x, y)));
  context.stroke();
}
