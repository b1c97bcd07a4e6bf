"""One decision: from an action to the servos' targets, and from the samples to what is learnt.

Between `controls` and `outcome` an engine moves the physics. Training (JAX, one env, vmapped)
and evaluation (NumPy, all scenarios at once) both go through here, so that there is one
definition of what the robot is told, sees and is rewarded for.
"""

from typing import NamedTuple

import numpy as np

from mjx_balance.config import TaskConfig
from mjx_balance.robots.catalogue import Robot
from mjx_balance.task import Array, kinematics, tilt
from mjx_balance.task.actions import apply_action
from mjx_balance.task.observation import (
    Signals,
    extend_history,
    input_rows,
    lookback,
    observe,
)
from mjx_balance.task.reward import RewardInputs, failed, reward_terms

ABSURD = 1e4
"""Size, in rad, rad/s or m/s^2, from which a value of the simulation is no motion any more."""


class Memory(NamedTuple):
    """What one decision leaves to the next, besides the state of the physics."""

    heights: Array
    """(..., legs) foot heights that the legs were last told to take, m."""
    commanded: Array
    """(..., n, legs) foot heights that the latest actions asked for, the
    newest last, m; late actions are asked for before the legs are told."""
    imu: Array
    """(..., n, 6) latest IMU samples, the newest last, rad/s and m/s^2."""
    tilt: Array
    """(...) body tilt that was last rewarded, deg."""


class Targets(NamedTuple):
    """What the servos are told at every physics step of a decision."""

    board: Array
    """(..., sim_steps, 2) board angles about X and Y, rad."""
    joints: Array
    """(..., sim_steps, legs, 3) abduction, hip and knee angles, rad."""


class Outcome(NamedTuple):
    """What came of a decision."""

    obs: Array
    """(..., obs_size) the network's next input."""
    rewards: dict[str, Array]
    """(...) by name (`reward_terms`); their sum is the reward."""
    tilt: Array
    """(..., sim_steps) body tilt after each step, deg."""
    fell: Array
    """(...) bool, whether the body tilted too far on the way, or the simulation diverged."""
    diverged: Array
    """(...) bool, whether the simulation gave what no robot can do."""


def start(task: TaskConfig, robot: Robot, still: Array) -> Memory:
    """The memory of a robot that has been standing for a while.

    Args:
      task: standing height, lengths of the histories.
      robot: its legs.
      still: (..., 6) IMU sample at rest.
    """
    xp = still.__array_namespace__()
    rows = input_rows(task, robot)
    heights = xp.zeros((*still.shape[:-1], len(robot.legs)), still.dtype) + task.body_height
    return Memory(
        heights=heights,
        commanded=_repeated(heights, lookback(rows, "commands")),
        imu=_repeated(still, lookback(rows, "imu")),
        tilt=xp.zeros_like(still[..., 0]),
    )


def controls(
    task: TaskConfig,
    robot: Robot,
    memory: Memory,
    change: Array,
    late: Array | None,
    scenario: tilt.Scenario,
    decision: Array,
) -> tuple[Memory, Targets]:
    """Turns an action into targets of the servos.

    Args:
      task: rates.
      robot: its legs.
      memory: from the last decision.
      change: (..., 2) a_x and a_y of the action, m.
      late: (...) bool, whether actions are taken one decision late; none: nowhere.
      scenario: where the board goes.
      decision: (...) decisions since the start.

    Returns:
      The memory with the new command, and the targets. Those of step i are for time
      (i + 1) * sim_dt of the decision.
    """
    xp = memory.heights.__array_namespace__()
    last = memory.commanded[..., -1, :]
    wanted = apply_action(task, robot, last, change)
    heights = wanted if late is None else xp.where(late[..., None], last, wanted)
    step = np.arange(1, task.sim_steps + 1).astype(heights.dtype)
    time = task.ctrl_dt * decision[..., None] + task.sim_dt * step
    board = tilt.board_angle(task, scenario, time) * (np.pi / 180)
    path = kinematics.ramp(task, memory.heights, heights)
    moving = kinematics.joint_angles(robot, path[..., : task.ramp_steps, :])
    resting = xp.repeat(moving[..., -1:, :, :], task.sim_steps - task.ramp_steps, axis=-3)
    commanded = extend_history(memory.commanded, wanted[..., None, :])
    memory = memory._replace(heights=heights, commanded=commanded)
    return memory, Targets(board, xp.concatenate((moving, resting), axis=-3))


def outcome(
    task: TaskConfig,
    robot: Robot,
    memory: Memory,
    samples: Array,
    tilts: Array,
    angles: Array,
) -> tuple[Memory, Outcome]:
    """Turns what the sensors gave during a decision into observation, reward and failure.

    Where the simulation diverged, the robot has fallen: its tilt counts as `fail_tilt` all
    along, the IMU holds its last sample, and the legs count as where they were told to be.

    Args:
      task: weights, limits, layout.
      robot: its legs.
      memory: from `controls`.
      samples: (..., sim_steps, 6) IMU samples, noise included.
      tilts: (..., sim_steps) body tilt after each step, deg.
      angles: (..., legs, 3) measured joint angles at the end, rad.

    Returns:
      The memory for the next decision, and the outcome.
    """
    xp = samples.__array_namespace__()
    diverged = _absurd(samples, 2) | _absurd(tilts, 1) | _absurd(angles, 2)
    told = kinematics.joint_angles(robot, memory.heights)
    samples = xp.where(diverged[..., None, None], memory.imu[..., -1:, :], samples)
    tilts = xp.where(diverged[..., None], task.fail_tilt, tilts)
    angles = xp.where(diverged[..., None, None], told, angles)
    fell = diverged | failed(task, tilts).any(axis=-1)
    after = tilts.mean(axis=-1) if task.reward_tilt == "mean" else tilts[..., -1]
    inputs = RewardInputs(memory.tilt, after, fell.astype(after.dtype))
    rewards = reward_terms(task, inputs)
    memory = memory._replace(imu=extend_history(memory.imu, samples), tilt=after)
    obs = observation(task, robot, memory, angles)
    return memory, Outcome(obs, rewards, tilts, fell, diverged)


def _absurd(values: Array, axes: int) -> Array:
    """Whether any value over the last `axes` axes is not a number of a sane size."""
    bad = ~(abs(values) < ABSURD)
    return bad.reshape(*values.shape[:-axes], -1).any(axis=-1)


def observation(task: TaskConfig, robot: Robot, memory: Memory, angles: Array) -> Array:
    """The network's input (..., obs_size), for measured joint angles (..., legs, 3), rad."""
    heights = kinematics.foot_heights(robot, angles)
    signals = Signals(heights[..., None, :], memory.commanded, memory.imu)
    return observe(input_rows(task, robot), signals)


def _repeated(row: Array, times: int) -> Array:
    """Returns (..., times, k) for (..., k)."""
    xp = row.__array_namespace__()
    return xp.zeros((*row.shape[:-1], times, 1), row.dtype) + row[..., None, :]
