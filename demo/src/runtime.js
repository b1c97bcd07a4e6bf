// Runs a policy sample by sample: mjx_balance/runtime.py in JavaScript, without gains and standing
// up, and without the checks of a clock, because the page's clock is the simulation's. It knows no
// config: it interprets the rows `inputs` of the manifest. Sums are in double, as there.

import { PolicyError } from "./policy.js";

export const STANDING = "standing";
export const BALANCING = "balancing";
export const HOLDING = "holding";

// Limits of mjx_balance/runtime.py, under the same names; tests compare the numbers.
export const LIMITS = {
  STANDING_S: 1.0,
  GYRO_MOST: 35.0,
  ACCEL_MOST: 160.0,
  WEIGHT: [0.5 * 9.81, 1.5 * 9.81],
  LEAN_MOST: 40.0,
  AWAY_MOST: 0.5,
  KNEE_SLACK: 0.1,
  STUCK_MOST: 0.1,
  RECENT: [10, 50],
  LIVELY: 1 / 3,
  LIVELY_SENSOR: 1 / 5,
  MOVED_LEAST: 0.003,
};
const IMU = 6; // gyro x, y and z, accelerometer x, y and z
const DEGREES = 180 / Math.PI;

/** A fault; the message is the reason. */
class Unsafe extends Error {}

/** A controller; decides at the first sample and then every `decisionSamples` samples. */
export class Controller {
  state = STANDING;
  reason = "";
  /** Index of the last action, or of the nearest on the grid. @type {number | null} */
  action = null;
  /** Its height changes a_x and a_y, m. @type {number[] | null} */
  command = null;
  /** Joint targets until the next sample, (3 legs,), rad. @type {Float64Array} */
  targets = new Float64Array(0);
  /** Those of the present decision's ramp. @type {Float64Array[]} */
  path = [];
  /** Samples since the last decision, since the first, and decisions in a row after a gap. */
  since = 0;
  seen = 0;
  gaps = 0;
  /** Joints at the decisions of the time that is checked for repetitions. @type {Float64Array[]} */
  poses = [];
  /** Targets at which each joint's reading changed last. @type {Float64Array} */
  there = new Float64Array(0);

  /**
   * @param {import("./policy.js").Policy} policy
   * @throws {PolicyError} if it is none that this file can run
   */
  constructor({ manifest, weights }) {
    const { timing, robot } = manifest;
    this.legs = new Legs(robot);
    this.joints = robot.legs.flatMap((/** @type {any} */ leg) => leg.joints);
    this.sampleDt = timing.sample_s;
    this.decisionSamples = timing.decision_samples;
    this.rampSamples = timing.ramp_samples;
    const fall = manifest.fail_tilt_deg / DEGREES;
    this.rateMost = (2 * fall) / (this.decisionSamples * this.sampleDt);
    this.height = manifest.body_height_m;
    this.table = manifest.actions.table_m;
    this.continuous = manifest.action === "continuous";
    const count = robot.legs.length;
    this.inputs = new Inputs(manifest.inputs, count, this.sampleDt);
    this.recent = Math.min(Math.max(this.decisionSamples, LIMITS.RECENT[0]), LIMITS.RECENT[1]);
    this.history = Math.max(this.inputs.ages.gyro, this.inputs.ages.accelerometer, this.recent);
    this.mostPoses = Math.ceil(this.recent / this.decisionSamples);
    // The history up to the last decision, then the samples since: rows of six.
    this.imu = new Float64Array((this.history + this.decisionSamples) * IMU);
    this.commands = new Float64Array(this.inputs.ages.command * count);
    this.network = new Network(manifest.network, this.inputs.size, weights);
    const { factors } = this.network;
    if (this.table.length !== factors.reduce((a, b) => a * b, 1)) {
      throw new PolicyError("its action table is not what its network chooses from");
    }
    const ends = [0, 1].map((axis) => {
      const values = this.table.map((/** @type {number[]} */ row) => row[axis]);
      return [Math.min(...values), Math.max(...values)];
    });
    this.middle = ends.map(([low, high]) => Math.fround((low + high) / 2));
    this.half = ends.map(([low, high]) => Math.fround((high - low) / 2));
    const imuMost = [0, 1, 2].map(() => LIMITS.GYRO_MOST).concat([0, 1, 2].map(() => LIMITS.ACCEL_MOST));
    const [low, high] = this.legs.limits();
    this.least = [...low, ...imuMost.map((x) => -x)];
    this.most = [...high, ...imuMost];
    this.reading = new Float64Array(this.least.length);
    this.reset();
  }

