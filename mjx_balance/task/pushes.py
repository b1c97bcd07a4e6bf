"""Pushes: sudden changes of the trunk's velocity in any horizontal direction, after a choice."""

from typing import NamedTuple

import numpy as np
from jaxtyping import Float, Int

from mjx_balance.config import RandomizationConfig, TaskConfig
from mjx_balance.task import Array


class Pushes(NamedTuple):
    """The pushes of one env, or of a batch of them."""

    velocity: Float[Array, "*batch pushes 2"]  #: along the world's x and y, m/s
    due: Int[Array, "*batch pushes"]  #: number of the decision that begins with it


def push_decisions(
    task: TaskConfig, ranges: RandomizationConfig, duration: float
) -> Int[np.ndarray, " pushes"]:
    """Numbers of the decisions within `duration`, in s, that begin with a push; increasing.

    Push k is due at `k * push_period`, k = 1, 2, ..., and comes with the first decision that does
    not begin before that: a number stands there twice if two pushes have become due.
    """
    last = int(np.ceil(duration / ranges.push_period - 1e-9)) - 1 if ranges.push_max else 0
    due = ranges.push_period * np.arange(1, last + 1)
    return np.ceil(due / task.ctrl_dt - 1e-9).astype(int)


def draw_velocity(
    ranges: RandomizationConfig, uniform: Float[Array, "*batch 2"]
) -> Float[Array, "*batch 2"]:
    """Turns numbers in [0, 1) into pushes along x and y, m/s; speed and direction are uniform."""
    xp = uniform.__array_namespace__()
    speed = ranges.push_min + (ranges.push_max - ranges.push_min) * uniform[..., 0]
    angle = 2 * np.pi * uniform[..., 1]
    return speed[..., None] * xp.stack((xp.cos(angle), xp.sin(angle)), axis=-1)


def push_velocity(pushes: Pushes, env_steps: Int[Array, "*batch"]) -> Float[Array, "*batch 2"]:
    """What is added to the trunk's velocity, m/s, when decision `env_steps` begins; mostly 0."""
    now = pushes.due == env_steps[..., None]
    return (now[..., None] * pushes.velocity).sum(axis=-2)
