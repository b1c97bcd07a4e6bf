// Where the board goes: mjx_balance/task/tilt.py, the closed form of a scenario.

import { clip } from "./runtime.js";

/**
 * Target angles of the board about X and Y, deg, and with a platform its surge, sway and heave, m.
 * @param {any} task of the robot's data
 * @param {any} scenario of a suite
 * @param {number} time since the start, s
 * @returns {number[]}
 */
export function boardTarget(task, scenario, time) {
  const { targets, phase, rate, waves } = scenario;
  const clock = time + phase;
  const period = clip(Math.floor(clock / task.target_period), 0, targets.length - 1);
  const reach = rate * (clock - period * task.target_period);
  const from = period ? targets[period - 1] : scenario.start ?? [0, 0];
  const angle = targets[period].map((/** @type {number} */ target, /** @type {number} */ k) =>
    from[k] + clip(target - from[k], -reach, reach),
  );
  if (!waves) {
    return angle;
  }
  const part = clip(time / task.sea_period, 0, 1);
  const fade = part * part * (3 - 2 * part);
  return waves.amplitude[0].map((/** @type {number} */ _, /** @type {number} */ axis) => {
    let sum = 0;
    for (let k = 0; k < waves.omega.length; k++) {
      sum += waves.amplitude[k][axis] * Math.sin(time * waves.omega[k] + waves.phase[k][axis]);
    }
    return (angle[axis] ?? 0) + fade * sum;
  });
}