  /** Starts again, standing: the robot must stand still at its standing height. */
  reset() {
    this.state = STANDING;
    this.reason = "";
    this.action = null;
    this.command = null;
    this.commands.fill(this.height);
    const standing = this.legs.jointAngles(this.commands.slice(-this.legs.count));
    this.path = [standing];
    this.targets = standing;
    this.since = 0;
    this.seen = 0;
    this.gaps = 0;
    this.poses = [];
    this.there = standing;
  }

  /** Keeps the targets until `reset`. @param {string} reason */
  hold(reason) {
    if (this.state !== HOLDING) {
      this.state = HOLDING;
      this.reason = reason;
    }
  }

  /**
   * Processes a sample of the sensors.
   * @param {ArrayLike<number>} joints (3 legs,) rad
   * @param {ArrayLike<number>} imu gyro, rad/s, and accelerometer, m/s^2
   * @returns {Float64Array} joint targets (3 legs,), rad
   */
  step(joints, imu) {
    if (this.state !== HOLDING) {
      this.reading.set(joints);
      this.reading.set(imu, this.joints.length);
      try {
        this.checkReading();
        this.advance();
      } catch (error) {
        if (!(error instanceof Unsafe)) {
          throw error;
        }
        this.hold(error.message);
      }
    }
    return this.targets;
  }

  advance() {
    const sample = this.reading.subarray(this.joints.length);
    if (this.state === STANDING) {
      this.fill(sample);
      this.checkPosture();
      this.state = BALANCING;
      this.decide();
    } else {
      this.seen += 1;
      this.imu.set(sample, (this.history + this.since) * IMU);
      this.inputs.means.add(sample);
      this.since += 1;
      if (this.since === this.decisionSamples) {
        this.checkLiveness();
        this.checkPosture();
        this.decide();
      }
    }
    this.targets = this.path[Math.min(this.since, this.path.length - 1)];
  }

  /** Fills the histories with a sample of a robot that is still. @param {Float64Array} sample */
  fill(sample) {
    for (let k = 0; k < this.imu.length; k += IMU) {
      this.imu.set(sample, k);
    }
    this.inputs.means.start(sample);
    this.poses = [this.reading.slice(0, this.joints.length)];
    this.there = this.targets;
    this.seen = 1;
    this.gaps = 0;
  }

  /** Chooses an action, and computes its ramp of targets. */
  decide() {
    const { count } = this.legs;
    const { index, point } = this.network.greedy(
      this.inputs.observe({
        height: this.legs.footHeights(this.reading),
        command: this.commands,
        imu: this.imu,
      }),
    );
    this.action = index;
    this.command = this.table[index];
    if (this.continuous) {
      this.command = point.map((x, k) => Math.fround(this.middle[k] + Math.fround(this.half[k] * x)));
    }
    const before = this.commands.slice(-count);
    const after = this.legs.moved(before, /** @type {number[]} */ (this.command));
    this.commands.copyWithin(0, count);
    this.commands.set(after, this.commands.length - count);
    this.path = Array.from({ length: this.rampSamples }, (_, k) => {
      const share = (k + 1) / this.rampSamples;
      return this.legs.jointAngles(before.map((x, leg) => x * (1 - share) + after[leg] * share));
    });
    this.imu.copyWithin(0, this.decisionSamples * IMU);
    this.since = 0;
  }

  checkReading() {
    for (let k = 0; k < this.reading.length; k++) {
      const value = this.reading[k];
      if (!(this.least[k] <= value && value <= this.most[k])) {
        throw new Unsafe(
          `${this.name(k)} reads ${short(value)}, which is not between ${short(this.least[k])} ` +
            `and ${short(this.most[k])}`,
        );
      }
    }
  }

  /** Name of a reading. @param {number} k */
  name(k) {
    const imu = k - this.joints.length;
    return imu < 0 ? this.joints[k] : `${imu < 3 ? "gyro" : "accelerometer"} ${"xyz"[imu % 3]}`;
  }

