"""Rolls controllers out in plain MuJoCo on all cores, and summarises the result. No JAX.

The engine runs as MuJoCo ships it: C, float64, default solver accuracy. From a fall
to the scenario's end the tilt counts as `fail_tilt`, so falling never helps; a
simulation warning or a state that is not finite counts as a fall.
"""

import dataclasses
import time
from collections.abc import Callable
from typing import Any, Protocol

import numpy as np

from mjx_balance.config import Config, TaskConfig
from mjx_balance.envs.batch import BatchEnv, Episodes, rows
from mjx_balance.errors import InputError, quote
from mjx_balance.evaluation.controllers import Controller, View
from mjx_balance.evaluation.suites import Suite, draw_suite, find_suite, suite_name
from mjx_balance.machine import available_memory
from mjx_balance.policy.file import PolicyError
from mjx_balance.robots.catalogue import Robot, RobotError, find_robot, shipped
from mjx_balance.sim.scene import Scene, load_scene, soften
from mjx_balance.task.actions import action_table
from mjx_balance.task.reward import failed
from mjx_balance.task.step import Outcome

TILT_COPIES = 3  #: arrays of all tilts, float64, that a summary needs at once
SETTLED_SECONDS = 3.0  #: end of every target's period in which the board has long been at rest, s
Progress = Callable[[float], None]  #: takes the share done


class EvaluationError(InputError):
    """An evaluation that cannot be run; the message says why."""


class GreedyPolicy(Protocol):
    """Attributes that an evaluation needs of a policy."""

    config: Config
    robot: Robot
    scene_hash: str

    def command(self, obs: np.ndarray) -> np.ndarray:
        """Height changes (n, 2), m, for observations (n, obs_size)."""
        ...


def observing(policy: GreedyPolicy) -> Controller:
    """The policy as a controller that sees only the observation."""
    return lambda view: policy.command(view.obs)


@dataclasses.dataclass(frozen=True)
class Rollout:
    """What happened, for every scenario and physics step."""

    task: TaskConfig
    tilt: np.ndarray  #: (scenarios, steps) body tilt, deg; fail_tilt from a fall on
    fell_at: np.ndarray  #: (scenarios,) step of the fall, or the number of steps
    action_mm: np.ndarray  #: (scenarios, decisions) mean height change, mm; NaN after a fall
    qpos: np.ndarray | None  #: (scenarios, steps, nq), if recorded
    seconds: float  #: time spent

    @property
    def fell(self) -> np.ndarray:
        """(scenarios,) whether the robot fell."""
        return self.fell_at < self.tilt.shape[1]


def look(env: BatchEnv, ids: np.ndarray, number: int, obs: np.ndarray, imu: np.ndarray) -> View:
    """What envs `ids` show before decision `number`; obs and imu are of their last outcome."""
    delay = np.zeros(len(ids)) if env.state.params is None else env.state.params.delay[ids]
    return View(
        scene=env.scene,
        ids=ids,
        env_steps=number,
        obs=obs,
        imu=imu,
        qpos=env.qpos[ids],
        qvel=env.qvel[ids],
        scenario=rows(env.state.scenario, ids),
        delayed=delay > 0,
    )


