"""The 21 x 21 actions of paper Eq. 3, or any height change up to theirs."""

import numpy as np
from jaxtyping import Float, Float32, Int

from mjx_balance.config import ConfigError, TaskConfig
from mjx_balance.errors import quote
from mjx_balance.robots.catalogue import Robot
from mjx_balance.task import Array

ACTIONS = ("discrete", "continuous")  #: table index; shares of `action_max`, -1 to 1


def check_action(kind: str | None, task: TaskConfig | None) -> str:
    """Returns one of `ACTIONS`; raises `ConfigError` for other words.

    None is that of `task.action`; without a task, discrete: the spaces of an env that is made by
    name alone are the paper's.
    """
    if kind is None:
        return ACTIONS[task is not None and task.action == "continuous"]
    if kind not in ACTIONS:
        raise ConfigError(f"action is {quote(kind)}; it must be one of {', '.join(ACTIONS)}")
    return kind


def action_table(task: TaskConfig) -> Float32[np.ndarray, "actions 2"]:
    """Height changes a_x and a_y of every action, m; a_x varies slowest."""
    n = np.arange(task.action_levels)
    level = -task.action_max + 2 * task.action_max * n / (task.action_levels - 1)
    a_x, a_y = np.meshgrid(level, level, indexing="ij")
    return np.stack((a_x.ravel(), a_y.ravel()), axis=-1).astype(np.float32)


def nearest_action(task: TaskConfig, change: Float[Array, "*batch 2"]) -> Int[Array, "*batch"]:
    """Index into `action_table` of the action closest to a height change of any size, m."""
    step = 2 * task.action_max / (task.action_levels - 1)
    level = np.clip(np.rint((change + task.action_max) / step), 0, task.action_levels - 1)
    return (level[..., 0] * task.action_levels + level[..., 1]).astype(int)


def to_command(task: TaskConfig, change: Float[Array, "*batch 2"]) -> Float[Array, "*batch 2"]:
    """The command, m, for a desired height change of any size, m, as `task.action` allows.

    "grid": the nearest of the table's; "continuous": the change itself, within their range.
    """
    if task.action == "grid":
        return action_table(task)[nearest_action(task, change)]
    return np.clip(change, -task.action_max, task.action_max)


def leg_signs(robot: Robot) -> Float32[np.ndarray, "2 legs"]:
    """Which way each foot goes, +-1: left +a_x, right -a_x; front +a_y, hind -a_y."""
    return np.where((robot.each("left"), robot.each("front")), np.float32(1), np.float32(-1))


def apply_action(
    robot: Robot, heights: Float[Array, "*batch legs"], change: Float[Array, "*batch 2"]
) -> Float[Array, "*batch legs"]:
    """Adds an action to the commanded foot heights, m, within the legs' reach."""
    xp = heights.__array_namespace__()
    signs = leg_signs(robot).astype(heights.dtype)
    moved = heights + change[..., :1] * signs[0] + change[..., 1:] * signs[1]
    lowest, highest = robot.height_range
    return xp.clip(moved, lowest, highest)