  /** Checks that the IMU's samples differ, and that joints move if their targets do. */
  checkLiveness() {
    const rows = rowsOf(this.imu).slice(-this.recent);
    this.checkNew("IMU", new Set(rows.map((x) => x.join())).size, rows.length, LIMITS.LIVELY);
    this.checkLatest(rows);
    const joints = this.reading.slice(0, this.joints.length);
    const first = this.poses[0];
    const last = this.poses[this.poses.length - 1];
    if (joints.some((x, k) => Math.abs(x - first[k]) > LIMITS.MOVED_LEAST)) {
      const since = rowsOf(this.imu).slice(-Math.max(this.recent, this.decisionSamples));
      for (const [name, start] of /** @type {[string, number][]} */ ([["gyro", 0], ["accelerometer", 3]])) {
        const fresh = 1 + changed(since, start, start + 3).filter(Boolean).length;
        this.checkNew(name, fresh, since.length, LIMITS.LIVELY_SENSOR);
      }
    }
    this.there = this.there.map((x, k) => (joints[k] !== last[k] ? this.targets[k] : x));
    this.poses = [...this.poses, joints].slice(-this.mostPoses);
    const moved = this.targets.map((x, k) => Math.abs(x - this.there[k]));
    const k = greatest(moved);
    if (moved[k] > LIMITS.STUCK_MOST) {
      throw new Unsafe(
        `${this.name(k)} reads ${short(joints[k])} all the time, while its target moved by ` +
          `${short(moved[k], 2)} rad`,
      );
    }
  }

  /** Checks that the newest samples are no gap in bursts. @param {Float64Array[]} rows */
  checkLatest(rows) {
    const fresh = changed(rows, 0, IMU);
    const count = Math.floor(fresh.length / 3);
    const latest = fresh.slice(-count).filter(Boolean).length;
    const least = Math.floor(count * LIMITS.LIVELY);
    this.gaps = latest < least && this.decisionSamples >= this.recent ? this.gaps + 1 : 0;
    if (this.gaps === 2) {
      throw new Unsafe(
        `the IMU repeats itself: at two decisions, one after the other, ${latest} of its last ` +
          `${count} samples are new; at least ${least} must be`,
      );
    }
  }

  /**
   * Checks that enough of a sensor's last `count` samples are new.
   * @param {string} name
   * @param {number} fresh
   * @param {number} count
   * @param {number} share
   */
  checkNew(name, fresh, count, share) {
    const least = Math.max(2, roundEven(share * this.recent));
    if (fresh < least && this.seen >= count) {
      throw new Unsafe(
        `the ${name} repeats itself: ${fresh} of its last ${count} samples are new; at least ` +
          `${least} must be`,
      );
    }
  }

  /** Checks the mean of a decision's IMU samples, and the joints, for a balancing robot. */
  checkPosture() {
    const rows = rowsOf(this.imu).slice(this.history);
    const mean = rows[0].map((_, k) => rows.reduce((sum, row) => sum + row[k], 0) / rows.length);
    const weight = Math.hypot(mean[3], mean[4], mean[5]);
    if (!(LIMITS.WEIGHT[0] <= weight && weight <= LIMITS.WEIGHT[1])) {
      throw new Unsafe(
        `the accelerometer gives ${short(weight)} m/s^2 in the mean of a decision; it must be ` +
          `${short(LIMITS.WEIGHT[0])} to ${short(LIMITS.WEIGHT[1])}, and 9.81 at rest`,
      );
    }
    const lean = Math.acos(clip(mean[5] / Math.max(weight, 1e-9), -1, 1)) * DEGREES;
    if (lean > LIMITS.LEAN_MOST) {
      throw new Unsafe(
        `the accelerometer leans by ${short(lean)} deg in the mean of a decision, more than ` +
          `${LIMITS.LEAN_MOST}: the robot has fallen, or up is not its z`,
      );
    }
    const rate = Math.hypot(mean[0], mean[1]);
    if (rate > this.rateMost) {
      throw new Unsafe(
        `the gyro gives ${short(rate)} rad/s about x and y in the mean of a decision, more than ` +
          `${short(this.rateMost)}: the robot falls, or these are no rad/s`,
      );
    }
    const errors = this.targets.map((x, k) => Math.abs(this.reading[k] - x));
    const k = greatest(errors);
    if (errors[k] > LIMITS.AWAY_MOST) {
      throw new Unsafe(
        `${this.name(k)} is ${short(errors[k])} rad from its target, more than ${LIMITS.AWAY_MOST}`,
      );
    }
  }
}

