"""Figures and tables of a run folder. No JAX."""

import json
from pathlib import Path
from typing import Any

import matplotlib as mpl
import numpy as np
from rich import box
from rich.console import Console
from rich.table import Table

from mjx_balance.config import Config, TaskConfig
from mjx_balance.evaluation import make_scenarios, policy_scene, roll_out
from mjx_balance.policy import Policy
from mjx_balance.task.reward import reward_terms

mpl.use("Agg")
import matplotlib.pyplot as plt

RECORD_SECONDS = 100.0
RECORD_SEED = 2_000_000
BLUE, ORANGE, GREY = "#2166ac", "#d6604d", "#777777"
STYLE: dict[Any, Any] = {
    "figure.dpi": 110,
    "savefig.dpi": 150,
    "font.size": 10,
    "axes.spines.top": False,
    "axes.spines.right": False,
    "axes.grid": True,
    "grid.alpha": 0.25,
    "legend.frameon": False,
    "axes.titlelocation": "left",
}


def draw_figures(run_dir: Path, policy: Policy) -> list[Path]:
    """Draws a run's figures into its folder.

    Args:
      run_dir: with metrics.jsonl.
      policy: the run's policy.

    Returns:
      The files written.
    """
    figures = run_dir / "figures"
    figures.mkdir(exist_ok=True)
    lines = (run_dir / "metrics.jsonl").read_text().splitlines()
    with plt.rc_context(STYLE):
        drawn = {
            "learning_curves.png": learning_curves([json.loads(line) for line in lines]),
            "reward.png": reward_figure(policy.config.task),
            "rollout.png": rollout_figure(policy),
        }
        for name, figure in drawn.items():
            figure.savefig(figures / name, bbox_inches="tight")
            plt.close(figure)
    return [figures / name for name in drawn]


def learning_curves(metrics: list[dict[str, float]]) -> plt.Figure:
    """Tilt, falls, reward, loss, epsilon and speed over the decisions of a run."""
    panels = (
        ("train/tilt_deg", "mean body tilt [deg]", "log"),
        ("train/falls_per_minute", "falls per robot-minute", "symlog"),
        ("train/reward", "reward per decision", "linear"),
        ("train/loss", "squared TD error", "log"),
        ("train/epsilon", "epsilon", "linear"),
        ("perf/env_steps_per_second", "decisions per second", "linear"),
    )
    figure, axes = plt.subplots(2, 3, figsize=(12, 6), sharex=True, layout="constrained")
    steps = np.asarray([m["env_steps"] for m in metrics]) / 1000
    for axis, (name, title, scale) in zip(axes.flat, panels, strict=True):
        values = np.asarray([m[name] for m in metrics])
        if scale == "log":
            values = np.where(values > 0, values, np.nan)  # no update yet, no loss
        axis.plot(steps, values, color=BLUE, lw=1.6)
        axis.set_title(title)
        axis.set_yscale(scale, **({"linthresh": 0.1} if scale == "symlog" else {}))
        if name == "train/tilt_deg":
            axis.yaxis.set_major_formatter("{x:g}")
            axis.yaxis.set_minor_formatter("{x:g}")
        if scale in ("linear", "symlog") and name != "train/reward":
            axis.set_ylim(bottom=0)
    for axis in axes[-1]:
        axis.set_xlabel("thousand decisions")
    return figure


def reward_figure(task: TaskConfig) -> plt.Figure:
    """The paper's Fig. 4, the reward for the tilt, beside our reading of its Fig. 5."""
    tilt = np.linspace(0, task.fail_tilt, 301)
    change = np.linspace(-2, 2, 301)
    none = np.zeros_like(tilt)
    figure, (left, right) = plt.subplots(1, 2, figsize=(9, 3.4), layout="constrained")
    left.plot(tilt, reward_terms(task, tilt, tilt, none)["level"], color=BLUE, lw=2)
    left.set_title("instant incline (paper Eq. 4, Fig. 4)")
    left.set_xlabel("body tilt [deg]")
    left.set_ylabel("reward")
    toward = reward_terms(task, change, none, none)["toward"]
    right.plot(change, np.where(toward >= 0, toward, np.nan), color="#4d9221", lw=2)
    right.plot(change, np.where(toward <= 0, toward, np.nan), color=ORANGE, lw=2)
    right.set_title("toward horizontal (our reading of Fig. 5)")
    right.set_xlabel("tilt before less tilt after [deg]")
    return figure