def roll_out(
    scene: Scene,
    controller: Controller,
    episodes: Episodes,
    duration: float,
    record: bool = False,
    progress: Progress = lambda share: None,
) -> Rollout:
    """Runs a controller in plain MuJoCo.

    Args:
      scene: task, model and stance.
      controller: chooses the actions.
      episodes: of each scenario.
      duration: s, rounded up to whole decisions.
      record: whether to record every qpos.
      progress: called with the share done.
    """
    task, env = scene.task, BatchEnv(scene, episodes)
    count, decisions = env.num_envs, int(np.ceil(duration / task.ctrl_dt - 1e-9))
    steps = decisions * task.sim_steps
    rollout = Rollout(
        task=task,
        tilt=np.full((count, steps), task.fail_tilt),
        fell_at=np.full(count, steps),
        action_mm=np.full((count, decisions), np.nan),
        qpos=np.tile(scene.stance.qpos, (count, steps, 1)) if record else None,
        seconds=0.0,
    )
    ids, obs = np.arange(count), env.initial_obs
    imu = np.repeat(env.state.memory.imu[:, -1:], task.sim_steps, axis=1)
    table, began = action_table(task), time.perf_counter()
    for number in range(decisions):
        action = controller(look(env, ids, number, obs, imu))
        change = action if action.ndim == 2 else table[action]
        outcome = env.step(change, ids)
        _record(rollout, number, ids, change, outcome, env.path)
        up = ~outcome.terminated
        ids, obs, imu = ids[up], outcome.obs[up], outcome.imu[up]
        progress((number + 1) / decisions)
        if not len(ids):
            break
    return dataclasses.replace(rollout, seconds=time.perf_counter() - began)


def _record(
    rollout: Rollout,
    number: int,
    ids: np.ndarray,
    change: np.ndarray,
    outcome: Outcome,
    path: np.ndarray,
) -> None:
    """Writes decision `number` of scenarios `ids` (n,), whose robots stood until then."""
    task, fallen = rollout.task, outcome.terminated
    span = slice(number * task.sim_steps, (number + 1) * task.sim_steps)
    # A diverged decision has `fail_tilt` at every step, so argmax of all False is 0: it counts as
    # fallen from its start.
    first = failed(task, outcome.tilt).argmax(axis=-1)
    after = fallen[:, None] & (np.arange(task.sim_steps) >= first[:, None])
    rollout.tilt[ids, span] = np.where(after, task.fail_tilt, outcome.tilt)
    rollout.fell_at[ids[fallen]] = span.start + first[fallen]
    rollout.action_mm[ids, number] = 1000 * np.abs(change).mean(axis=-1)
    if rollout.qpos is not None:
        rollout.qpos[ids, span] = path
        rollout.qpos[ids[fallen], span.stop :] = path[fallen, -1:]


def summarize(rollout: Rollout, suite: str | Suite, duration: float, seed: int) -> dict[str, Any]:
    """The evaluation as JSON values, tilt statistics over every physics step."""
    tilts, falls = rollout.tilt, int(rollout.fell.sum())
    ramps = find_suite(suite).motion is None  # other motions rest at other times
    p50, p95, p99 = np.percentile(tilts, (50, 95, 99)).tolist()
    return {
        "suite": suite_name(suite),
        "scenarios": len(tilts),
        "duration_s": float(duration),
        "seed": seed,
        "falls": falls,
        "fall_rate": falls / len(tilts),
        "tilt_deg": {
            "mean": float(tilts.mean()),
            "rms": float(np.sqrt(np.mean(tilts**2))),
            "p50": p50,
            "p95": p95,
            "p99": p99,
            "max": float(tilts.max()),
        },
        "action_mm_mean": float(np.nanmean(rollout.action_mm)),
        "action_mm_settled": settled_action(rollout) if ramps else None,
        "physics_steps_per_second": float(rollout.fell_at.sum() / rollout.seconds),
    }


def settled_action(rollout: Rollout) -> float | None:
    """Mean height change, mm, in each period's last `SETTLED_SECONDS`; None without decisions."""
    task = rollout.task
    until = task.target_period - np.arange(rollout.action_mm.shape[1]) * task.ctrl_dt
    until = until % task.target_period
    values = rollout.action_mm[:, (until > 1e-9) & (until <= SETTLED_SECONDS + 1e-9)]
    return None if np.isnan(values).all() else float(np.nanmean(values))


