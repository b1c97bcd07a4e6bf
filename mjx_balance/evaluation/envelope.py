"""Where a controller falls: a map over the greatest incline and the speed of the board."""

import dataclasses
from collections.abc import Sequence

import numpy as np

from mjx_balance.envs.batch import Episodes
from mjx_balance.evaluation.controllers import Controller
from mjx_balance.evaluation.rollout import EvaluationError, Progress, roll_out
from mjx_balance.evaluation.suites import draw_suite
from mjx_balance.robots.limits import authority, greatest_incline
from mjx_balance.sim.scene import Scene


@dataclasses.dataclass(frozen=True)
class Envelope:
    """How a controller fares over the greatest incline and the speed of the board."""

    inclines: list[float]  #: board angle on both axes at once, deg
    rates: list[float]  #: board speed on each axis, deg/s
    fall_rate: list[list[float]]  #: [incline][rate] share of the scenarios that end in a fall
    mean_tilt: list[list[float]]  #: [incline][rate] deg, a fall counting as fail_tilt to the end
    authority: float  #: speed beyond which the action set cannot follow, deg/s (`limits.authority`)
    reach: float  #: incline beyond which the legs are too short, deg (`limits.greatest_incline`)
    scenarios: int  #: per cell
    duration_s: float
    seed: int

    @property
    def fall_free_share(self) -> float | None:
        """Share of the cells that can be followed in which nothing falls; None: there is none."""
        feasible = (np.asarray(self.inclines)[:, None] <= self.reach) & (
            np.asarray(self.rates) <= self.authority
        )
        free = np.asarray(self.fall_rate)[feasible] == 0
        return float(free.mean()) if free.size else None


ENVELOPE_INCLINES = tuple(np.arange(2.0, 12.1, 1.0).tolist())
ENVELOPE_RATES = tuple(np.arange(2.5, 6.1, 0.25).tolist())


def envelope(
    scene: Scene,
    controller: Controller,
    scenarios: int,
    duration: float,
    seed: int,
    progress: Progress = lambda share: None,
    *,
    inclines: Sequence[float] = ENVELOPE_INCLINES,
    rates: Sequence[float] = ENVELOPE_RATES,
) -> Envelope:
    """Maps falls and tilt over inclines and board speeds, with targets of suite `corner`.

    Args:
      scene: of the controller.
      controller: to map.
      scenarios: per cell of the map.
      duration: of a scenario, s.
      seed: of the scenarios.
      progress: takes the share done.
      inclines: greatest board angles, deg.
      rates: board speeds, deg/s.

    Raises:
      EvaluationError: if there are no scenarios.
    """
    if scenarios < 1:
        raise EvaluationError(f"scenarios is {scenarios}; it must be at least 1")
    cells = [(i, r) for i in inclines for r in rates]
    # So that even the slowest board arrives; `corner` alone needs less.
    slowest = 2 * max(inclines) / min(rates)
    task = scene.task
    task = dataclasses.replace(task, target_period=max(task.target_period, slowest))
    scene = dataclasses.replace(scene, task=task)
    drawn = draw_suite(
        scene.task, scene.robot, "corner", len(cells) * scenarios, duration, seed
    ).scenario
    incline, rate = np.repeat(np.asarray(cells), scenarios, axis=0).T
    drawn = drawn._replace(targets=incline[:, None, None] * np.sign(drawn.targets), rate=rate)
    rollout = roll_out(scene, controller, Episodes(drawn), duration, progress=progress)
    shape = (len(inclines), len(rates), scenarios)
    return Envelope(
        inclines=list(inclines),
        rates=list(rates),
        fall_rate=rollout.fell.reshape(shape).mean(axis=-1).tolist(),
        mean_tilt=rollout.tilt.mean(axis=-1).reshape(shape).mean(axis=-1).tolist(),
        authority=authority(scene.task, scene.robot),
        reach=greatest_incline(task, scene.robot),
        scenarios=scenarios,
        duration_s=duration,
        seed=seed,
    )
