"""Pushes: sudden changes of the trunk's velocity, in any horizontal direction.

A push comes after a choice and before its decision: a controller sees its consequences alone.
"""

from typing import NamedTuple

import numpy as np

from mjx_balance.config import RandomizationConfig, TaskConfig
from mjx_balance.task import Array


class Pushes(NamedTuple):
    """The pushes of one env, or of a batch of them."""

    velocity: Array
    """(..., n, 2) what each adds to the trunk's velocity along the world's x and y, m/s."""
    due: Array
    """(..., n) number of the decision that begins with it."""


def push_decisions(task: TaskConfig, ranges: RandomizationConfig, duration: float) -> np.ndarray:
    """Numbers of the decisions that begin with a push.

    Push k is due at `k * push_period`, k = 1, 2, ..., before `duration`, and comes with the first
    decision that does not begin before that.

    Args:
      task: length of a decision.
      ranges: the period; there are no pushes where `push_max` is 0.
      duration: s.

    Returns:
      (n,) increasing; a number stands there twice if two pushes have become due.
    """
    last = int(np.ceil(duration / ranges.push_period - 1e-9)) - 1 if ranges.push_max else 0
    due = ranges.push_period * np.arange(1, last + 1)
    return np.ceil(due / task.ctrl_dt - 1e-9).astype(int)


def draw_velocity(ranges: RandomizationConfig, uniform: Array) -> Array:
    """Turns random numbers into pushes: speed and direction are uniform.

    Args:
      ranges: least and greatest speed.
      uniform: (..., 2) in [0, 1).

    Returns:
      (..., 2) m/s along the world's x and y.
    """
    xp = uniform.__array_namespace__()
    speed = ranges.push_min + (ranges.push_max - ranges.push_min) * uniform[..., 0]
    angle = 2 * np.pi * uniform[..., 1]
    return speed[..., None] * xp.stack((xp.cos(angle), xp.sin(angle)), axis=-1)


def push_velocity(pushes: Pushes, env_steps: Array) -> Array:
    """What is added to the trunk's velocity when a decision begins.

    Args:
      pushes: of one env, or of a batch (...).
      env_steps: (...) number of the decision.

    Returns:
      (..., 2) m/s along the world's x and y; 0 where no push is due.
    """
    now = pushes.due == env_steps[..., None]
    return (now[..., None] * pushes.velocity).sum(axis=-2)
