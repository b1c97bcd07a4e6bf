"""Controllers rolled out in plain MuJoCo on all cores. No JAX.

The engine runs as MuJoCo ships it: C, float64, default solver accuracy. From a fall
to the scenario's end the tilt counts as `fail_tilt`, so falling never helps; a
simulation warning or a state that is not finite counts as a fall.
"""

import dataclasses
import time
from collections.abc import Callable
from typing import Any, NamedTuple

import numpy as np
import psutil

from mjx_balance.config import TaskConfig
from mjx_balance.envs.batch import take
from mjx_balance.errors import InputError
from mjx_balance.evaluation.controllers import Controller, View
from mjx_balance.evaluation.suites import find_suite, make_pushes, make_scenarios
from mjx_balance.policy.file import Policy, PolicyError
from mjx_balance.robots.catalogue import RobotError, find_robot
from mjx_balance.robots.limits import authority, greatest_incline
from mjx_balance.sim.engines.mujoco import Motion, MujocoEngine
from mjx_balance.sim.scene import Scene, load_scene
from mjx_balance.task import decision, tilt
from mjx_balance.task.actions import action_table
from mjx_balance.task.pushes import Pushes, kick
from mjx_balance.task.randomization import Conditions
from mjx_balance.task.reward import failed

SETTLED_SECONDS = 3.0
"""End of every target's period in which the board has long been at rest, s."""


TILT_COPIES = 3
"""Arrays of every scenario's tilt at every step that a summary needs at once, float64."""


class EvaluationError(InputError):
    """An evaluation that cannot be run; the message says why."""


def observing(policy: Policy) -> Controller:
    """The policy as a controller: it looks at the observation alone."""
    return lambda view: policy(view.obs)


@dataclasses.dataclass(frozen=True)
class Rollout:
    """What happened, for every scenario and physics step."""

    task: TaskConfig
    tilt: np.ndarray
    """(scenarios, steps) body tilt, deg; fail_tilt from a fall on."""
    fell_at: np.ndarray
    """(scenarios,) step of the fall, or the number of steps."""
    action_mm: np.ndarray
    """(scenarios, decisions) mean of the two axes' height changes, mm; NaN after a fall."""
    qpos: np.ndarray | None
    """(scenarios, steps, nq), if recorded."""
    seconds: float
    """Time spent."""

    @property
    def fell(self) -> np.ndarray:
        """(scenarios,) whether the robot fell."""
        return self.fell_at < self.tilt.shape[1]


class Trials:
    """Scenarios under way; owns the physics and the memories of those that still stand."""

    def __init__(
        self,
        scene: Scene,
        scenarios: tilt.Scenario,
        conditions: Conditions | None = None,
        pushes: Pushes | None = None,
        noise_seed: int = 0,
        threads: int | None = None,
    ):
        """Puts a robot on each board; see `roll_out` for the arguments."""
        count = len(scenarios.phase)
        self.scene, self.task, self.scenarios = scene, scene.config.task, scenarios
        self.pushes = pushes
        self.engine = MujocoEngine(scene, count, conditions, threads)
        self.table = action_table(self.task)
        # One generator per scenario: its noise is the same whoever runs or falls beside it. The
        # last number tells it from the generator that drew the scenario (suites.py).
        self.rngs = [np.random.default_rng((noise_seed, k, 1)) for k in range(count)]
        self.late = np.zeros(count, bool)
        self.imu_noise = np.zeros((count, 6))
        if conditions is not None:
            self.late, self.imu_noise = conditions.latency.astype(bool), conditions.imu_noise
        self.noisy = bool(self.imu_noise.any())
        self.alive = np.arange(count)
        still = np.tile(scene.stance.imu, (count, 1))
        self.memory = decision.start(self.task, scene.robot, still)
        self.samples = np.tile(scene.stance.imu, (count, self.task.sim_steps, 1))
        angles = self.engine.state(self.alive)[0][:, scene.leg_qpos]
        self.obs = decision.observation(self.task, scene.robot, self.memory, angles)

    def decide(self, controller: Controller, number: int) -> "Decision":
        """Lets the controller take decision `number` wherever the robot stands."""
        alive, kicks, noise = self.alive, None, None
        some = tilt.Scenario(*(x[alive] for x in self.scenarios))
        late = self.late[alive]
        qpos, qvel = self.engine.state(alive)
        chosen = controller(View(alive, number, self.obs, self.samples, qpos, qvel, some, late))
        change = chosen if chosen.ndim == 2 else self.table[chosen]
        now = np.full(len(alive), float(number))
        if self.pushes is not None:
            kicks = kick(self.pushes, number)[alive]
        if self.noisy:
            drawn = [self.rngs[k].normal(size=(self.task.sim_steps, 6)) for k in alive]
            noise = self.imu_noise[alive, None] * np.stack(drawn)
        memory, motion, samples, outcome = take(
            self.engine, alive, self.memory, change, late, some, now, kicks, noise
        )
        down = outcome.fell
        self.memory = decision.Memory(*(x[~down] for x in memory))
        self.samples, self.obs, self.alive = samples[~down], outcome.obs[~down], alive[~down]
        return Decision(alive, 1000 * np.abs(change).mean(axis=-1), motion, down)


