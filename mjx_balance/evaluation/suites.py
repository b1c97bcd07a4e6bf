"""The evaluation suites: scenarios, domain parameters and pushes to test a controller with."""

import dataclasses
import math
from collections.abc import Callable

import numpy as np

from mjx_balance.config import DEGREE, RandomizationConfig, TaskConfig
from mjx_balance.config.sea import check_platform
from mjx_balance.config.validation import check_randomization
from mjx_balance.envs.batch import Episodes, stacked
from mjx_balance.errors import InputError, quote, suggest
from mjx_balance.files.validation import check_types
from mjx_balance.robots.catalogue import Robot
from mjx_balance.robots.limits import (
    authority,
    check_delays,
    check_friction,
    greatest_incline,
    scale_ranges,
)
from mjx_balance.task import events, tilt
from mjx_balance.task.pushes import Pushes, draw_velocity, push_decisions
from mjx_balance.task.randomization import DRAWS, draw_params
from mjx_balance.task.sensors import count_draws, draw_errors


class SuiteError(InputError):
    """A suite that does not exist, or does not fit the config; the message says why."""


def _disc(incline: np.ndarray, uniform: np.ndarray) -> np.ndarray:
    """Direction uniform, total tilt uniform up to the incline (paper 3.1)."""
    return tilt.disc_targets(incline[:, None], uniform[..., 0], uniform[..., 1])


def _corner(incline: np.ndarray, uniform: np.ndarray) -> np.ndarray:
    """Both axes at full incline at once, signs at random: the paper's declared weakness."""
    return incline[:, None, None] * np.where(uniform < 0.5, -1.0, 1.0)


@dataclasses.dataclass(frozen=True)
class Suite:
    """A kind of scenario. Pass one of your own wherever a suite's name is accepted."""

    randomization: RandomizationConfig = dataclasses.field(default_factory=RandomizationConfig)
    targets: Callable[[np.ndarray, np.ndarray], np.ndarray] = _disc
    """(n,) inclines in deg, (n, k, 2) uniform numbers -> (n, k, 2) targets in deg, of ramps."""
    motion: str | None = None  #: kind of board motion (`tilt.MOTIONS`) instead of ramps
    platform: bool = False  #: whether the platform of `TaskConfig.platform` moves
    soft: bool = False  #: whether the robot stands on soft servos (`sim.scene.soften`)
    fast: bool = False  #: board speeds uniform from the config's to the authority limit
    steep: bool = False  #: inclines uniform from the config's to the reach of the legs
    tilted: bool = False  #: board and body start tilted, by up to a decision from a fall
    name: str = "own"  #: in results, of a suite that is not in `SUITES`


SUITES: dict[str, Suite] = {
    "paper": Suite(),  # targets in any direction, up to max_incline (paper 3.1)
    "corner": Suite(targets=_corner),  # both axes at max_incline at once
    "noise": Suite(RandomizationConfig(gyro_noise=0.002, accel_noise=0.023)),  # of a data sheet
    "payload": Suite(RandomizationConfig(payload=5.0)),  # 0 to 5 kg on the trunk, off its centre
    "friction": Suite(RandomizationConfig(friction_min=0.4, friction_max=1.0)),
    "gains": Suite(RandomizationConfig(gain_spread=0.2)),  # servo gains off by up to 20%
    "soft": Suite(soft=True),  # servos as soft as public controllers command
    "latency": Suite(RandomizationConfig(latency_share=1.0)),  # every action one decision late
    "push": Suite(RandomizationConfig(push_min=0.2, push_max=0.4)),  # any direction, every 5 s
    "fast": Suite(fast=True),
    "steep": Suite(steep=True),
    "recover": Suite(tilted=True),
    "steps": Suite(motion="steps"),  # jumps of up to two thirds of the fall limit
    "sea": Suite(motion="sea"),  # waves in all directions
    "platform": Suite(motion="sea", platform=True),  # which surges, sways and heaves as well
    "bias": Suite(  # an IMU that is off by what makers allow, mounted half a degree awry
        RandomizationConfig(
            gyro_bias=0.5 * DEGREE,
            gyro_bias_drift=0.01 * DEGREE,
            accel_bias=0.05,
            accel_bias_drift=0.001,
            imu_tilt=0.5 * DEGREE,
        )
    ),
    "encoder": Suite(  # every joint, rad
        RandomizationConfig(encoder_offset=0.02, reading_offset=0.02)
    ),
    "delay": Suite(  # samples and commands that are 0 to 40 ms late, three quarters of it steady
        RandomizationConfig(
            sensor_delay=0.03, sensor_jitter=0.01, command_delay=0.03, command_jitter=0.01
        )
    ),
    "dropout": Suite(RandomizationConfig(dropout=0.1)),  # every tenth IMU sample is lost
    # From a fifth to three fifths of the scenario on:
    "shift": Suite(RandomizationConfig(event_payload=5.0)),  # as `payload`, laid on
    "slip": Suite(RandomizationConfig(event_grip=0.1)),  # one foot keeps 10 to 100% of its friction
    "weak": Suite(RandomizationConfig(event_strength=0.2)),  # one servo 20 to 100% of its stiffness
}
"""By the names of `mjx-balance evaluate --suite`."""
HEADLINE = ("paper", "corner")  #: evaluated after training, in reports and tables


