"""Board tilt: a scenario is a value, and the board's angle a closed form of it."""

from collections.abc import Callable
from typing import NamedTuple

import numpy as np
from jaxtyping import Float

from mjx_balance.config import TaskConfig
from mjx_balance.task import Array


class Scenario(NamedTuple):
    """Where the board goes (paper 3.1).

    The board starts level. It takes aim at `targets[k]` at time
    `k * target_period - phase` and stays there once it has arrived.
    """

    targets: Float[Array, "*batch targets 2"]  #: board angles about X and Y, deg
    phase: Float[Array, "*batch"]  #: time the first target is already old at time 0, s
    rate: Float[Array, "*batch"]  #: speed of the board on each axis, deg/s


def num_targets(task: TaskConfig, duration: float) -> int:
    """Targets that a scenario of `duration` seconds needs, whatever its phase."""
    return int(np.ceil(duration / task.target_period)) + 1


def board_angle(
    task: TaskConfig, scenario: Scenario, time: Float[Array, "*batch times"]
) -> Float[Array, "*batch times 2"]:
    """Target angle of the board, deg, at times since the start, s, none of them negative.

    Each axis moves at `rate` from the last target to the next and then rests; it always arrives
    within the period (config and suites check that), so the angle is a closed form of the time.
    """
    targets, phase, rate = scenario
    xp = targets.__array_namespace__()
    clock = time + phase[..., None]
    last = targets.shape[-2] - 1
    period = xp.clip(xp.floor(clock / task.target_period), 0, last).astype(int)
    since = clock - period * task.target_period
    level = xp.zeros_like(targets[..., :1, :])
    stops = xp.concatenate((level, targets), axis=-2)
    start = xp.take_along_axis(stops, period[..., None], axis=-2)
    change = xp.take_along_axis(targets, period[..., None], axis=-2) - start
    reach = (rate[..., None] * since)[..., None]
    return start + xp.clip(change, -reach, reach)


def disc_targets(
    incline: Float[Array, "..."],
    direction: Float[Array, "*batch"],
    magnitude: Float[Array, "*batch"],
) -> Float[Array, "*batch 2"]:
    """Targets in any direction, deg about X and Y (paper 3.1).

    Args:
      incline: greatest total tilt, deg.
      direction: share of a full turn, [0, 1).
      magnitude: share of the greatest incline, [0, 1).
    """
    xp = direction.__array_namespace__()
    angle = 2 * np.pi * direction
    unit = xp.stack((xp.cos(angle), xp.sin(angle)), axis=-1)
    return (incline * magnitude)[..., None] * unit


def draw_scenario(
    task: TaskConfig, uniform: Callable[[tuple[int, ...], float, float], Array]
) -> Scenario:
    """Draws one scenario of training, long enough for an episode.

    The random phase keeps thousands of boards from turning at the same time.

    Args:
      task: inclines, the share of the square, the board's speed, the episode's length.
      uniform: (shape, low, high) -> new random numbers in [low, high); the four calls always come
        in the same order.
    """
    count = num_targets(task, task.episode_length * task.ctrl_dt)
    direction, magnitude = uniform((2, count), 0.0, 1.0)
    square = uniform((count, 2), -1.0, 1.0)
    in_square = uniform((count, 1), 0.0, 1.0) < task.square_share
    phase = uniform((), 0.0, 1.0)
    xp = square.__array_namespace__()
    limit = xp.asarray(task.max_incline, dtype=square.dtype)
    targets = xp.where(in_square, limit * square, disc_targets(limit, direction, magnitude))
    # The board starts level, so the first target is one it has already reached.
    first = np.arange(count)[:, None] == 0
    targets = xp.where(first, xp.zeros_like(targets), targets)
    rate = xp.zeros_like(phase) + task.board_rate
    return Scenario(targets, phase * task.target_period, rate)
