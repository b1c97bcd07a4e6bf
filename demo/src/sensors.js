// Sensors as they are on a robot: noisy, biased, turned, old, lost (mjx_balance/task/sensors.py).
// What differs from robot to robot comes with the scenario; what differs from sample to sample is
// drawn here, so that it is another noise than Python's, of the same size.

const IMU = 6;

/** The sensors of one scenario. */
export class Sensors {
  /**
   * @param {any} task of the robot's data
   * @param {any} scenario of a suite
   * @param {number} seed
   */
  constructor(task, scenario, seed) {
    this.task = task;
    this.noise = scenario.noise;
    this.errors = scenario.errors;
    this.noisy = this.errors || this.noise?.some((/** @type {number} */ x) => x > 0);
    this.random = generator(seed);
    this.drift = new Array(IMU).fill(0);
    /** Samples, none old or lost, the newest last. @type {number[][]} */
    this.trail = [];
    this.late = [0, 0];
    this.last = new Array(IMU).fill(0);
  }

  /** The first sample, without noise. @param {number[]} true_ */
  start(true_) {
    this.last = this.errors ? this.measured(true_) : true_;
    this.trail = [this.last];
    return this.last;
  }

  /** Draws what holds for a decision. */
  beginDecision() {
    if (this.errors) {
      const { delay, jitter } = this.errors;
      this.late = delay.map((/** @type {number} */ x, /** @type {number} */ k) =>
        Math.round((x + jitter[k] * this.random()) / this.task.sim_dt),
      );
    }
  }

  /** Lets the bias drift. */
  endDecision() {
    if (this.errors) {
      const scale = Math.sqrt(this.task.sim_dt * this.task.sim_steps);
      this.drift = this.drift.map((x, k) => x + this.errors.drift[k] * scale * this.normal());
    }
  }

  /** Physics steps by which commands come later in this decision. */
  get lateCommands() {
    return this.late[1];
  }

  /** What the robot gets of a true sample. @param {number[]} true_ @returns {number[]} */
  sense(true_) {
    if (!this.noisy) {
      return true_;
    }
    const clean = this.errors ? this.measured(true_) : true_;
    const sample = clean.map((x, k) => x + this.noise[k] * this.normal());
    if (this.errors) {
      this.trail = [...this.trail, sample].slice(-2 * this.task.sim_steps);
      if (this.random() >= this.errors.dropout[0]) {
        this.last = this.trail[Math.max(this.trail.length - 1 - this.late[0], 0)];
      }
      return this.last;
    }
    return sample;
  }

  /** What the IMU measures, without noise. @param {number[]} imu */
  measured(imu) {
    const { mounting, scale, bias } = this.errors;
    const turned = [...turn(imu.slice(0, 3), mounting), ...turn(imu.slice(3), mounting)];
    return turned.map((x, k) => x * (1 + scale[k]) + bias[k] + this.drift[k]);
  }

  /** A standard normal number (Box and Muller). */
  normal() {
    return Math.sqrt(-2 * Math.log(1 - this.random())) * Math.cos(2 * Math.PI * this.random());
  }
}

/** A vector in a frame that is turned by a rotation vector (Rodrigues). @param {number[]} x @param {number[]} by */
function turn(x, by) {
  const back = by.map((value) => -value);
  const angle = Math.hypot(back[0], back[1], back[2]);
  if (angle === 0) {
    return x;
  }
  const once = cross(back, x);
  const twice = cross(back, once);
  const half = Math.sin(angle / 2) / (angle / 2);
  return x.map((value, k) => value + (Math.sin(angle) / angle) * once[k] + ((half * half) / 2) * twice[k]);
}

/** @param {number[]} a @param {number[]} b */
function cross(a, b) {
  return [a[1] * b[2] - a[2] * b[1], a[2] * b[0] - a[0] * b[2], a[0] * b[1] - a[1] * b[0]];
}

/** Uniform numbers in [0, 1), the same ones for a seed: xorshift32. @param {number} seed */
export function generator(seed) {
  let state = (seed * 2654435761 + 1013904223) >>> 0 || 1;
  const next = () => {
    state ^= state << 13;
    state ^= state >>> 17;
    state ^= state << 5;
    state >>>= 0;
    return state / 2 ** 32;
  };
  for (let k = 0; k < 8; k++) {
    next();
  }
  return next;
}