def policy_scene(policy: GreedyPolicy, robot: str | None = None) -> Scene:
    """Builds the scene a policy was trained in.

    Args:
      policy: may come from a stranger. So the robot that it names is never opened as a file or
        package: without `robot`, it must be a shipped one.
      robot: the policy's robot on this machine, as in `Config.robot`.

    Raises:
      PolicyError: if the robot is missing or another one, or if the current scene files or
        engine give another scene.
    """
    name = robot or policy.config.robot
    if robot is None and name not in shipped():
        raise PolicyError(
            f"the policy's robot is {quote(name)}; a policy opens no file but its own: name the "
            "robot's file with --robot (in Python: robot=)"
        )
    try:
        robot_here = find_robot(name)
    except RobotError as error:
        raise PolicyError(
            f"the policy's robot is {quote(policy.robot.name)}, but {error}"
        ) from error
    if robot_here != policy.robot:
        raise PolicyError(
            f"the policy was trained for robot {quote(policy.robot.name)} "
            f"({policy.robot.total_mass:.1f} kg), and {name} is another one "
            f"({robot_here.total_mass:.1f} kg, or legs or servos that differ)"
        )
    scene = load_scene(dataclasses.replace(policy.config, robot=name))
    if scene.hash != policy.scene_hash:
        raise PolicyError(
            f"the policy was trained in scene {policy.scene_hash}, but scenes/ now gives "
            f"{scene.hash}; use the scene files it was trained with, or train again"
        )
    return scene


def suite_scene(scene: Scene, suite: str | Suite) -> Scene:
    """The scene in which a suite runs: this one, or one with a platform, soft servos or both.

    Raises:
      SuiteError: as `find_suite`.
    """
    chosen = find_suite(suite)
    if chosen.platform and not scene.task.platform:
        task = dataclasses.replace(scene.task, platform=True)
        scene = load_scene(Config(robot=scene.robot_source, task=task))
    return soften(scene) if chosen.soft else scene


def evaluate(
    policy: GreedyPolicy,
    suite: str | Suite,
    scenarios: int,
    duration: float,
    seed: int,
    progress: Progress = lambda share: None,
    robot: str | None = None,
) -> dict[str, Any]:
    """Evaluates a policy in plain MuJoCo; returns the JSON of `summarize`.

    `robot` is as in `policy_scene`.

    Raises:
      ConfigError, EvaluationError, SuiteError: as `run_suite`.
      PolicyError: as `policy_scene`.
    """
    scene = policy_scene(policy, robot)
    rollout = run_suite(scene, observing(policy), suite, scenarios, duration, seed, progress)
    return summarize(rollout, suite, duration, seed)


def check_fits(task: TaskConfig, scenarios: int, duration: float, recorded: int = 0) -> None:
    """Refuses an evaluation without scenarios or time, or of more than the memory holds.

    Its scenarios last `duration` s; `recorded` values are stored per physics step, besides the
    tilt.

    Raises:
      EvaluationError: with the estimate.
    """
    if scenarios < 1:
        raise EvaluationError(f"scenarios is {scenarios}; it must be at least 1")
    if not (np.isfinite(duration) and duration > 0):
        raise EvaluationError(f"duration is {duration}; it must be a number of seconds above 0")
    steps = scenarios * duration / task.sim_dt
    needed = 8 * steps * (TILT_COPIES + recorded)
    available = available_memory()
    if needed > available:
        raise EvaluationError(
            f"scenarios is {scenarios} and duration {duration:g} s: that takes about "
            f"{needed / 2**30:,.1f} GiB, and {available / 2**30:.1f} GiB are free; lower one"
        )


def run_suite(
    scene: Scene,
    controller: Controller,
    suite: str | Suite,
    scenarios: int,
    duration: float,
    seed: int,
    progress: Progress = lambda share: None,
    record: bool = False,
) -> Rollout:
    """Rolls a controller out on a suite's scenarios, in `suite_scene`.

    Raises:
      EvaluationError: if there are no scenarios or no time, or too much for the memory.
      ConfigError, SuiteError: as `draw_suite`.
    """
    scene = suite_scene(scene, suite)
    check_fits(scene.task, scenarios, duration, scene.model.nq if record else 0)
    episodes = draw_suite(scene.task, scene.robot, suite, scenarios, duration, seed)
    return roll_out(scene, controller, episodes, duration, record, progress)