@dataclasses.dataclass(frozen=True)
class Seeds:
    """Seeds of scenarios, one per purpose; training draws from other generators."""

    final: int = 1_000_000  # evaluation after training
    record: int = 2_000_000  # rollouts drawn as figures
    validation: int = 3_000_000  # choice among several training seeds; never reported
    report: int = 4_000_000  # policy against baselines, in a report
    tuning: int = 5_000_000  # gains of the baselines
    held_out: int = 7_000_000  # published results


SEEDS = Seeds()


def check_seed(seed: int) -> None:
    """Raises `SuiteError` for a seed that is not valid."""
    if seed < 0:
        raise SuiteError(f"seed is {seed}; it must not be negative")


def find_suite(suite: str | Suite) -> Suite:
    """Returns a suite by its name, or one of the user's own after a check.

    Raises:
      SuiteError: if there is none, or a field of it has an impossible value.
    """
    if isinstance(suite, str):
        if suite not in SUITES:
            raise SuiteError(f"unknown suite {quote(suite)}; {suggest('suite', suite, SUITES)}")
        return SUITES[suite]
    if not isinstance(suite, Suite):
        raise SuiteError(f"suite is {quote(suite)}; it must be a suite's name, or a Suite")
    check_types(suite.randomization, SuiteError)
    if suite.motion is not None and suite.motion not in tilt.MOTIONS:
        remedy = suggest("motion", suite.motion, tilt.MOTIONS)
        raise SuiteError(f"motion of suite {suite.name} is {quote(suite.motion)}; {remedy}")
    if suite.platform and suite.motion != "sea":
        raise SuiteError(
            f"platform of suite {suite.name} is True, but its motion is {quote(suite.motion)}; a "
            "platform moves with the sea alone: motion must be 'sea'"
        )
    if suite.tilted and suite.motion in ("ramps", "steps"):
        raise SuiteError(
            f"tilted of suite {suite.name} is True, but its motion is {quote(suite.motion)}, which "
            "is on its way when an episode starts; motion must be None or 'sea'"
        )
    return suite


def suite_name(suite: str | Suite) -> str:
    """The name of a suite in results."""
    return suite.name if isinstance(suite, Suite) else suite