class Decision(NamedTuple):
    """One decision of the n scenarios whose robot stood until then."""

    ids: np.ndarray
    """(n,)"""
    action_mm: np.ndarray
    """(n,) mean of the two axes' height changes, mm."""
    motion: Motion
    down: np.ndarray
    """(n,) whether the robot has fallen."""


class _Record:
    """What is kept of a rollout; from a fall on, the tilt counts as `fail_tilt`."""

    def __init__(self, scene: Scene, count: int, decisions: int, keep_qpos: bool):
        self.task = scene.config.task
        steps = decisions * self.task.sim_steps
        self.tilt = np.full((count, steps), self.task.fail_tilt)
        self.action_mm = np.full((count, decisions), np.nan)
        self.fell_at = np.full(count, steps)
        self.qpos = np.tile(scene.stance.qpos, (count, steps, 1)) if keep_qpos else None

    def add(self, number: int, made: Decision) -> None:
        """Writes decision `number` down."""
        sim_steps = self.task.sim_steps
        ids, motion, down = made.ids, made.motion, made.down
        span = slice(number * sim_steps, (number + 1) * sim_steps)
        bad = failed(self.task, motion.tilt)
        # Where only the engine has warned, all of the decision counts as fallen.
        first = np.where(bad.any(axis=-1), bad.argmax(axis=-1), 0)
        after_fall = down[:, None] & (np.arange(sim_steps) >= first[:, None])
        self.tilt[ids, span] = np.where(after_fall, self.task.fail_tilt, motion.tilt)
        self.fell_at[ids[down]] = number * sim_steps + first[down]
        self.action_mm[ids, number] = made.action_mm
        if self.qpos is not None:
            self.qpos[ids, number * sim_steps :] = motion.qpos[:, -1:]
            self.qpos[ids, span] = motion.qpos

    def rollout(self, seconds: float) -> Rollout:
        """The finished rollout."""
        return Rollout(self.task, self.tilt, self.fell_at, self.action_mm, self.qpos, seconds)


def roll_out(
    scene: Scene,
    controller: Controller,
    scenarios: tilt.Scenario,
    duration: float,
    threads: int | None = None,
    record: bool = False,
    progress: Callable[[float], None] = lambda share: None,
    conditions: Conditions | None = None,
    pushes: Pushes | None = None,
    noise_seed: int = 0,
) -> Rollout:
    """Runs a controller in plain MuJoCo.

    Args:
      scene: task, model and stance.
      controller: chooses action indices or height changes.
      scenarios: targets (n, k, 2), phase (n,), rate (n,).
      duration: s, rounded up to whole decisions.
      threads: worker threads; all cores if none.
      record: whether to keep every qpos.
      progress: called with the share done.
      conditions: of every scenario (n,); nominal if none.
      pushes: of every scenario (n,); none if none.
      noise_seed: seed of the sensor noise.

    Returns:
      The rollout of n scenarios.
    """
    trials = Trials(scene, scenarios, conditions, pushes, noise_seed, threads)
    return _rolled_out(trials, controller, duration, record, progress)


def _rolled_out(
    trials: Trials,
    controller: Controller,
    duration: float,
    record: bool,
    progress: Callable[[float], None],
) -> Rollout:
    decisions = int(np.ceil(duration / trials.task.ctrl_dt - 1e-9))
    kept = _Record(trials.scene, len(trials.alive), decisions, record)
    began = time.perf_counter()
    for number in range(decisions):
        kept.add(number, trials.decide(controller, number))
        progress((number + 1) / decisions)
        if not len(trials.alive):
            break
    return kept.rollout(time.perf_counter() - began)


