"""Controllers rolled out in plain MuJoCo on all cores. No JAX.

The engine runs as MuJoCo ships it: C, float64, default solver accuracy. From a fall
to the scenario's end the tilt counts as `fail_tilt`, so falling never helps; a
simulation warning or a state that is not finite counts as a fall.
"""

import dataclasses
import time
from collections.abc import Callable
from typing import Any

import numpy as np
import psutil

from mjx_balance.config import TaskConfig
from mjx_balance.envs.batch import BatchEnv, Episodes, rows
from mjx_balance.errors import InputError
from mjx_balance.evaluation.controllers import Controller, View
from mjx_balance.evaluation.suites import draw_suite
from mjx_balance.evaluation.summary import summarize
from mjx_balance.policy.file import Policy, PolicyError
from mjx_balance.robots.catalogue import RobotError, find_robot
from mjx_balance.sim.scene import Scene, load_scene
from mjx_balance.task.actions import action_table
from mjx_balance.task.reward import failed
from mjx_balance.task.step import Outcome

TILT_COPIES = 3
"""Arrays of every scenario's tilt at every step that a summary needs at once, float64."""

Progress = Callable[[float], None]
"""Takes the share done."""


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


class _Record:
    """What is recorded of a rollout; from a fall on, the tilt counts as `fail_tilt`."""

    def __init__(self, scene: Scene, count: int, decisions: int, with_qpos: bool):
        self.task = scene.config.task
        steps = decisions * self.task.sim_steps
        self.tilt = np.full((count, steps), self.task.fail_tilt)
        self.action_mm = np.full((count, decisions), np.nan)
        self.fell_at = np.full(count, steps)
        self.qpos = np.tile(scene.stance.qpos, (count, steps, 1)) if with_qpos else None

    def add(
        self, number: int, ids: np.ndarray, change: np.ndarray, outcome: Outcome, path: np.ndarray
    ) -> None:
        """Records decision `number` of scenarios `ids`.

        Args:
          number: from 0.
          ids: (n,) scenarios whose robot stood until then.
          change: (n, 2) a_x and a_y, m.
          outcome: (n, ...) of the decision.
          path: (n, sim_steps, nq) states that it passed through.
        """
        sim_steps = self.task.sim_steps
        span = slice(number * sim_steps, (number + 1) * sim_steps)
        # Where the simulation diverged, `fail_tilt` stands at every step: none is beyond it.
        first = failed(self.task, outcome.tilt).argmax(axis=-1)
        fallen = outcome.terminated[:, None] & (np.arange(sim_steps) >= first[:, None])
        self.tilt[ids, span] = np.where(fallen, self.task.fail_tilt, outcome.tilt)
        down = outcome.terminated
        self.fell_at[ids[down]] = number * sim_steps + first[down]
        self.action_mm[ids, number] = 1000 * np.abs(change).mean(axis=-1)
        if self.qpos is not None:
            self.qpos[ids, number * sim_steps :] = path[:, -1:]
            self.qpos[ids, span] = path

    def rollout(self, seconds: float) -> Rollout:
        """The finished rollout."""
        return Rollout(self.task, self.tilt, self.fell_at, self.action_mm, self.qpos, seconds)


def look(env: BatchEnv, ids: np.ndarray, number: int, obs: np.ndarray, imu: np.ndarray) -> View:
    """What envs `ids` show before decision `number`; obs and imu are of their last outcome."""
    delay = np.zeros(len(ids)) if env.state.params is None else env.state.params.delay[ids]
    return View(
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
      controller: chooses action indices or height changes.
      episodes: n of them.
      duration: s, rounded up to whole decisions.
      record: whether to record every qpos.
      progress: called with the share done.

    Returns:
      The rollout of n scenarios.
    """
    task, env = scene.config.task, BatchEnv(scene, episodes)
    decisions = int(np.ceil(duration / task.ctrl_dt - 1e-9))
    kept = _Record(scene, env.num_envs, decisions, record)
    standing, obs = np.arange(env.num_envs), env.initial_obs
    imu = np.tile(scene.stance.imu, (env.num_envs, task.sim_steps, 1))
    table, began = action_table(task), time.perf_counter()
    for number in range(decisions):
        action = controller(look(env, standing, number, obs, imu))
        change = action if action.ndim == 2 else table[action]
        outcome = env.step(change, standing)
        kept.add(number, standing, change, outcome, env.path)
        up = ~outcome.terminated
        standing, obs, imu = standing[up], outcome.obs[up], outcome.imu[up]
        progress((number + 1) / decisions)
        if not len(standing):
            break
    return kept.rollout(time.perf_counter() - began)


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
        robot_here = find_robot(name)
    except RobotError as error:
        raise PolicyError(f"the policy's robot is {policy.robot.name!r}, but {error}") from error
    if robot_here != policy.robot:
        raise PolicyError(
            f"the policy was trained for robot {policy.robot.name!r} "
            f"({policy.robot.total_mass:.1f} kg), and {name} is another one "
            f"({robot_here.total_mass:.1f} kg, or legs or servos that differ)"
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
    progress: Progress = lambda share: None,
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
    """Refuses an evaluation of nothing, or of more than the memory holds.

    Args:
      task: gives the physics step.
      scenarios: how many.
      duration: of each, s.
      recorded: numbers recorded of every physics step besides the tilt.

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
    progress: Progress = lambda share: None,
    record: bool = False,
) -> Rollout:
    """Rolls a controller out on a suite's scenarios.

    Raises:
      EvaluationError: if there are no scenarios or no time, or too much for the memory.
      SuiteError: as `draw_suite`.
    """
    check_fits(scene.config.task, scenarios, duration, scene.model.nq if record else 0)
    episodes = draw_suite(scene.config, suite, scenarios, duration, seed)
    return roll_out(scene, controller, episodes, duration, record, progress)