def draw_suite(
    task: TaskConfig, robot: Robot, suite: str | Suite, scenarios: int, duration: float, seed: int
) -> Episodes:
    """Draws a suite's episodes, each of `duration` s.

    Scenario k of a seed is the same however many are drawn. Ramps, sensor noise, pushes, other
    motions, starts, sensor errors, events and softness each have their own generator, which
    differs in the last number of its seed.

    Raises:
      ConfigError: if the sea of the config is out of bounds, a decision shorter than the delays, or
        a range of the suite contradicts another one, the task or the robot.
      SuiteError: for an unknown suite, a negative seed, a suite that needs another scene
        (`rollout.suite_scene`), or a board that does not arrive before its next target.
    """
    chosen, name = find_suite(suite), suite_name(suite)
    check_seed(seed)
    if chosen.platform and not task.platform:
        raise SuiteError(
            f"suite {name!r} moves a platform, which the scene does not have; it needs platform "
            "True in its config (evaluation.rollout.suite_scene)"
        )
    count = tilt.num_targets(task, duration)
    rngs = [np.random.default_rng((seed, k)) for k in range(scenarios)]
    uniform = np.asarray([rng.uniform(size=(count, 2)) for rng in rngs])
    others = np.asarray([rng.uniform(size=DRAWS + 2) for rng in rngs])
    rate, incline = np.full(scenarios, task.board_rate), np.full(scenarios, task.max_incline)
    if chosen.fast:
        rate += np.maximum(authority(task, robot) - task.board_rate, 0) * others[:, DRAWS]
    if chosen.steep:
        steepest = greatest_incline(task, robot)
        incline += np.maximum(steepest - task.max_incline, 0) * others[:, DRAWS + 1]
    limit = np.full(scenarios, task.fail_tilt - math.sqrt(2) * task.board_rate * task.ctrl_dt)
    steepest = np.maximum(incline, limit) if chosen.tilted else incline
    longest = float(np.max((steepest + incline) / rate))
    if longest > task.target_period:
        raise SuiteError(
            f"target_period is {task.target_period} s, but in suite {name!r} the board may take "
            f"{longest:.1f} s to its target; the period must not be shorter"
        )
    check_randomization(chosen.randomization, task)
    check_friction(chosen.randomization, robot)
    ranges, errors = scale_ranges(chosen.randomization, robot), None
    check_delays(task, ranges, robot)
    if ranges.sensors_err:
        own = [np.random.default_rng((seed, k, 5)) for k in range(scenarios)]
        numbers = np.asarray([rng.uniform(size=count_draws(robot)) for rng in own])
        errors = draw_errors(ranges, robot, numbers)
    numbers = others[:, :DRAWS]
    if ranges.soft_share:
        own = [np.random.default_rng((seed, k, 7)).uniform(size=1) for k in range(scenarios)]
        numbers = np.hstack((numbers, own))
    params = draw_params(ranges, robot, numbers) if ranges.varies else None
    own = (np.random.default_rng((seed, k, 6)) for k in range(scenarios))
    event = events.sample_event(
        *(ranges, robot, params, round(duration / task.ctrl_dt)),
        lambda count: np.asarray([rng.uniform(size=count) for rng in own]),
    )
    targets = np.asarray(chosen.targets(incline, uniform))
    if targets.shape != uniform.shape:
        raise SuiteError(
            f"targets of suite {name!r} gives shape {targets.shape}; it must be {uniform.shape}: "
            "roll and pitch of every target of every scenario"
        )
    scenario = tilt.Scenario(targets, np.zeros(scenarios), rate)
    if chosen.motion is not None:
        draw = tilt.MOTIONS[chosen.motion]
        still = task if chosen.platform else dataclasses.replace(task, sea_height=0.0)
        check_platform(still)
        own = [np.random.default_rng((seed, k, 3)) for k in range(scenarios)]
        scenario = stacked([draw(still, count, tilt.numpy_uniform(rng)) for rng in own])
    if chosen.tilted:
        own = [np.random.default_rng((seed, k, 4)) for k in range(scenarios)]
        start = tilt.disc_targets(limit, *np.asarray([rng.uniform(size=2) for rng in own]).T)
        scenario = scenario._replace(start=start)
    return Episodes(
        scenario=scenario,
        params=params,
        pushes=_draw_pushes(task, ranges, scenarios, duration, seed),
        rngs=[np.random.default_rng((seed, k, 1)) for k in range(scenarios)],
        errors=errors,
        event=event,
    )


def standing_still(
    task: TaskConfig, robot: Robot, suite: str, scenarios: int, duration: float, seed: int
) -> float:
    """Mean tilt, deg, of a robot that stands still, for comparison; needs no simulation.

    It tilts with the board; after a fall its tilt is `fail_tilt`, as in `rollout.summarize`.

    Raises:
      ConfigError, SuiteError: as `draw_suite`.
    """
    scenario = draw_suite(task, robot, suite, scenarios, duration, seed).scenario
    time = task.sim_dt * np.arange(1, round(duration / task.sim_dt) + 1)
    roll, pitch = np.moveaxis(np.radians(tilt.board_angle(task, scenario, time[None])), -1, 0)
    tilts = np.degrees(np.arccos(np.cos(roll) * np.cos(pitch)))
    fallen = np.maximum.accumulate(tilts > task.fail_tilt, axis=1)
    return float(np.where(fallen, task.fail_tilt, tilts).mean())


def _draw_pushes(
    task: TaskConfig, ranges: RandomizationConfig, scenarios: int, duration: float, seed: int
) -> Pushes | None:
    """Pushes of scenario k are the same however many are drawn and however long they last."""
    due = push_decisions(task, ranges, duration)
    if not len(due):
        return None
    rngs = [np.random.default_rng((seed, k, 2)) for k in range(scenarios)]
    uniform = np.asarray([rng.uniform(size=(len(due), 2)) for rng in rngs])
    return Pushes(draw_velocity(ranges, uniform), np.tile(due, (scenarios, 1)))
