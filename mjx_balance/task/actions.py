"""The 21 x 21 actions of paper Eq. 3, or any height change up to theirs."""

import numpy as np

from mjx_balance.config import ConfigError, TaskConfig
from mjx_balance.files.text import quote
from mjx_balance.robots.catalogue import Robot
from mjx_balance.task import Array

ACTIONS = ("discrete", "continuous")
"""An index into `action_table`; or a_x and a_y as shares of `action_max`, -1 to 1."""


def check_action(kind: str) -> str:
    """Returns one of `ACTIONS`; raises `ConfigError` for anything else."""
    if kind not in ACTIONS:
        raise ConfigError(f"action is {quote(kind)}; it must be one of {', '.join(ACTIONS)}")
    return kind


def action_table(task: TaskConfig) -> np.ndarray:
    """Height changes of every action: a_x varies slowest.

    Returns:
      (action_levels**2, 2) a_x and a_y, m, float32.
    """
    n = np.arange(task.action_levels)
    level = -task.action_max + 2 * task.action_max * n / (task.action_levels - 1)
    a_x, a_y = np.meshgrid(level, level, indexing="ij")
    return np.stack((a_x.ravel(), a_y.ravel()), axis=-1).astype(np.float32)


def nearest_action(task: TaskConfig, change: np.ndarray) -> np.ndarray:
    """Index of the action closest to a wanted height change.

    Args:
      task: the action grid.
      change: (..., 2) a_x and a_y, m, of any size.

    Returns:
      (...) indices into `action_table`.
    """
    step = 2 * task.action_max / (task.action_levels - 1)
    level = np.clip(np.rint((change + task.action_max) / step), 0, task.action_levels - 1)
    return (level[..., 0] * task.action_levels + level[..., 1]).astype(int)


def leg_signs(robot: Robot) -> np.ndarray:
    """Which way each foot goes: left +a_x, right -a_x, front +a_y, hind -a_y.

    Returns:
      (2, legs) of +-1, float32.
    """
    return np.where((robot.left, robot.front), np.float32(1), np.float32(-1))


def apply_action(task: TaskConfig, robot: Robot, heights: Array, change: Array) -> Array:
    """Adds one action to the foot heights.

    Raising the left side by a_x means longer left legs and shorter right ones.
    The heights stay within the legs' reach.

    Args:
      task: names the units.
      robot: sides and reach of the legs.
      heights: (..., legs) commanded foot heights, m.
      change: (..., 2) a_x and a_y, m.

    Returns:
      (..., legs) commanded foot heights, m.
    """
    xp = heights.__array_namespace__()
    signs = leg_signs(robot).astype(heights.dtype)
    moved = heights + change[..., :1] * signs[0] + change[..., 1:] * signs[1]
    lowest, highest = robot.height_range
    return xp.clip(moved, lowest, highest)
