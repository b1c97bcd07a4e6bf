"""Figures of metrics and rollouts. Nothing here simulates."""

import io
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np

from mjx_balance.config import TaskConfig
from mjx_balance.evaluation.envelope import Envelope
from mjx_balance.evaluation.rollout import Rollout
from mjx_balance.evaluation.suites import HEADLINE
from mjx_balance.files.run_folder import write_atomically
from mjx_balance.quiet import matplotlib_imports
from mjx_balance.sim.scene import Scene
from mjx_balance.task.attitude import roll_pitch
from mjx_balance.task.reward import RewardInputs, reward_terms

with matplotlib_imports():
    import matplotlib as mpl
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure  # pyplot would choose a backend; these figures need none
    from matplotlib.ticker import LogLocator

BLUE, ORANGE, GREY, GREEN = "#2166ac", "#d6604d", "#777777", "#4d9221"
SHADES = ("#b2182b", "#ef8a62", "#7f7f7f", "#1a9850", "#91cf60")
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
styled = mpl.rc_context(STYLE)  #: decorates a function that draws in this style


def draw_figures(
    folder: Path,
    metrics: list[dict[str, Any]],
    task: TaskConfig,
    scene: Scene,
    rollouts: Mapping[str, Rollout],
) -> list[Path]:
    """Draws a run's figures; returns the files written.

    Args:
      folder: to write them to; created if it does not exist.
      metrics: the lines of metrics.jsonl.
      task: defines the reward.
      scene: of the rollouts.
      rollouts: see `rollout_figure`.
    """
    folder.mkdir(exist_ok=True)
    drawings = {
        folder / "learning_curves.png": learning_curves([metrics]),
        folder / "reward.png": reward_figure(task),
        folder / "rollout.png": rollout_figure(scene, rollouts),
    }
    for file, figure in drawings.items():
        write_atomically(file, png(figure))
    return list(drawings)


@styled
def png(figure: Figure) -> bytes:
    """Returns the bytes of a PNG file of the figure."""
    buffer = io.BytesIO()
    figure.savefig(buffer, bbox_inches="tight")
    return buffer.getvalue()


CURVES = (
    ("train/tilt_deg", "mean body tilt [deg]", "log"),
    ("train/falls_per_minute", "falls per robot-minute", "symlog"),
    ("train/reward", "reward per decision", "linear"),
    ("train/loss", "squared TD error", "log"),
    ("train/epsilon", "epsilon", "linear"),
    ("perf/env_steps_per_second", "decisions per second", "linear"),
)
"""Metric, title and scale of each panel of the learning curves."""
HELD_OUT = {f"eval/{suite}/tilt_mean": f"held out, {suite}" for suite in HEADLINE}
"""Validation metrics that the tilt panel shows as points, and their labels."""


@styled
def learning_curves(runs: list[list[dict[str, Any]]]) -> Figure:
    """Tilt, falls, reward, loss, epsilon and speed over env steps.

    A line shows the median over runs and seeds, a band the extremes. Each point in the tilt panel
    is one validation of one seed.

    Args:
      runs: the lines of metrics.jsonl of each run.
    """
    figure = Figure(figsize=(12, 6), layout="constrained")
    axes = figure.subplots(2, 3, sharex=True)
    longest = max(runs, key=lambda run: run[-1]["env_steps"])
    steps = np.asarray([m["env_steps"] for m in longest])
    for axis, (name, title, scale) in zip(axes.flat, CURVES, strict=True):
        values = np.asarray(
            [
                np.interp(steps, [m["env_steps"] for m in run], curve, np.nan, np.nan)
                for run in runs
                for curve in _seed_curves(run, name)
            ]
        )
        if scale == "log":
            values = np.where(values > 0, values, np.nan)  # a log scale has no zero
        finite = np.isfinite(values).any(axis=0)
        thousands, values = steps[finite] / 1000, values[:, finite]
        if len(values) > 1:
            low, high = np.nanmin(values, axis=0), np.nanmax(values, axis=0)
            axis.fill_between(thousands, low, high, color=BLUE, alpha=0.2, lw=0)
        axis.plot(thousands, np.nanmedian(values, axis=0), color=BLUE, lw=1.6)
        axis.set_title(title)
        axis.set_yscale(scale, **({"linthresh": 0.1} if scale == "symlog" else {}))
        if name == "train/tilt_deg":
            axis.yaxis.set_major_formatter("{x:g}")
            axis.yaxis.set_minor_formatter("{x:g}")
            axis.yaxis.set_minor_locator(LogLocator(subs=(2, 5)))
            _draw_held_out(axis, runs)
        if scale in ("linear", "symlog") and name != "train/reward":
            axis.set_ylim(bottom=0)
    for axis in axes[-1]:
        axis.set_xlabel("thousand decisions")
    return figure


def _draw_held_out(axis: Axes, runs: list[list[dict[str, Any]]]) -> None:
    for (name, label), colour in zip(HELD_OUT.items(), (ORANGE, GREY), strict=True):
        points = [
            (line["env_steps"] / 1000, value)
            for run in runs
            for line in run
            for value in line.get("seeds", {}).get(name, [line.get(name)])
            if value is not None and value > 0
        ]
        if points:
            axis.plot(*zip(*points, strict=True), "o", ms=4, color=colour, label=label)
            axis.legend()


def _seed_curves(run: list[dict[str, Any]], name: str) -> np.ndarray:
    """(seeds, lines) values of a metric; one row if the run logs no seeds, NaN for a gap."""
    short = name.removeprefix("train/")
    if run and short in run[0].get("seeds", {}):
        return np.asarray([m["seeds"][short] for m in run], float).T
    return np.asarray([[m.get(name) for m in run]], float)


