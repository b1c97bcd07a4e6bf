"""Board motion: a scenario is a value, and the board's angle a closed form of it.

The angle is the sum of a motion from target to target and of waves. `MOTIONS` is the table of the
kinds of motion.
"""

import dataclasses
import math
from collections.abc import Callable
from typing import NamedTuple, TypeAlias

import numpy as np
from jaxtyping import Float

from mjx_balance.config import TaskConfig
from mjx_balance.config.sea import WAVES, fade, frequency, significant_angle
from mjx_balance.task import Array

Uniform: TypeAlias = Callable[[tuple[int, ...], float, float], Array]
"""(shape, low, high) -> new random numbers in [low, high)."""
MOST_CALLS = 16  #: greatest number of calls of `uniform` that a scenario takes


class Waves(NamedTuple):
    """Sines that move the board, from the first peak period on in full.

    There are two axes, X and Y, or five: a platform also surges, sways and heaves.
    """

    amplitude: Float[Array, "*batch waves axes"]  #: deg about X and Y; m along x, y and z
    omega: Float[Array, "*batch waves"]  #: frequency, rad/s
    phase: Float[Array, "*batch waves axes"]  #: at time 0, rad


class Scenario(NamedTuple):
    """Where the board goes (paper 3.1).

    The board starts level, or at `start`. It takes aim at `targets[k]` at time
    `k * target_period - phase` and stays there once it has arrived.
    """

    targets: Float[Array, "*batch targets 2"]  #: board angles about X and Y, deg
    phase: Float[Array, "*batch"]  #: time the first target is already old at time 0, s
    rate: Float[Array, "*batch"]  #: speed of the board on each axis, deg/s
    waves: Waves | None = None  #: None: none
    start: Float[Array, "*batch 2"] | None = None
    """Board angles at time 0, deg, which the body shares; None: level."""


def numpy_uniform(rng: np.random.Generator) -> Uniform:
    """Draws from a generator."""
    return lambda shape, low, high: np.asarray(rng.uniform(low, high, shape))


def num_targets(task: TaskConfig, duration: float) -> int:
    """Targets that a scenario of `duration` seconds needs, whatever its phase."""
    return int(np.ceil(duration / task.target_period)) + 1


def board_angle(
    task: TaskConfig, scenario: Scenario, time: Float[Array, "*batch times"]
) -> Float[Array, "*batch times 2"]:
    """Target angle of the board, deg, at times since the start, s, none of them negative.

    Each axis moves at `rate` from the last target to the next and then rests; it always arrives
    within the period (config and suites check that), so the angle is a closed form of the time.
    Waves are added.
    """
    angle = _toward_targets(task, scenario, time)
    if scenario.waves is None:
        return angle
    return angle + _at_sea(task, scenario.waves, time, slice(0, 2))


def platform_position(
    task: TaskConfig, scenario: Scenario, time: Float[Array, "*batch times"]
) -> Float[Array, "*batch times 3"]:
    """Surge, sway and heave of the platform, m, at times since the start, s."""
    if scenario.waves is None:
        shape = np.broadcast_shapes(time.shape, (*scenario.phase.shape, 1))
        return time.__array_namespace__().zeros((*shape, 3), dtype=time.dtype)
    return _at_sea(task, scenario.waves, time, slice(2, 5))


def _at_sea(
    task: TaskConfig, waves: Waves, time: Float[Array, "*batch times"], axes: slice
) -> Float[Array, "*batch times axes"]:
    """Sum of the waves on some axes, in their units."""
    xp = time.__array_namespace__()
    turn = (time[..., None] * waves.omega[..., None, :])[..., None]
    sines = xp.sin(turn + waves.phase[..., None, :, axes])
    total = (waves.amplitude[..., None, :, axes] * sines).sum(axis=-2)
    return fade(time, task.sea_period)[..., None] * total


def _toward_targets(
    task: TaskConfig, scenario: Scenario, time: Float[Array, "*batch times"]
) -> Float[Array, "*batch times 2"]:
    """Angle of a board without waves, deg."""
    targets, phase, rate, _, first = scenario
    xp = targets.__array_namespace__()
    clock = time + phase[..., None]
    last = targets.shape[-2] - 1
    period = xp.clip(xp.floor(clock / task.target_period), 0, last).astype(int)
    since = clock - period * task.target_period
    first = xp.zeros_like(targets[..., :1, :]) if first is None else first[..., None, :]
    stops = xp.concatenate((first, targets), axis=-2)
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


def draw_scenario(task: TaskConfig, uniform: Uniform) -> Scenario:
    """Draws one scenario of training, long enough for an episode.

    With several kinds of motion each is drawn equally often. Ramps alone have no waves. A platform
    moves by a share of its height, uniform in [0, 1). A board that starts tilted stays so until its
    second target.

    Args:
      task: kinds of motion and their numbers, the episode's length.
      uniform: (shape, low, high) -> new random numbers in [low, high), at most `MOST_CALLS` times;
        the calls always come in the same order.
    """
    scenario = _draw_motion(task, uniform)
    if task.platform and scenario.waves is not None:
        height, amplitude = uniform((), 0.0, 1.0), scenario.waves.amplitude
        factors = amplitude.__array_namespace__().where(np.arange(5) < 2, 1.0, height)
        scenario = scenario._replace(waves=scenario.waves._replace(amplitude=amplitude * factors))
    if not task.start_incline:
        return scenario
    draws = uniform((2,), 0.0, 1.0)
    xp = draws.__array_namespace__()
    start = disc_targets(xp.asarray(task.start_incline, dtype=draws.dtype), *draws)
    first = np.arange(len(scenario.targets))[:, None] == 0
    return scenario._replace(targets=xp.where(first, start, scenario.targets), start=start)


