"""Leg kinematics: foot heights to joint angles and back.

A foot's height is its vertical distance below the trunk's centre, foot radius
included (paper 3.2, "vertical distance of foot endpoint correspond to the robot
body"). Feet move straight up and down under their hips. Another robot brings
its own pair of functions.
"""

import numpy as np

from mjx_balance.config import TaskConfig
from mjx_balance.robots import Robot
from mjx_balance.task import Array


def joint_angles(robot: Robot, heights: Array) -> Array:
    """Inverse kinematics.

    Args:
      robot: link lengths.
      heights: (..., legs) m, within `robot.height_range`.

    Returns:
      (..., legs, 3) abduction, hip and knee angles, rad.
    """
    xp = heights.__array_namespace__()
    length = heights - robot.foot_radius
    a, b = robot.thigh, robot.calf
    knee = -xp.arccos(xp.clip((length**2 - a**2 - b**2) / (2 * a * b), -1.0, 1.0))
    hip = -xp.arctan2(b * xp.sin(knee), a + b * xp.cos(knee))
    return xp.stack((xp.zeros_like(hip), hip, knee), axis=-1)


def foot_heights(robot: Robot, angles: Array) -> Array:
    """Forward kinematics, the inverse of `joint_angles`.

    Args:
      robot: link lengths, sides of the legs.
      angles: (..., legs, 3) abduction, hip and knee angles, rad.

    Returns:
      (..., legs) m.
    """
    xp = angles.__array_namespace__()
    abduction, hip, knee = angles[..., 0], angles[..., 1], angles[..., 2]
    side = np.where(robot.left, 1.0, -1.0)
    drop = robot.thigh * xp.cos(hip) + robot.calf * xp.cos(hip + knee)
    lateral = robot.abduction_offset * side.astype(angles.dtype) * xp.sin(abduction)
    return drop * xp.cos(abduction) - lateral + robot.foot_radius


def ramp(task: TaskConfig, before: Array, after: Array) -> Array:
    """Heights on the way from one decision to the next: a straight line, then rest.

    Args:
      task: `action_ramp` is the share of the decision spent moving.
      before: (..., legs) m.
      after: (..., legs) m.

    Returns:
      (..., sim_steps, legs) m; the last is `after`.
    """
    share = np.minimum(np.arange(1, task.sim_steps + 1) / task.ramp_steps, 1.0)
    share = share[:, None].astype(before.dtype)
    return before[..., None, :] * (1 - share) + after[..., None, :] * share