@styled
def reward_figure(task: TaskConfig) -> Figure:
    """The reward for the tilt (paper Fig. 4) and for its change (our reading of Fig. 5)."""
    tilt = np.linspace(0, task.fail_tilt, 301)
    change = np.linspace(-2, 2, 301)
    none = np.zeros_like(tilt)
    figure = Figure(figsize=(9, 3.4), layout="constrained")
    left, right = figure.subplots(1, 2)
    left.plot(tilt, reward_terms(task, RewardInputs(tilt, tilt, none))["level"], color=BLUE, lw=2)
    left.set(title="instant incline (paper Eq. 4, Fig. 4)", xlabel="body tilt [deg]")
    left.set_ylabel("reward")
    toward = reward_terms(task, RewardInputs(change, none, none))["toward"]
    right.plot(change, np.where(toward >= 0, toward, np.nan), color=GREEN, lw=2)
    right.plot(change, np.where(toward <= 0, toward, np.nan), color=ORANGE, lw=2)
    right.set_title("toward horizontal (our reading of Fig. 5)")
    right.set_xlabel("tilt before less tilt after [deg]")
    return figure


@styled
def rollout_figure(scene: Scene, rollouts: Mapping[str, Rollout]) -> Figure:
    """The paper's Fig. 7: board and body angles over time in plain MuJoCo.

    Args:
      scene: of the rollouts.
      rollouts: name -> rollout of one scenario with `qpos`; one column each.
    """
    count = len(rollouts)
    figure = Figure(figsize=(max(11, 6.5 * count), 7), layout="constrained")
    axes = figure.subplots(4, count, sharex=True, sharey=True, squeeze=False)
    for column, (name, rollout) in zip(axes.T, rollouts.items(), strict=True):
        _draw_rollout(column, scene, rollout)
        column[0].set_title(
            f"{name}: mean tilt {rollout.tilt.mean():.2f} deg, "
            f"greatest {rollout.tilt.max():.2f} deg"
            + (", the robot fell" if rollout.fell[0] else "")
        )
        column[-1].set_xlabel("time [s]; dotted: the board takes a new target")
    names = ("board X", "board Y", "body roll", "body pitch")
    for axis, name in zip(axes[:, 0], names, strict=True):
        axis.set_ylabel(f"{name} [deg]")
    return figure


def _draw_rollout(column: np.ndarray, scene: Scene, rollout: Rollout) -> None:
    assert rollout.qpos is not None, "the rollout is not recorded"
    task, qpos = rollout.task, rollout.qpos[0]
    time = np.arange(1, len(qpos) + 1) * task.sim_dt
    board = np.degrees(qpos[:, scene.board_qpos])
    roll, pitch = roll_pitch(qpos[:, scene.trunk_quat])
    curves = ((board[:, 0], GREY), (board[:, 1], GREY), (roll, BLUE), (pitch, ORANGE))
    for axis, (values, colour) in zip(column, curves, strict=True):
        axis.plot(time, values, color=colour, lw=1.2)
        axis.set_ylim(-1.05 * task.max_incline, 1.05 * task.max_incline)
        axis.axhline(0, color="black", lw=0.5)
        for change in np.arange(0, time[-1], task.target_period):
            axis.axvline(change, color="black", lw=0.8, ls=":")


@styled
def tilt_figure(shares: Mapping[str, np.ndarray], edges: np.ndarray) -> Figure:
    """Share of the time in which the body tilt exceeds a value, over that value.

    Args:
      shares: name -> (len(edges) - 1,) share of the physics steps per bin of tilt.
      edges: (bins + 1,) bounds of the bins, deg.
    """
    figure = Figure(figsize=(9, 3.8), layout="constrained")
    axis = figure.subplots()
    for (name, share), colour in zip(shares.items(), (BLUE, *SHADES), strict=False):
        beyond = 1 - np.cumsum(share)
        width = 2.6 if colour == BLUE else 1.4
        values = np.where(beyond > 1e-7, beyond, np.nan)
        axis.loglog(edges[1:], values, label=name, color=colour, lw=width)
    axis.set(xlim=(0.02, edges[-1]), xlabel="body tilt [deg]")
    axis.set_title("share of the time that the body is tilted further")
    axis.xaxis.set_major_formatter("{x:g}")
    axis.legend(loc="lower left")
    return figure


@styled
def envelope_figure(envelope: Envelope, limit: float) -> Figure:
    """Fall rate and mean tilt over incline and board speed, with the physical limits.

    Args:
      envelope: from `evaluation.envelope`.
      limit: end of the tilt's colour scale, deg.
    """
    figure = Figure(figsize=(12, 4.4), layout="constrained")
    axes = figure.subplots(1, 2, sharey=True)
    maps = (
        (envelope.fall_rate, "share of the scenarios with a fall", "Reds", 1.0),
        (envelope.mean_tilt, "mean body tilt [deg]", "viridis_r", limit),
    )
    rates, inclines = envelope.rates, envelope.inclines
    for axis, (values, title, colours, top) in zip(axes, maps, strict=True):
        image = axis.pcolormesh(rates, inclines, values, cmap=colours, vmin=0, vmax=top)
        figure.colorbar(image, ax=axis)
        speeds = [rates[0], envelope.authority, envelope.authority]
        axis.plot(speeds, [envelope.reach, envelope.reach, inclines[0]], "k--", lw=1.8)
        axis.set(title=title, xlabel="board speed on each axis [deg/s]")
        axis.grid(visible=False)
    axes[0].set_ylabel("board angle on both axes at once [deg]")
    return figure