def _draw_motion(task: TaskConfig, uniform: Uniform) -> Scenario:
    """Draws the motion of a board that starts level."""
    count = num_targets(task, task.episode_length * task.ctrl_dt)
    drawn = [MOTIONS[name](task, count, uniform) for name in task.board_motions]
    if len(drawn) == 1:
        return drawn[0]
    number = uniform((), 0.0, float(len(drawn)))
    xp = number.__array_namespace__()
    axes = (WAVES, 5 if task.platform else 2)
    calm = Waves(*(xp.zeros(shape, dtype=number.dtype) for shape in (axes, WAVES, axes)))
    kinds = [(*x[:3], *(calm if x.waves is None else x.waves)) for x in drawn]
    chosen: list[Array] = list(kinds[0])
    for k, kind in enumerate(kinds[1:], start=1):
        chosen = [xp.where(number < k, *pair) for pair in zip(chosen, kind, strict=True)]
    targets, phase, rate, *waves = chosen
    return Scenario(targets, phase, rate, Waves(*waves))


def _draw_ramps(task: TaskConfig, count: int, uniform: Uniform) -> Scenario:
    """The random phase keeps thousands of boards from turning at the same time."""
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


def _draw_steps(task: TaskConfig, count: int, uniform: Uniform) -> Scenario:
    """Jumps at `step_rate` between targets up to `jump_incline`."""
    steps = dataclasses.replace(task, max_incline=task.jump_incline, square_share=0.0)
    return _draw_ramps(dataclasses.replace(steps, board_rate=task.step_rate), count, uniform)


def _draw_sea(task: TaskConfig, count: int, uniform: Uniform) -> Scenario:
    """Waves of equal energy, each with a frequency from its share of the spectrum.

    A frequency drawn anew in every scenario makes none repeat itself. Directions spread about the
    heading with the square of the cosine (ITTC 7.5-02-07-01.1, section 3.2): the sine of the
    angle is a coordinate of a point drawn uniformly from the unit disc.
    """
    share, phase, radius, turn = uniform((4, WAVES), 0.0, 1.0)
    heading = uniform((), -np.pi, np.pi)
    xp = share.__array_namespace__()
    if task.sea_heading is not None:
        heading = xp.zeros_like(heading) + math.radians(task.sea_heading)
    spread = xp.arcsin(xp.sqrt(radius) * xp.cos(2 * np.pi * turn))
    # From (k, k + 1]: the logarithm of 0 is none of a frequency's.
    omega = (2 * np.pi / task.sea_period) * frequency((np.arange(1, WAVES + 1) - share) / WAVES)
    # Of a significant height of 1.
    unit = math.sqrt(2 / WAVES) / 4
    amplitude = unit * significant_angle(task) * _wave_axes(heading + spread)
    start = 2 * np.pi * phase[:, None] + xp.zeros_like(amplitude)
    if task.platform:
        orbit = unit * task.sea_height * _orbit(heading + spread)
        amplitude = xp.concatenate((amplitude, orbit), axis=-1)
        start = xp.concatenate((start, start, start[:, :1] + np.pi / 2), axis=-1)
    waves = Waves(amplitude, omega, start)
    still = xp.zeros_like(heading)
    return Scenario(xp.zeros((count, 2), dtype=share.dtype), still, still + task.board_rate, waves)


def _wave_axes(heading: Float[Array, "*batch"]) -> Float[Array, "*batch 2"]:
    """Board angles about X and Y per unit of slope of waves that run in a direction, rad.

    A board that rises to the left turns about +X, one that rises ahead about -Y.
    """
    xp = heading.__array_namespace__()
    return xp.stack((xp.sin(heading), -xp.cos(heading)), axis=-1)


def _orbit(heading: Float[Array, "*batch"]) -> Float[Array, "*batch 3"]:
    """Surge, sway and heave of waves per unit of height, of directions, rad.

    In deep water a particle of the surface moves in a circle: along the heading in phase with the
    slope there, and up a quarter of a period earlier (Airy's theory).
    """
    xp = heading.__array_namespace__()
    return xp.stack((xp.cos(heading), xp.sin(heading), xp.ones_like(heading)), axis=-1)


MOTIONS: dict[str, Callable[[TaskConfig, int, Uniform], Scenario]] = {
    "ramps": _draw_ramps,
    "steps": _draw_steps,
    "sea": _draw_sea,
}
"""Name -> function that draws one scenario from task, number of targets, and `uniform` as of
`draw_scenario`. Each is a case of the one closed form of `board_angle`, so that envs of one batch
may differ in kind. To add one: a row here, and its name in `TaskConfig.board_motions`."""
