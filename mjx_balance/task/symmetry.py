"""The robot looks the same in a mirror: what that makes of observations and actions."""

from typing import NamedTuple

import numpy as np

from mjx_balance.config import TaskConfig
from mjx_balance.robots.catalogue import Robot


class Symmetries(NamedTuple):
    """The group of reflections, the identity first."""

    obs_index: np.ndarray
    """(g, obs_size) entry of the observation that takes each place."""
    obs_sign: np.ndarray
    """(g, obs_size) its sign there, float32."""
    action_index: np.ndarray
    """(g, num_actions) index that each action becomes, int32."""


def symmetries(task: TaskConfig, robot: Robot) -> Symmetries:
    """The mirror of the observation of Eq. 2 and the actions of Eq. 3.

    Left and right legs change places; the roll rate, the lateral acceleration and a_x turn
    their signs. It is exact. Front-hind is no symmetry of the robot: all its knees bend
    backward.
    """
    left, front = np.asarray(robot.left), np.asarray(robot.front)
    partner = [
        np.flatnonzero((left == ~left[k]) & (front == front[k]))[0] for k in range(len(left))
    ]
    gyro, accel = len(task.gyro_lags), len(task.accel_lags)
    rows = 1 + len(task.command_lags)  # measured heights, commanded ones
    heights = rows * len(left)
    size = heights + 2 * (gyro + accel)
    swapped = np.asarray(partner) + len(left) * np.arange(rows)[:, None]
    mirrored = [*swapped.ravel(), *range(heights, size)]
    turned = [1] * heights + [-1] * gyro + [1] * (gyro + accel) + [-1] * accel
    actions = np.arange(task.num_actions).reshape(task.action_levels, task.action_levels)
    return Symmetries(
        np.asarray((range(size), mirrored), np.int32),
        np.asarray(([1] * size, turned), np.float32),
        np.asarray((actions.ravel(), actions[::-1].ravel()), np.int32),
    )