/** The network's inputs: (mean of `window` samples from `lag` on - offset) / scale. */
class Inputs {
  /**
   * @param {any[]} rows
   * @param {number} legs
   * @param {number} sampleDt
   */
  constructor(rows, legs, sampleDt) {
    this.rows = rows;
    this.size = rows.length;
    this.legs = legs;
    /** Samples that the inputs need, the newest included. @type {Record<string, number>} */
    this.ages = { height: 1, command: 1, gyro: 1, accelerometer: 1 };
    for (const row of rows.filter((x) => x.time_constant == null)) {
      if (!(row.sensor in this.ages)) {
        throw new PolicyError(
          `its inputs have the sensor ${row.sensor}; this page knows ${Object.keys(this.ages).join(", ")}`,
        );
      }
      this.ages[row.sensor] = Math.max(this.ages[row.sensor], row.lag + row.window);
    }
    this.means = new Means(rows.filter((x) => x.time_constant != null), sampleDt);
  }

  /**
   * @param {{height: Float64Array, command: Float64Array, imu: Float64Array}} samples rows of
   *   (legs,), (legs,) and (6,), the newest last
   * @returns {Float32Array}
   */
  observe({ height, command, imu }) {
    /** @type {Record<string, [Float64Array, number, number]>} samples, columns, first column */
    const sources = {
      height: [height, this.legs, 0],
      command: [command, this.legs, 0],
      gyro: [imu, IMU, 0],
      accelerometer: [imu, IMU, 3],
    };
    let slow = 0;
    return Float32Array.from(this.rows, (row) => {
      let value = 0;
      if (row.time_constant != null) {
        value = this.means.value(slow++);
      } else {
        const [samples, columns, first] = sources[row.sensor];
        const newest = samples.length - columns * (row.lag + 1) + first + row.index;
        for (let k = 0; k < row.window; k++) {
          value += samples[newest - columns * k];
        }
        value /= row.window;
      }
      return (value - row.offset) / row.scale;
    });
  }
}

/** Leaky means of gyro and accelerometer, and the angles of complementary filters. */
class Means {
  /**
   * @param {any[]} rows
   * @param {number} sampleDt
   */
  constructor(rows, sampleDt) {
    /** @type {Record<string, number>} */
    const first = { gyro: 0, accelerometer: 3, angle: IMU };
    this.rows = rows.map((row) => {
      if (!(row.sensor in first)) {
        throw new PolicyError(
          `its inputs have a mean of the sensor ${row.sensor}; this page knows means of ` +
            Object.keys(first).join(", "),
        );
      }
      const tau = row.time_constant;
      const leak = sampleDt / (tau + sampleDt);
      const start = 1 - (1 - leak) ** Math.round(LIMITS.STANDING_S / sampleDt);
      const angle = row.sensor === "angle";
      const place = first[row.sensor] + row.index;
      return { place, angle, index: row.index, tau, leak, start: angle ? 1 : start };
    });
    this.sum = new Float64Array(rows.length);
    this.weight = new Float64Array(rows.length);
  }

  /** Takes the first sample, of a robot that has been standing still. @param {Float64Array} imu */
  start(imu) {
    const samples = this.samples(imu);
    this.rows.forEach((row, k) => {
      this.weight[k] = row.start;
      this.sum[k] = row.start * samples[k];
    });
  }

  /** @param {Float64Array} imu */
  add(imu) {
    if (this.rows.length) {
      const samples = this.samples(imu);
      this.rows.forEach(({ leak }, k) => {
        this.sum[k] += leak * (samples[k] - this.sum[k]);
        this.weight[k] += leak * (1 - this.weight[k]);
      });
    }
  }

  /** @param {number} k */
  value(k) {
    return this.sum[k] / this.weight[k];
  }