def summarize(rollout: Rollout, suite: str, duration: float, seed: int) -> dict[str, Any]:
    """The evaluation as JSON values, tilt statistics over every physics step."""
    tilts = rollout.tilt
    p50, p95, p99 = np.percentile(tilts, (50, 95, 99))
    falls = int(rollout.fell.sum())
    return {
        "suite": suite,
        "scenarios": len(tilts),
        "duration_s": float(duration),
        "seed": seed,
        "falls": falls,
        "fall_rate": falls / len(tilts),
        "tilt_deg": {
            "mean": float(tilts.mean()),
            "rms": float(np.sqrt(np.mean(tilts**2))),
            "p50": float(p50),
            "p95": float(p95),
            "p99": float(p99),
            "max": float(tilts.max()),
        },
        "action_mm_mean": float(np.nanmean(rollout.action_mm)),
        "action_mm_settled": settled_action(rollout),
        "physics_steps_per_second": float(rollout.fell_at.sum() / rollout.seconds),
    }


def settled_action(rollout: Rollout) -> float | None:
    """Mean commanded height change, mm per decision and axis, while the board rests.

    Taken over the last `SETTLED_SECONDS` of every period of a standing robot; none if
    there is no such decision.
    """
    task = rollout.task
    until = task.target_period - np.arange(rollout.action_mm.shape[1]) * task.ctrl_dt
    until = until % task.target_period
    values = rollout.action_mm[:, (until > 1e-9) & (until <= SETTLED_SECONDS + 1e-9)]
    return None if np.isnan(values).all() else float(np.nanmean(values))


def policy_scene(policy: Policy, visual: bool = False, robot: str | None = None) -> Scene:
    """Builds the scene a policy was trained in.

    Args:
      policy: says which.
      visual: as `build_model`.
      robot: what its robot is called here; as in training if none.

    Raises:
      PolicyError: if the robot is not here, is another one, or today's scene files or engine
        give another scene.
    """
    name = robot or policy.config.robot
    try:
        found = find_robot(name)
    except RobotError as error:
        raise PolicyError(f"the policy's robot is {policy.robot.name!r}, but {error}") from error
    if found != policy.robot:
        raise PolicyError(
            f"the policy was trained for robot {policy.robot.name!r} "
            f"({policy.robot.total_mass:.1f} kg), and {name} is another one "
            f"({found.total_mass:.1f} kg, or legs or servos that differ)"
        )
    scene = load_scene(dataclasses.replace(policy.config, robot=name), visual)
    if scene.hash != policy.scene_hash:
        raise PolicyError(
            f"the policy was trained in scene {policy.scene_hash}, but scenes/ now gives "
            f"{scene.hash}; use the scene files it was trained with, or train again"
        )
    return scene


def evaluate(
    policy: Policy,
    suite: str,
    scenarios: int,
    duration: float,
    seed: int,
    progress: Callable[[float], None] = lambda share: None,
) -> dict[str, Any]:
    """Evaluates a policy in plain MuJoCo; returns the JSON of `summarize`.

    Raises:
      EvaluationError: if there are no scenarios or no time.
      SuiteError: for an unknown suite.
      PolicyError: if the policy belongs to another scene.
    """
    scene = policy_scene(policy)
    rollout = run_suite(scene, observing(policy), suite, scenarios, duration, seed, progress)
    return summarize(rollout, suite, duration, seed)


def check_fits(task: TaskConfig, scenarios: int, duration: float, recorded: int = 0) -> None:
    """Refuses an evaluation of nothing, or of more than the memory takes.

    Args:
      task: gives the physics step.
      scenarios: how many.
      duration: of each, s.
      recorded: numbers kept of every physics step besides the tilt.

    Raises:
      EvaluationError: with the estimate.
    """
    if scenarios < 1:
        raise EvaluationError(f"scenarios is {scenarios}; it must be at least 1")
    if not (np.isfinite(duration) and duration > 0):
        raise EvaluationError(f"duration is {duration}; it must be a number of seconds above 0")
    steps = scenarios * duration / task.sim_dt
    needed = 8 * steps * (TILT_COPIES + recorded)
    available = psutil.virtual_memory().available
    if needed > available:
        raise EvaluationError(
            f"scenarios is {scenarios} and duration {duration:g} s: that takes about "
            f"{needed / 2**30:,.1f} GiB, and {available / 2**30:.1f} GiB are free; lower one"
        )


