"""Leg kinematics: foot heights to joint angles and back.

A foot's height is its vertical distance below the trunk's centre, foot radius
included (paper 3.2, "vertical distance of foot endpoint correspond to the robot
body"). Feet move straight up and down under their hips.
"""

import functools

import numpy as np
from jaxtyping import Float

from mjx_balance.config import TaskConfig
from mjx_balance.robots.catalogue import Robot
from mjx_balance.task import Array

AT_ONCE = np.zeros(())  #: no delay, physics steps


def joint_angles(
    robot: Robot, heights: Float[Array, "*batch legs"]
) -> Float[Array, "*batch legs 3"]:
    """Foot heights, m, in `robot.height_range` -> abduction, hip and knee angles, rad."""
    xp = heights.__array_namespace__()
    constant = functools.partial(np.asarray, dtype=heights.dtype)
    a, b = robot.each("thigh"), robot.each("calf")
    length = heights - constant(robot.foot_radius + robot.each("drop") - robot.each("axis_height"))
    cosine = (length**2 - constant(a**2) - constant(b**2)) / constant(2 * a * b)
    # Negative knees point backward.
    bends = np.sign(robot.each("knee").sum(axis=-1))
    knee = constant(bends) * xp.arccos(xp.clip(cosine, -1.0, 1.0))
    thigh = -xp.arctan2(constant(b) * xp.sin(knee), constant(a) + constant(b) * xp.cos(knee))
    turned = xp.stack((xp.zeros_like(thigh), thigh, knee), axis=-1)
    return constant(robot.each("signs")) * (turned - constant(robot.each("zeros")))


def foot_heights(
    robot: Robot, angles: Float[Array, "*batch legs 3"]
) -> Float[Array, "*batch legs"]:
    """Forward kinematics, the inverse of `joint_angles`."""
    xp = angles.__array_namespace__()
    constant = functools.partial(np.asarray, dtype=angles.dtype)
    turned = constant(robot.each("signs")) * angles + constant(robot.each("zeros"))
    abduction, thigh, knee = turned[..., 0], turned[..., 1], turned[..., 2]
    length = constant(robot.each("thigh")) * xp.cos(thigh)
    length = length + constant(robot.each("calf")) * xp.cos(thigh + knee)
    down = (length + constant(robot.each("drop"))) * xp.cos(abduction)
    lateral = constant(robot.each("offset")) * xp.sin(abduction)
    return down - lateral + constant(robot.foot_radius - robot.each("axis_height"))


def ramp(
    task: TaskConfig,
    before: Float[Array, "*batch legs"],
    after: Float[Array, "*batch legs"],
    delay: Float[Array, "*#batch"] = AT_ONCE,
) -> Float[Array, "*batch sim_steps legs"]:
    """Heights from one decision to the next: a straight line for `action_ramp`, then rest.

    Args:
      task: sizes of the physics step, the decision and the ramp.
      before: foot heights at the last decision, m.
      after: foot heights after this one, m.
      delay: physics steps until the legs begin to move; a NumPy array is a constant of the program.
    """
    share = (np.arange(1, task.sim_steps + 1) - delay[..., None]) / task.ramp_steps
    share = share.__array_namespace__().clip(share, 0.0, 1.0)[..., None].astype(before.dtype)
    return before[..., None, :] * (1 - share) + after[..., None, :] * share