  /** @param {Float64Array} imu */
  samples(imu) {
    const [x, y, z] = imu.subarray(3);
    const all = [...imu, Math.atan2(y, z), Math.atan2(-x, Math.hypot(y, z))];
    return this.rows.map((row) => all[row.place] + (row.angle ? row.tau * imu[row.index] : 0));
  }
}

/** Leg kinematics: foot heights to joint angles and back. */
export class Legs {
  /** @param {any} robot */
  constructor(robot) {
    this.count = robot.legs.length;
    const radius = robot.foot_radius;
    this.each = robot.legs.map((/** @type {any} */ leg) => ({
      a: leg.thigh,
      b: leg.calf,
      drop: leg.drop,
      offset: leg.offset,
      signs: leg.signs,
      zeros: leg.zeros,
      knee: leg.knee,
      bend: Math.sign(leg.knee[0] + leg.knee[1]),
      rise: radius + leg.drop - leg.axis_height,
      lift: radius - leg.axis_height,
      sides: [leg.left ? 1 : -1, leg.front ? 1 : -1],
    }));
    const reach = this.each.map((/** @type {any} */ { a, b, rise, knee }) =>
      knee.map((/** @type {number} */ angle) =>
        Math.sqrt(Math.max(a * a + b * b + 2 * (a * b) * Math.cos(angle), 0)) + rise,
      ),
    );
    /** Least and greatest body height that all legs reach, m. */
    this.heightRange = [
      Math.max(...reach.map((/** @type {number[]} */ x) => Math.min(...x))),
      Math.min(...reach.map((/** @type {number[]} */ x) => Math.max(...x))),
    ];
  }

  /** Least and greatest possible readings of all joints, rad. @returns {[number[], number[]]} */
  limits() {
    const ends = this.each.flatMap((/** @type {any} */ { signs, zeros, knee }) => {
      const whole = [-Math.PI, Math.PI];
      const turns = [whole, whole, [knee[0] - LIMITS.KNEE_SLACK, knee[1] + LIMITS.KNEE_SLACK]];
      return turns.map((turn, k) => turn.map((x) => signs[k] * (x - zeros[k])));
    });
    return [
      ends.map((/** @type {number[]} */ x) => Math.min(...x)),
      ends.map((/** @type {number[]} */ x) => Math.max(...x)),
    ];
  }

  /**
   * Foot heights after an action: left legs +a_x, front legs +a_y, m.
   * @param {Float64Array} heights
   * @param {number[]} change
   */
  moved(heights, change) {
    const [low, high] = this.heightRange;
    return heights.map((x, k) => {
      const { sides } = this.each[k];
      return clip(x + change[0] * sides[0] + change[1] * sides[1], low, high);
    });
  }

  /** Joint angles (3 legs,), rad, for foot heights (legs,), m. @param {Float64Array} heights */
  jointAngles(heights) {
    const angles = new Float64Array(3 * this.count);
    this.each.forEach((/** @type {any} */ { a, b, rise, bend, signs, zeros }, /** @type {number} */ leg) => {
      const cosine = ((heights[leg] - rise) ** 2 - a ** 2 - b ** 2) / (2 * a * b);
      const knee = bend * Math.acos(clip(cosine, -1, 1));
      const thigh = -Math.atan2(b * Math.sin(knee), a + b * Math.cos(knee));
      [0, thigh, knee].forEach((x, k) => {
        angles[3 * leg + k] = signs[k] * (x - zeros[k]);
      });
    });
    return angles;
  }

  /** (legs,) m below the trunk's origin, for joint angles (3 legs, ...), rad. @param {Float64Array} angles */
  footHeights(angles) {
    return Float64Array.from(this.each, (/** @type {any} */ { a, b, drop, offset, lift, signs, zeros }, leg) => {
      const [abduction, thigh, knee] = [0, 1, 2].map((k) => signs[k] * angles[3 * leg + k] + zeros[k]);
      const length = a * Math.cos(thigh) + b * Math.cos(thigh + knee);
      return (length + drop) * Math.cos(abduction) - offset * Math.sin(abduction) + lift;
    });
  }
}

