// Controllers to compare a policy with (mjx_balance/evaluation/controllers.py), with the interface
// of the runtime's.

import { BALANCING, clip, HOLDING, Legs, STANDING } from "./runtime.js";

const DEGREES = 180 / Math.PI;

/** Moves the legs by what `choose` says at every decision. */
class Baseline {
  state = STANDING;
  reason = "";
  number = 0;
  targets = new Float64Array(0);
  heights = new Float64Array(0);
  before = new Float64Array(0);

  /** @param {any} data of the robot */
  constructor(data) {
    this.legs = new Legs(data.robot);
    this.task = data.task;
    this.reset();
  }

  reset() {
    this.reason = "";
    this.state = STANDING;
    this.number = 0;
    this.heights = new Float64Array(this.legs.count).fill(this.task.body_height);
    this.before = this.heights;
    this.targets = this.legs.jointAngles(this.heights);
  }

  /** Keeps the targets until `reset`. @param {string} reason */
  hold(reason) {
    this.state = HOLDING;
    this.reason = reason;
  }

  /**
   * @param {ArrayLike<number>} _ joints, which no baseline looks at
   * @param {ArrayLike<number>} imu gyro, rad/s, and accelerometer, m/s^2
   */
  step(_, imu) {
    if (this.state === HOLDING) {
      return this.targets;
    }
    this.state = BALANCING;
    const { sim_steps, ramp_steps } = this.task;
    this.filter(imu, this.number === 0);
    const since = this.number % sim_steps;
    if (since === 0) {
      this.before = this.heights;
      this.heights = this.legs.moved(this.before, this.choose(imu));
    }
    if (since < ramp_steps) {
      const share = (since + 1) / ramp_steps;
      const way = this.before.map((x, leg) => x * (1 - share) + this.heights[leg] * share);
      this.targets = this.legs.jointAngles(way);
    }
    this.number += 1;
    return this.targets;
  }

  /**
   * Takes a sample.
   * @param {ArrayLike<number>} imu
   * @param {boolean} first
   */
  filter(imu, first) {}

  /** Height changes a_x and a_y, m. @param {ArrayLike<number>} imu @returns {number[]} */
  choose(imu) {
    return [0, 0];
  }
}

/** Never moves. */
export class Stand extends Baseline {}

/** `pd-imu`: proportional and derivative control on a complementary filter of the IMU. */
export class ImuPd extends Baseline {
  /** @param {any} data of the robot */
  constructor(data) {
    super(data);
    this.pd = data.pd;
    this.angle = [0, 0];
  }

  /** @param {ArrayLike<number>} imu @param {boolean} first */
  filter(imu, first) {
    const [, , , x, y, z] = Array.from(imu);
    const gravity = [Math.atan2(y, z), Math.atan2(-x, Math.hypot(y, z))];
    if (first) {
      this.angle = gravity;
    }
    const dt = this.task.sim_dt;
    const leak = dt / (this.pd.tau + dt);
    this.angle = this.angle.map((old, k) => (old + dt * imu[k]) * (1 - leak) + leak * gravity[k]);
  }

  /** @param {ArrayLike<number>} imu */
  choose(imu) {
    const { proportional, rate, gain, most, levels } = this.pd;
    return this.angle.map((angle, k) => {
      const change = (-(proportional * angle + rate * imu[k]) * DEGREES) / gain[k];
      const step = levels ? (2 * most) / (levels - 1) : 0;
      return clip(step ? Math.round((change + most) / step) * step - most : change, -most, most);
    });
  }
}
