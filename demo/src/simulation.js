// A robot on its board, physics step by physics step, as in examples/deploy.py.

import { boardTarget } from "./board.js";
import { clip, Legs } from "./runtime.js";
import { Sensors } from "./sensors.js";

const RADIANS = Math.PI / 180;
/** A scenario without a suite: the board goes where `aim` says. */
const NOTHING = {};

/**
 * @typedef {{state: string, reason: string, reset: () => void, hold: (reason: string) => void,
 *   step: (joints: ArrayLike<number>, imu: ArrayLike<number>) => Float64Array}} Balancer
 */

/** Physics, sensors, controller and board; after `reset`, `step` by `step`. */
export class Simulation {
  /** Number of physics steps since the start. */
  steps = 0;
  /** The body's, deg. */
  tilt = 0;
  /** Time of the fall, s. @type {number | null} */
  fellAt = null;
  /** Where `aim` leads, and where the board's servos are on the way, deg. */
  aim = [0, 0];
  way = [0, 0];
  /** Where a platform rests, m. @type {number[]} */
  platform = [];
  /** Physics steps from a command to the servos. */
  delay = 0;
  /** Targets that the servos have yet to obey, the newest last. @type {Float64Array[]} */
  targets = [];
  /** What the robot got last: gyro, rad/s, and accelerometer, m/s^2. @type {number[]} */
  imu = [];

  /**
   * @param {import("./physics.js").Physics} physics
   * @param {any} data of the robot
   * @param {Balancer} balancer
   */
  constructor(physics, data, balancer) {
    this.physics = physics;
    this.task = data.task;
    this.balancer = balancer;
    this.standing = new Legs(data.robot);
    /** @type {any} */
    this.scenario = NOTHING;
    this.sensors = new Sensors(this.task, NOTHING, 0);
    this.reset();
  }

  /**
   * Starts again.
   * @param {any} scenario of a suite; none: the level board, which `aim` moves
   * @param {number} seed of the sensors' noise
   */
  reset(scenario = NOTHING, seed = 0) {
    this.scenario = scenario;
    this.physics.reset(scenario.qpos);
    if (scenario.fields) {
      this.physics.randomize(scenario.fields);
    }
    this.balancer.reset();
    this.sensors = new Sensors(this.task, scenario, seed);
    this.imu = this.sensors.start(scenario.imu ?? this.physics.scene.imu);
    this.steps = 0;
    this.aim = this.way = [0, 0];
    this.platform = [];
    const { count } = this.standing;
    const heights = new Float64Array(count).fill(this.task.body_height);
    this.delay = this.task.command_delay + (scenario.delay ? this.task.sim_steps : 0);
    this.targets = Array(2 * this.task.sim_steps).fill(this.standing.jointAngles(heights));
    this.fellAt = null;
    this.tilt = this.physics.tilt;
  }

  /** Time since the start, s. */
  get time() {
    return this.steps * this.task.sim_dt;
  }

  /** A physics step; returns the body's tilt after it, deg. */
  step() {
    const { task, physics, sensors, scenario } = this;
    const number = Math.floor(this.steps / task.sim_steps);
    const begins = this.steps % task.sim_steps === 0;
    if (begins) {
      sensors.beginDecision();
    }
    const { encoders, readings } = scenario.errors ?? {};
    const joints = physics.joints;
    if (encoders) {
      joints.forEach((_, k) => {
        joints[k] += encoders[k] + readings[k];
      });
    }
    this.targets = [...this.targets.slice(1), this.balancer.step(joints, this.imu)];
    const late = this.targets[this.targets.length - 1 - this.delay - sensors.lateCommands];
    if (begins && scenario.event?.due === number) {
      physics.randomize(scenario.event.fields);
    }
    if (begins && scenario.pushes) {
      scenario.pushes.due.forEach((/** @type {number} */ due, /** @type {number} */ k) => {
        if (due === number) {
          physics.push(scenario.pushes.velocity[k]);
        }
      });
    }
    this.steps += 1;
    // The servos go by the encoders; a robot starts where it stands.
    const share = Math.min(this.steps / task.sim_steps, 1);
    const goal = encoders ? late.map((x, k) => x - share * encoders[k]) : late;
    physics.step(goal, this.boardTarget());
    this.imu = sensors.sense(physics.imu);
    if (this.steps % task.sim_steps === 0) {
      sensors.endDecision();
    }
    this.tilt = physics.tilt;
    if (this.fellAt === null && !(this.tilt <= task.fail_tilt)) {
      this.fellAt = this.time;
    }
    return this.tilt;
  }

  /** Leaves the board where it is, for `aim` to move it; all else of the scenario goes on. */
  takeOver() {
    const [x, y, ...platform] = this.boardTarget();
    this.way = [x / RADIANS, y / RADIANS];
    this.aim = this.way;
    this.platform = platform;
    this.scenario = { ...this.scenario, targets: null };
  }

  /** Targets of the board's servos now, rad, and m of a platform. */
  boardTarget() {
    const { task, scenario } = this;
    if (scenario.targets) {
      const [x, y, ...platform] = boardTarget(task, scenario, this.time);
      return [x * RADIANS, y * RADIANS, ...platform];
    }
    const reach = task.board_rate * task.sim_dt;
    this.way = this.way.map((x, k) => x + clip(this.aim[k] - x, -reach, reach));
    return [...this.way.map((x) => x * RADIANS), ...this.platform];
  }
}

/**
 * Evaluates as fast as it can, as `mjx-balance evaluate`: from a fall on the tilt counts as a fall's.
 * @param {Simulation} simulation
 * @param {any[]} scenarios
 * @param {number} duration s
 * @param {(share: number) => Promise<void>} progress is awaited, so that the page stays alive
 */
export async function evaluate(simulation, scenarios, duration, progress) {
  const { task } = simulation;
  const decisions = Math.ceil(duration / (task.sim_dt * task.sim_steps) - 1e-9);
  const steps = decisions * task.sim_steps;
  const tilts = new Float64Array(scenarios.length * steps).fill(task.fail_tilt);
  const means = [];
  let falls = 0;
  let held = 0;
  for (const [k, scenario] of scenarios.entries()) {
    simulation.reset(scenario, k);
    const own = tilts.subarray(k * steps, (k + 1) * steps);
    for (let step = 0; step < steps; step++) {
      const tilt = simulation.step();
      if (simulation.fellAt !== null) {
        falls += 1;
        break;
      }
      own[step] = tilt;
      if (step % 500 === 0) {
        await progress((k + step / steps) / scenarios.length);
      }
    }
    held += Number(simulation.balancer.reason !== "");
    means.push(own.reduce((a, b) => a + b, 0) / steps);
  }
  const sorted = tilts.slice().sort();
  const percentile = (/** @type {number} */ share) => {
    const place = share * (sorted.length - 1);
    const below = sorted[Math.floor(place)];
    return below + (place % 1) * (sorted[Math.ceil(place)] - below);
  };
  return {
    scenarios: scenarios.length,
    duration_s: duration,
    falls,
    held,
    tilt_deg: {
      mean: means.reduce((a, b) => a + b, 0) / means.length,
      p50: percentile(0.5),
      p95: percentile(0.95),
      p99: percentile(0.99),
      max: sorted[sorted.length - 1],
      by_scenario: means,
    },
  };
}
