"""Pushes: kicks that change the trunk's velocity at once, in any horizontal direction.

A kick comes between a choice and its decision: who acts learns of it by its consequences.
"""

from typing import NamedTuple

import numpy as np

from mjx_balance.config import RandomizationConfig, TaskConfig
from mjx_balance.task import Array


class Pushes(NamedTuple):
    """The kicks of one env or scenario, or of a batch of them."""

    kicks: Array
    """(..., n, 2) what each adds to the trunk's velocity along the world's x and y, m/s."""
    at: Array
    """(n,) numbers of the decisions that begin with one; the same in all of a batch."""


def kicked_decisions(task: TaskConfig, ranges: RandomizationConfig, duration: float) -> np.ndarray:
    """Numbers of the decisions that begin with a kick.

    Kick k is due at `k * push_period`, k = 1, 2, ..., before `duration`, and comes with the first
    decision that does not begin before that.

    Args:
      task: length of a decision.
      ranges: the period; there are no kicks where `push_max` is 0.
      duration: s.

    Returns:
      (n,) increasing; a number stands there twice if two kicks have become due.
    """
    last = int(np.ceil(duration / ranges.push_period - 1e-9)) - 1 if ranges.push_max else 0
    due = ranges.push_period * np.arange(1, last + 1)
    return np.ceil(due / task.ctrl_dt - 1e-9).astype(int)


def draw_kicks(ranges: RandomizationConfig, uniform: Array) -> Array:
    """Turns random numbers into kicks: speed and direction are uniform.

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


def kick(pushes: Pushes, decision: Array | int) -> Array:
    """What is added to the trunk's velocity when a decision begins.

    Args:
      pushes: of one env or scenario, or of a batch (...).
      decision: () number of the decision, or (..., 1) of each of the batch.

    Returns:
      (..., 2) m/s along the world's x and y; 0 where there is no kick.
    """
    return ((pushes.at == decision)[..., None] * pushes.kicks).sum(axis=-2)