def run_suite(
    scene: Scene,
    controller: Controller,
    suite: str,
    scenarios: int,
    duration: float,
    seed: int,
    progress: Callable[[float], None] = lambda share: None,
    record: bool = False,
) -> Rollout:
    """Rolls a controller out on a suite's scenarios.

    Raises:
      EvaluationError: if there are no scenarios or no time, or too much for the memory.
      SuiteError: as `make_scenarios`.
    """
    check_fits(scene.config.task, scenarios, duration, scene.model.nq if record else 0)
    trials = suite_trials(scene, suite, scenarios, duration, seed)
    return _rolled_out(trials, controller, duration, record, progress)


def suite_trials(
    scene: Scene,
    suite: str,
    scenarios: int,
    duration: float,
    seed: int,
    threads: int | None = None,
) -> Trials:
    """A suite's scenarios, boards level and robots standing; raises as `make_scenarios`."""
    drawn, conditions = make_scenarios(scene.config, suite, scenarios, duration, seed)
    varied = find_suite(suite).randomization.varies
    pushes = make_pushes(scene.config, suite, scenarios, duration, seed)
    return Trials(scene, drawn, conditions if varied else None, pushes, seed, threads)


@dataclasses.dataclass(frozen=True)
class Envelope:
    """How a controller fares over the greatest incline and the speed of the board."""

    inclines: list[float]
    """Board angle on both axes at once, deg."""
    rates: list[float]
    """Board speed on each axis, deg/s."""
    fall_rate: list[list[float]]
    """[incline][rate] share of the scenarios that end in a fall."""
    mean_tilt: list[list[float]]
    """[incline][rate] deg, a fall counting as fail_tilt to the end."""
    authority: float
    """Speed beyond which the action set cannot follow, deg/s (`limits.authority`)."""
    reach: float
    """Incline beyond which the legs are too short, deg (`limits.greatest_incline`)."""
    scenarios: int
    """Per cell."""
    duration_s: float
    seed: int

    @property
    def fall_free_share(self) -> float:
        """Share of the cells that can be followed in which nothing falls."""
        feasible = (np.asarray(self.inclines)[:, None] <= self.reach) & (
            np.asarray(self.rates) <= self.authority
        )
        return float(np.mean(np.asarray(self.fall_rate)[feasible] == 0))


ENVELOPE_INCLINES = tuple(np.arange(2.0, 12.1, 1.0).tolist())
ENVELOPE_RATES = tuple(np.arange(2.5, 6.1, 0.25).tolist())


def envelope(
    scene: Scene,
    controller: Controller,
    scenarios: int,
    duration: float,
    seed: int,
    progress: Callable[[float], None] = lambda share: None,
) -> Envelope:
    """Maps falls and tilt over inclines and board speeds, with targets of suite `corner`.

    Raises:
      EvaluationError: if there are no scenarios.
    """
    if scenarios < 1:
        raise EvaluationError(f"scenarios is {scenarios}; it must be at least 1")
    cells = [(i, r) for i in ENVELOPE_INCLINES for r in ENVELOPE_RATES]
    # So that even the slowest board arrives; `corner` alone needs less.
    slowest = 2 * max(ENVELOPE_INCLINES) / min(ENVELOPE_RATES)
    task = scene.config.task
    task = dataclasses.replace(task, target_period=max(task.target_period, slowest))
    scene = dataclasses.replace(scene, config=dataclasses.replace(scene.config, task=task))
    drawn, _ = make_scenarios(scene.config, "corner", len(cells) * scenarios, duration, seed)
    incline, rate = np.repeat(np.asarray(cells), scenarios, axis=0).T
    signs = np.sign(drawn.targets)
    drawn = drawn._replace(targets=incline[:, None, None] * signs, rate=rate)
    rollout = roll_out(scene, controller, drawn, duration, progress=progress)
    shape = (len(ENVELOPE_INCLINES), len(ENVELOPE_RATES), scenarios)
    return Envelope(
        inclines=list(ENVELOPE_INCLINES),
        rates=list(ENVELOPE_RATES),
        fall_rate=rollout.fell.reshape(shape).mean(axis=-1).tolist(),
        mean_tilt=rollout.tilt.mean(axis=-1).reshape(shape).mean(axis=-1).tolist(),
        authority=authority(scene.config.task, scene.robot),
        reach=greatest_incline(task, scene.robot),
        scenarios=scenarios,
        duration_s=duration,
        seed=seed,
    )
