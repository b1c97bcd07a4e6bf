"""What the controller sees and moves: the task's functions applied to a scene's arrays.

Training (JAX) and evaluation (NumPy) both go through here, so that there is one
definition of a decision's controls and of its observation.
"""

from typing import NamedTuple

import numpy as np

from mjx_balance.config import Config
from mjx_balance.scene import Scene
from mjx_balance.task import Array, legs, tilt
from mjx_balance.task.observation import observe


class View(NamedTuple):
    """All there is to see when n worlds of an evaluation take a decision.

    A policy looks at `obs` alone; baselines may look at what no robot knows.
    """

    ids: np.ndarray
    """(n,) numbers of these worlds in the batch, for controllers with a memory."""
    decision: int
    """Decisions since the start."""
    obs: np.ndarray
    """(n, obs_size) the network's input."""
    imu: np.ndarray
    """(n, sim_steps, 6) IMU samples of the last decision."""
    qpos: np.ndarray
    """(n, nq) true positions."""
    qvel: np.ndarray
    """(n, nv) true velocities."""
    scenario: tilt.Scenario
    """Where the boards go."""
    late: np.ndarray
    """(n,) whether actions are taken one decision late."""


def decision_ctrl(
    config: Config,
    scene: Scene,
    scenario: tilt.Scenario,
    decision: Array,
    before: Array,
    after: Array,
) -> Array:
    """Servo targets of every physics step of one decision.

    Args:
      config: rates and robot.
      scene: servo addresses and trim.
      scenario: where the board goes.
      decision: (...) decisions since the start.
      before: (..., legs) commanded foot heights at its start, m.
      after: (..., legs) at its end, m.

    Returns:
      (..., sim_steps, nu) rad. Step i aims at time (i + 1) * sim_dt of the decision.
    """
    task, xp = config.task, before.__array_namespace__()
    step = np.arange(1, task.sim_steps + 1).astype(before.dtype)
    time = task.ctrl_dt * decision[..., None] + task.sim_dt * step
    board = tilt.board_angle(task, scenario, time) * (np.pi / 180)
    joints = legs.joint_angles(config.robot, legs.ramp(task, before, after))
    joints = joints + scene.stance.leg_trim.astype(before.dtype)
    flat = xp.concatenate((board, joints.reshape(*joints.shape[:-2], -1)), axis=-1)
    order = np.argsort(np.concatenate((scene.board_ctrl, scene.leg_ctrl.ravel())))
    return flat[..., order]


def observation(config: Config, scene: Scene, qpos: Array, commanded: Array, imu: Array) -> Array:
    """The network's input.

    Args:
      config: observation layout.
      scene: joint addresses.
      qpos: (..., nq)
      commanded: (..., task.command_history, legs) foot heights that the latest actions asked
        for, the newest last, m.
      imu: (..., task.history, 6) latest IMU samples, the newest last.

    Returns:
      (..., obs_size)
    """
    heights = legs.foot_heights(config.robot, qpos[..., scene.leg_qpos])
    return observe(config.task, config.robot, heights, commanded, imu)


def standing_heights(config: Config) -> np.ndarray:
    """(legs,) commanded foot heights at the start of an episode, m."""
    return np.full(len(config.robot.legs), config.task.body_height)
