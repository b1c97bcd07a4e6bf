"""Suites of tilt scenarios rolled out in plain MuJoCo on all cores. No JAX.

The engine runs as MuJoCo ships it: C, float64, default solver accuracy. From a fall
to the scenario's end the tilt counts as `fail_tilt`, so falling never helps; a
simulation warning or a state that is not finite counts as a fall.
"""

import dataclasses
import os
import time
from collections.abc import Callable
from typing import Any

import numpy as np
from mujoco.batch import Batch

from mjx_balance.config import Config
from mjx_balance.plant import decision_ctrl, observation, standing_heights
from mjx_balance.policy import Policy, PolicyError
from mjx_balance.scene import Scene, load_scene
from mjx_balance.task import tilt
from mjx_balance.task.actions import action_table, apply_action
from mjx_balance.task.observation import extend_history
from mjx_balance.task.reward import body_tilt, failed

Controller = Callable[[np.ndarray], np.ndarray]
"""Maps observations (batch, obs_size) to action indices (batch,)."""


class EvaluationError(ValueError):
    """An evaluation that cannot be run; the message says why."""


def _paper_targets(config: Config, rng: np.random.Generator, shape: tuple[int, int]) -> np.ndarray:
    """Direction uniform, total tilt uniform up to max_incline (paper 3.1)."""
    return tilt.disc_targets(config.task, rng.uniform(size=shape), rng.uniform(size=shape))


def _corner_targets(config: Config, rng: np.random.Generator, shape: tuple[int, int]) -> np.ndarray:
    """Both axes at full incline at once, signs at random: the paper's declared weakness."""
    return config.task.max_incline * rng.choice([-1.0, 1.0], (*shape, 2))


SUITES: dict[str, Callable[[Config, np.random.Generator, tuple[int, int]], np.ndarray]] = {
    "paper": _paper_targets,
    "corner": _corner_targets,
}
"""Name -> targets (scenarios, n, 2) in deg."""


def make_scenarios(
    config: Config, suite: str, scenarios: int, duration: float, seed: int
) -> tilt.Scenario:
    """Draws a suite's scenarios.

    Scenario k of a seed is the same however many are drawn.

    Raises:
      EvaluationError: for an unknown suite.
    """
    if suite not in SUITES:
        raise EvaluationError(f"unknown suite {suite!r}; known suites: {', '.join(SUITES)}")
    count = tilt.num_targets(config.task, duration)
    rngs = [np.random.default_rng((seed, k)) for k in range(scenarios)]
    targets = [SUITES[suite](config, rng, (1, count))[0] for rng in rngs]
    return tilt.Scenario(np.asarray(targets), np.zeros(scenarios))


@dataclasses.dataclass(frozen=True)
class Rollout:
    """What happened, for every scenario and physics step."""

    config: Config
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


def roll_out(
    scene: Scene,
    config: Config,
    controller: Controller,
    scenarios: tilt.Scenario,
    duration: float,
    threads: int | None = None,
    record: bool = False,
    progress: Callable[[float], None] = lambda share: None,
) -> Rollout:
    """Runs a controller in plain MuJoCo.

    Args:
      scene: model and stance.
      config: the task.
      controller: sees observations, chooses action indices.
      scenarios: targets (n, k, 2), phase (n,).
      duration: s, rounded up to whole decisions.
      threads: worker threads; all cores if none.
      record: whether to keep every qpos.
      progress: called with the share done.

    Returns:
      The rollout of n scenarios.
    """
    task, robot = config.task, config.robot
    count = len(scenarios.phase)
    decisions = int(np.ceil(duration / task.ctrl_dt - 1e-9))
    steps = decisions * task.sim_steps
    table = action_table(task)
    batch = Batch(scene.model, count, threads or os.cpu_count() or 1)
    batch.qpos = scene.stance.qpos
    batch.qvel = scene.stance.qvel
    batch.qacc_warmstart = scene.stance.qacc_warmstart
    qpos = np.tile(scene.stance.qpos, (count, 1))
    heights = np.tile(standing_heights(config), (count, 1))
    imu = np.tile(scene.stance.imu, (count, task.history, 1))
    tilts = np.full((count, steps), task.fail_tilt)
    actions = np.full((count, decisions), np.nan)
    fell_at = np.full(count, steps)
    trace = np.tile(qpos[:, None], (1, steps, 1)) if record else None
    alive = np.arange(count)
    began = time.perf_counter()
    for k in range(decisions):
        obs = observation(config, scene, qpos[alive], imu[alive])
        change = table[controller(obs)]
        before = heights[alive]
        heights[alive] = apply_action(task, robot, before, change)
        some = tilt.Scenario(scenarios.targets[alive], scenarios.phase[alive])
        now = np.full(len(alive), float(k))
        ctrl = decision_ctrl(config, scene, some, now, before, heights[alive])
        out = batch.rollout(task.sim_steps, ctrl, record=("qpos", "sensordata"), ids=alive)
        qpos[alive] = out["qpos"][:, -1]
        imu[alive] = extend_history(imu[alive], out["sensordata"][..., scene.imu])
        tilted = body_tilt(out["qpos"][..., scene.trunk_quat])
        actions[alive, k] = 1000 * np.abs(change).mean(axis=-1)

        span = slice(k * task.sim_steps, (k + 1) * task.sim_steps)
        bad = failed(task, tilted)
        warned = np.asarray(batch.warning[alive]).reshape(len(alive), -1).any(axis=-1)
        down = bad.any(axis=-1) | warned
        first = np.where(bad.any(axis=-1), bad.argmax(axis=-1), 0)
        after_fall = down[:, None] & (np.arange(task.sim_steps) >= first[:, None])
        tilts[alive, span] = np.where(after_fall, task.fail_tilt, tilted)
        fell_at[alive[down]] = k * task.sim_steps + first[down]
        if trace is not None:
            trace[alive, k * task.sim_steps :] = out["qpos"][:, -1:]
            trace[alive, span] = out["qpos"]
        alive = alive[~down]
        progress((k + 1) / decisions)
        if not len(alive):
            break
    return Rollout(config, tilts, fell_at, actions, trace, time.perf_counter() - began)


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
        "physics_steps_per_second": float(rollout.fell_at.sum() / rollout.seconds),
    }


def policy_scene(policy: Policy, visual: bool = False) -> Scene:
    """Builds the scene a policy was trained in.

    Raises:
      PolicyError: if today's scene files or engine give another one.
    """
    scene = load_scene(policy.config, visual)
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
      EvaluationError: for an unknown suite, or no scenarios or time.
      PolicyError: if the policy belongs to another scene.
    """
    if scenarios < 1:
        raise EvaluationError(f"scenarios is {scenarios}; it must be at least 1")
    if not (np.isfinite(duration) and duration > 0):
        raise EvaluationError(f"duration is {duration}; it must be a number of seconds above 0")
    drawn = make_scenarios(policy.config, suite, scenarios, duration, seed)
    scene = policy_scene(policy)
    rollout = roll_out(scene, policy.config, policy, drawn, duration, progress=progress)
    return summarize(rollout, suite, duration, seed)
