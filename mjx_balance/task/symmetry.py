"""The robot looks the same in a mirror: what that makes of observations and actions."""

from typing import NamedTuple

import numpy as np

from mjx_balance.config import TaskConfig
from mjx_balance.robots import Robot


class Symmetries(NamedTuple):
    """The group of reflections, the identity first: left-right, front-hind, and both."""

    obs_index: np.ndarray
    """(g, obs_size) entry of the observation that takes each place."""
    obs_sign: np.ndarray
    """(g, obs_size) its sign there, float32."""
    action_index: np.ndarray
    """(g, num_actions) index that each action becomes, int32."""


def symmetries(task: TaskConfig, robot: Robot) -> Symmetries:
    """Reflections of the observation of Eq. 2 and the actions of Eq. 3.

    A reflection left-right swaps left and right legs and turns the signs of the roll
    rate, the lateral acceleration and a_x; one front-hind those of the pitch rate, the
    fore-aft acceleration and a_y. Front and hind legs bend the same way, so the second
    is exact for the stance and a close approximation for the motion.
    """
    legs = list(robot.legs)
    gyro, accel = len(task.gyro_lags), len(task.accel_lags)
    rows = 1 + len(task.command_lags)  # measured heights, commanded ones
    heights = rows * len(legs)
    rest = np.arange(heights, heights + 2 * (gyro + accel))
    level = np.arange(task.action_levels)
    index, sign, action = [], [], []
    for left_right in (False, True):
        for front_hind in (False, True):
            swap = str.maketrans(
                ("LR" if left_right else "") + ("FH" if front_hind else ""),
                ("RL" if left_right else "") + ("HF" if front_hind else ""),
            )
            swapped = np.asarray([legs.index(leg.translate(swap)) for leg in legs])
            index.append([*(swapped + len(legs) * np.arange(rows)[:, None]).ravel(), *rest])
            roll, pitch = 1 - 2 * left_right, 1 - 2 * front_hind
            sign.append([1] * heights + [roll] * gyro + [pitch] * (gyro + accel) + [roll] * accel)
            a_x = level[::-1] if left_right else level
            a_y = level[::-1] if front_hind else level
            action.append((a_x[:, None] * task.action_levels + a_y).ravel())
    return Symmetries(
        np.asarray(index, np.int32), np.asarray(sign, np.float32), np.asarray(action, np.int32)
    )