/** The Q-network; it computes the best action only. */
class Network {
  /**
   * @param {any} network of the manifest
   * @param {number} inputs
   * @param {Map<string, import("./policy.js").Weight>} weights
   */
  constructor(network, inputs, weights) {
    this.factors = /** @type {number[]} */ (network.factors);
    this.radial = network.radial === true;
    const hidden = /** @type {number[]} */ (network.hidden_sizes);
    const rows = [inputs, ...hidden];
    const columns = [...hidden, this.factors.reduce((a, b) => a + b, 0)];
    if (this.radial) {
      rows[hidden.length] += inputs;
      columns[hidden.length] = 1 + this.factors.length;
    }
    /** @type {{kernel: Float32Array, bias: Float32Array}[]} */
    this.layers = rows.map((n, k) => {
      const name = k < hidden.length ? `hidden_${k}` : "head";
      const kernel = weights.get(`${name}/kernel`);
      const bias = weights.get(`${name}/bias`);
      const fits = `${kernel?.shape} ${bias?.shape}` === `${n},${columns[k]} ${columns[k]}`;
      if (!kernel || !bias || !fits) {
        throw new PolicyError(`weight ${name} is missing or not of shape ${n} x ${columns[k]}`);
      }
      return { kernel: kernel.values, bias: bias.values };
    });
  }

  /**
   * Index of the best action, and a radial head's best point in the range of its levels.
   * @param {Float32Array} obs
   */
  greedy(obs) {
    let x = obs;
    for (const layer of this.layers.slice(0, -1)) {
      x = affine(layer, x).map((value) => Math.max(value, 0));
    }
    if (this.radial) {
      const joined = new Float32Array(x.length + obs.length);
      joined.set(x);
      joined.set(obs, x.length);
      x = joined;
    }
    const out = affine(this.layers[this.layers.length - 1], x);
    if (!out.every(Number.isFinite)) {
      throw new Unsafe("the network gives values that are not finite numbers");
    }
    let index = 0;
    let start = 0;
    this.factors.forEach((levels, k) => {
      const best = this.radial ? nearest(out[1 + k], levels) : greatest(out.subarray(start, start + levels));
      index = index * levels + best;
      start += levels;
    });
    const point = [...out.subarray(1, 1 + this.factors.length)].map((value) => clip(value, -1, 1));
    return { index, point };
  }
}

/**
 * @param {{kernel: Float32Array, bias: Float32Array}} layer
 * @param {Float32Array} x
 */
function affine({ kernel, bias }, x) {
  const sums = new Float64Array(bias.length);
  for (let i = 0, place = 0; i < x.length; i++) {
    for (let j = 0; j < sums.length; j++, place++) {
      sums[j] += x[i] * kernel[place];
    }
  }
  return Float32Array.from(sums, (sum, j) => sum + bias[j]);
}

/** The level nearest to a point from -1 to 1, in float32 as in Python. @param {number} point @param {number} levels */
function nearest(point, levels) {
  const share = Math.fround(clip(point, -1, 1) + 1);
  return roundEven(Math.fround(Math.fround(share * Math.fround(levels - 1)) / 2));
}

/** @param {number} x */
function roundEven(x) {
  const down = Math.floor(x);
  return x - down < 0.5 || (x - down === 0.5 && down % 2 === 0) ? down : down + 1;
}

/** Index of the greatest value, the first of equal ones. @param {ArrayLike<number>} values */
function greatest(values) {
  let best = 0;
  for (let k = 1; k < values.length; k++) {
    if (values[k] > values[best]) {
      best = k;
    }
  }
  return best;
}

/** @param {number} x @param {number} low @param {number} high */
export function clip(x, low, high) {
  return Math.min(Math.max(x, low), high);
}

/** Rows of six. @param {Float64Array} imu */
function rowsOf(imu) {
  return Array.from({ length: imu.length / IMU }, (_, k) => imu.subarray(k * IMU, (k + 1) * IMU));
}

/**
 * Whether columns of a row differ from those of the row before, for all rows but the first.
 * @param {Float64Array[]} rows
 * @param {number} start
 * @param {number} end
 */
function changed(rows, start, end) {
  return rows.slice(1).map((row, k) => {
    const before = rows[k];
    return row.subarray(start, end).some((x, column) => x !== before[start + column]);
  });
}

/** A number with few digits, as Python's `:.3g`. @param {number} x @param {number} digits */
function short(x, digits = 3) {
  return String(Number(x.toPrecision(digits))).toLowerCase(); // nan
}