def rollout_figure(policy: Policy) -> plt.Figure:
    """The paper's Fig. 7 for this policy: board and body angles over 100 s in plain MuJoCo."""
    config = policy.config
    scene = policy_scene(policy)
    scenario = make_scenarios(config, "paper", 1, RECORD_SECONDS, RECORD_SEED)
    rollout = roll_out(scene, config, policy, scenario, RECORD_SECONDS, record=True)
    assert rollout.qpos is not None
    qpos = rollout.qpos[0]
    roll, pitch = roll_pitch(qpos[:, scene.trunk_quat])
    time = np.arange(1, len(qpos) + 1) * config.task.sim_dt
    board = np.degrees(qpos[:, scene.board_qpos])
    rows = (
        (board[:, 0], "board X", GREY),
        (board[:, 1], "board Y", GREY),
        (roll, "body roll", BLUE),
        (pitch, "body pitch", ORANGE),
    )
    figure, axes = plt.subplots(4, 1, figsize=(11, 7), sharex=True, layout="constrained")
    limit = config.task.max_incline
    for axis, (values, name, colour) in zip(axes, rows, strict=True):
        axis.plot(time, values, color=colour, lw=1.2)
        axis.set_ylabel(f"{name} [deg]")
        axis.set_ylim(-limit, limit)
        axis.axhline(0, color="black", lw=0.5)
        for change in np.arange(0, time[-1], config.task.target_period):
            axis.axvline(change, color="black", lw=0.8, ls=":")
    axes[0].set_title(
        f"{RECORD_SECONDS:.0f} s in plain MuJoCo: mean tilt {rollout.tilt.mean():.2f} deg, "
        f"greatest {rollout.tilt.max():.2f} deg" + (", the robot fell" if rollout.fell[0] else "")
    )
    axes[-1].set_xlabel("time [s]; dotted: the board takes a new target")
    return figure


def roll_pitch(quat: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Roll and pitch (...) in deg of unit quaternions (..., 4), yaw first convention."""
    w, x, y, z = np.moveaxis(quat, -1, 0)
    roll = np.arctan2(2 * (w * x + y * z), 1 - 2 * (x * x + y * y))
    pitch = np.arcsin(np.clip(2 * (w * y - z * x), -1, 1))
    return np.degrees(roll), np.degrees(pitch)


def evaluation_table(results: dict[str, dict[str, Any]]) -> Table:
    """A table for people: one row per suite."""
    title = "plain MuJoCo, tilt in deg over every physics step"
    table = Table(
        title=title, title_justify="left", box=box.SIMPLE_HEAD, padding=(0, 1), pad_edge=False
    )
    table.add_column("suite", style="bold", no_wrap=True)
    shown = ("mean", "p50", "p95", "p99", "max")
    for name in ("scenarios", "falls", *shown, "act mm"):
        table.add_column(name, justify="right", no_wrap=True)
    for suite, result in results.items():
        tilt = result["tilt_deg"]
        table.add_row(
            suite,
            f"{result['scenarios']} x {result['duration_s']:g} s",
            str(result["falls"]),
            *(f"{tilt[name]:.3f}" for name in shown),
            f"{result['action_mm_mean']:.3f}",
        )
    return table


def print_summary(
    console: Console, run_dir: Path, results: dict[str, dict[str, Any]], seconds: float
) -> None:
    """Says how the run went and where everything is."""
    console.print(evaluation_table(results))
    for name, what in (
        ("policy.safetensors", "the policy; `mjx-balance evaluate` runs it"),
        ("evaluation.json", "the table above"),
        ("figures/", "learning curves, rewards, 100 s on the board"),
        ("metrics.jsonl", "every logged number; tensorboard/ has them too"),
        ("checkpoints/", "the whole training state"),
    ):
        console.print(f"{run_dir / name}  [dim]{what}[/dim]", highlight=False, soft_wrap=True)
    console.print(f"done in {seconds:.0f} s", highlight=False)


def record(policy: Policy, suite: str, duration: float, seed: int) -> tuple[Config, np.ndarray]:
    """Rolls out a suite's first scenario for a video.

    Returns:
      The config, and (steps, nq) states.
    """
    scenario = make_scenarios(policy.config, suite, 1, duration, seed)
    scene = policy_scene(policy)
    rollout = roll_out(scene, policy.config, policy, scenario, duration, record=True)
    assert rollout.qpos is not None
    return policy.config, rollout.qpos[0]
