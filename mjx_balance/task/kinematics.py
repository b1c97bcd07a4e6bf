"""Leg kinematics: foot heights to joint angles and back.

A foot's height is its vertical distance below the trunk's centre, foot radius
included (paper 3.2, "vertical distance of foot endpoint correspond to the robot
body"). Feet move straight up and down under their hips.
"""

import numpy as np

from mjx_balance.config import TaskConfig
from mjx_balance.robots.catalogue import Robot
from mjx_balance.task import Array


def joint_angles(robot: Robot, heights: Array) -> Array:
    """Inverse kinematics.

    Args:
      robot: its legs.
      heights: (..., legs) m, within `robot.height_range`.

    Returns:
      (..., legs, 3) abduction, hip and knee angles, rad.
    """
    xp = heights.__array_namespace__()

    def constant(values: np.ndarray) -> np.ndarray:
        return values.astype(heights.dtype)

    a, b = robot.each("thigh"), robot.each("calf")
    length = heights - constant(robot.foot_radius + robot.each("drop") - robot.each("axis_height"))
    cosine = (length**2 - constant(a**2) - constant(b**2)) / constant(2 * a * b)
    knee = constant(_bends(robot)) * xp.arccos(xp.clip(cosine, -1.0, 1.0))
    thigh = -xp.arctan2(constant(b) * xp.sin(knee), constant(a) + constant(b) * xp.cos(knee))
    turned = xp.stack((xp.zeros_like(thigh), thigh, knee), axis=-1)
    return constant(robot.each("signs")) * (turned - constant(robot.each("zeros")))


def foot_heights(robot: Robot, angles: Array) -> Array:
    """Forward kinematics, the inverse of `joint_angles`.

    Args:
      robot: its legs.
      angles: (..., legs, 3) abduction, hip and knee angles, rad.

    Returns:
      (..., legs) m.
    """
    xp = angles.__array_namespace__()

    def constant(values: np.ndarray) -> np.ndarray:
        return values.astype(angles.dtype)

    turned = constant(robot.each("signs")) * angles + constant(robot.each("zeros"))
    abduction, thigh, knee = turned[..., 0], turned[..., 1], turned[..., 2]
    length = constant(robot.each("thigh")) * xp.cos(thigh)
    length = length + constant(robot.each("calf")) * xp.cos(thigh + knee)
    down = (length + constant(robot.each("drop"))) * xp.cos(abduction)
    lateral = constant(robot.each("offset")) * xp.sin(abduction)
    return down - lateral + constant(robot.foot_radius - robot.each("axis_height"))


def _bends(robot: Robot) -> np.ndarray:
    """(legs,) -1 where the knee points backward, 1 where forward."""
    return np.sign(robot.each("knee").sum(axis=-1))


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
