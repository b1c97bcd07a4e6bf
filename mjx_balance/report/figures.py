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
    from matplotlib.legend_handler import HandlerTuple
    from matplotlib.ticker import LogLocator

# Okabe and Ito's colours, which the colour-blind tell apart: https://jfly.uni-koeln.de/color/
BLUE, ORANGE, GREEN, PURPLE, AMBER = "#0072b2", "#d55e00", "#009e73", "#b05a8c", "#b8860b"
INK, GREY = "#1d2531", "#75808f"  #: of text and axes; of what is not the robot's
DARK = {
    BLUE: "#5ab4ea",
    ORANGE: "#ff8a3d",
    GREEN: "#2dc79b",
    PURPLE: "#e39bc6",
    AMBER: "#f0c040",
    INK: "#dfe5ec",
    GREY: "#9aa5b4",
}
"""Colour -> the one to take its place on a dark page."""
LINES = (
    (BLUE, "-"),
    (GREY, "-"),
    (ORANGE, "--"),
    (GREEN, "-."),
    (AMBER, ":"),
    (PURPLE, (0, (5, 1, 1, 1, 1, 1))),
)
"""Colour and dashes of each controller, in the order of `measuring.NAMES`."""
STYLE: dict[Any, Any] = {
    "figure.dpi": 110,
    "savefig.dpi": 150,
    "font.size": 10,
    "axes.spines.top": False,
    "axes.spines.right": False,
    "axes.grid": True,
    "grid.color": GREY,
    "grid.alpha": 0.25,
    "legend.frameon": False,
    "axes.titlelocation": "left",
    "path.simplify_threshold": 0.4,  # px; a curve of 25,000 points becomes a third smaller
    "svg.hashsalt": "mjx_balance",  # the same file from the same figure
    **dict.fromkeys(
        ("text.color", "axes.edgecolor", "axes.labelcolor", "xtick.color", "ytick.color"), INK
    ),
}
NO_DATE = {"Date": None}
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


@styled
def svg(figure: Figure) -> bytes:
    """Returns the bytes of an SVG file that shows the figure on light and on dark pages."""
    buffer = io.StringIO()
    figure.savefig(buffer, format="svg", bbox_inches="tight", transparent=True, metadata=NO_DATE)
    names = {colour: f"c{number}" for number, colour in enumerate(DARK)}
    light = "".join(f"--{name}:{colour};" for colour, name in names.items())
    dark = "".join(f"--{names[colour]}:{other};" for colour, other in DARK.items())
    style = f"svg{{{light}}}@media(prefers-color-scheme:dark){{svg{{{dark}}}}}"
    text = buffer.getvalue()
    for colour, name in names.items():
        text = text.replace(colour, f"var(--{name})")
    start = text.index(">", text.index("<svg ")) + 1
    return f"{text[:start]}<style>{style}</style>{text[start:]}".encode()


def label_right(
    axis: Axes, labels: list[tuple[str, str, float, float]], spacing: float = 0.085
) -> None:
    """Writes labels beside the plot, each joined to a point of its curve, none over another.

    Args:
      axis: with its final scales and limits.
      labels: text, colour, x and y of the point.
      spacing: least distance between two labels, as a share of the axis' height.
    """
    to_share = axis.transData + axis.transAxes.inverted()
    places = [float(to_share.transform((x, y))[1]) for _, _, x, y in labels]
    order = sorted(range(len(labels)), key=lambda k: places[k])
    heights = np.clip([places[k] for k in order], 0, 1)
    for k in range(1, len(heights)):
        heights[k] = max(heights[k], heights[k - 1] + spacing)
    for k in range(len(heights) - 1, -1, -1):  # what stands too high now moves down
        heights[k] = min(heights[k], 1 - spacing * (len(heights) - 1 - k))
    for k, height in zip(order, heights, strict=True):
        text, colour, x, y = labels[k]
        axis.annotate(
            text,
            (x, y),
            (1.03, height),
            textcoords="axes fraction",
            color=colour,
            va="center",
            arrowprops={"arrowstyle": "-", "color": colour, "lw": 0.7, "alpha": 0.6},
        )


CURVES = (
    ("train/tilt_deg", "mean body tilt [deg]", "log"),
    ("train/falls_per_minute", "falls per robot-minute", "symlog"),
    ("train/reward", "reward per decision", "linear"),
    ("train/loss", "squared TD error", "log"),
    ("train/epsilon", "epsilon", "linear"),
    ("perf/env_steps_per_second", "decisions per second", "linear"),
)
"""Metric, title and scale of each panel of the learning curves."""
LABELLED = (0.2, 3e-4)  #: shares of the time between which curves of the tilt are labelled
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
        axis.plot(thousands, np.nanmedian(values, axis=0), color=BLUE, lw=1.6, label="exploring")
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
    for (name, label), colour, marker in zip(
        HELD_OUT.items(), (ORANGE, GREEN), ("o", "s"), strict=True
    ):
        points = [
            (line["env_steps"] / 1000, value)
            for run in runs
            for line in run
            for value in line.get("seeds", {}).get(name, [line.get(name)])
            if value is not None and value > 0
        ]
        if points:
            axis.plot(*zip(*points, strict=True), marker, ms=4, color=colour, label=label)
            axis.legend()


def _seed_curves(run: list[dict[str, Any]], name: str) -> np.ndarray:
    """(seeds, lines) values of a metric; one row if the run logs no seeds, NaN for a gap."""
    of_seeds = [m.get("seeds", {}).get(name.removeprefix("train/")) for m in run]
    count = max((len(values) for values in of_seeds if values), default=0)
    if count:
        return np.asarray([values or [None] * count for values in of_seeds], float).T
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
    gain, loss = np.where(toward >= 0, toward, np.nan), np.where(toward <= 0, toward, np.nan)
    right.plot(change, gain, color=GREEN, lw=2, label="the tilt has decreased")
    right.plot(change, loss, color=ORANGE, lw=2, ls="--", label="the tilt has increased")
    right.legend(loc="upper left")
    right.set_title("toward horizontal (our reading of Fig. 5)")
    right.set_xlabel("tilt before less tilt after [deg]")
    return figure


@styled
def rollout_figure(scene: Scene, rollouts: Mapping[str, Rollout]) -> Figure:
    """The paper's Fig. 7: angles of board and body over time, in plain MuJoCo.

    The body's angles have a scale of their own; the lowest panel shows on a log scale how much
    the body tilts, and how much the board, as a robot would that stands still.

    Args:
      scene: of the rollouts.
      rollouts: name -> rollout of one scenario with `qpos`, the same for all.
    """
    figure = Figure(figsize=(11, 7.6), layout="constrained")
    axes = figure.subplots(4, 1, sharex=True)
    task = next(iter(rollouts.values())).task
    reach, end = 0.0, 0.0
    for (name, rollout), (colour, dashes) in zip(
        rollouts.items(), (LINES[0], LINES[2], LINES[3]), strict=False
    ):
        assert rollout.qpos is not None, "the rollout is not recorded"
        qpos = rollout.qpos[0]
        time = np.arange(1, len(qpos) + 1) * task.sim_dt
        end = time[-1]
        roll, pitch = roll_pitch(qpos[:, scene.trunk_quat])
        if colour == BLUE:
            board = np.degrees(qpos[:, scene.board_qpos])
            _draw_board(axes, time, board)
        for axis, values in zip(axes[1:], (roll, pitch, rollout.tilt[0]), strict=True):
            axis.plot(
                *(time, values),
                color=colour,
                ls=dashes,
                lw=1.6 if colour == BLUE else 1.1,
                zorder=3 if colour == BLUE else 2,
                label=f"{name}: mean {rollout.tilt.mean():.3f}, max {rollout.tilt.max():.2f} deg"
                + (", falls" if rollout.fell[0] else ""),
            )
        if not rollout.fell[0] or colour == BLUE:  # a fall of others would make all else flat
            reach = max(reach, np.abs(roll).max(), np.abs(pitch).max())
    for axis, name in zip(axes, ("board", "body roll", "body pitch", "tilt"), strict=True):
        axis.set_ylabel(f"{name} [deg]")
        for change in np.arange(0, end, task.target_period):
            axis.axvline(change, color=INK, lw=0.8, ls=":", alpha=0.6)
    for axis in axes[1:3]:
        axis.set_ylim(-1.1 * reach, 1.1 * reach)
    axes[3].set(yscale="log", ylim=(0.003, 1.6 * max(task.fail_tilt, task.max_incline)))
    axes[3].yaxis.set_major_formatter("{x:g}")
    figure.legend(*axes[3].get_legend_handles_labels(), loc="outside upper left", ncols=3)
    axes[3].set_xlabel("time [s]; dotted: the board takes a new target")
    return figure


def _draw_board(axes: np.ndarray, time: np.ndarray, board: np.ndarray) -> None:
    """The board's angles (steps, 2), deg, in the first panel, and its tilt in the last."""
    x, y = board.T
    axes[0].plot(time, x, color=INK, lw=1.3)
    axes[0].plot(time, y, color=PURPLE, lw=1.3, ls="--")
    axes[0].set_xlim(0, time[-1])
    label_right(axes[0], [("X", INK, time[-1], x[-1]), ("Y", PURPLE, time[-1], y[-1])], 0.2)
    both = np.radians(board)
    tilt = np.degrees(np.arccos(np.cos(both[:, 0]) * np.cos(both[:, 1])))
    label = f"standing still (the board's tilt): mean {tilt.mean():.2f}, max {tilt.max():.2f} deg"
    axes[3].plot(time, tilt, color=GREY, lw=1.3, label=label)


@styled
def tilt_figure(shares: Mapping[str, np.ndarray], edges: np.ndarray) -> Figure:
    """Share of the time in which the body tilt exceeds a value, over that value.

    Args:
      shares: name -> (len(edges) - 1,) share of the physics steps per bin of tilt.
      edges: (bins + 1,) bounds of the bins, deg.
    """
    figure = Figure(figsize=(10, 4.2), layout="constrained")
    axis = figure.subplots()
    axis.set(xscale="log", yscale="log", xlim=(0.02, edges[-1]), ylim=(1e-5, 1.3))
    beyond = {name: 1 - np.cumsum(share) for name, share in shares.items()}
    for (name, share), (colour, dashes) in zip(beyond.items(), LINES, strict=False):
        width = 2.6 if colour == BLUE else 1.6
        values = np.where(share > 1e-7, share, np.nan)
        axis.plot(edges[1:], values, label=name, color=colour, lw=width, ls=dashes)
    # Each at a height of its own, the farthest on top.
    order = sorted(beyond, key=lambda name: -np.count_nonzero(beyond[name] > LABELLED[0]))
    levels, labels = np.geomspace(*LABELLED, len(order)), []
    for name, level in zip(order, levels, strict=True):
        near = int(np.argmin(np.abs(np.log(np.maximum(beyond[name], 1e-9) / level))))
        line = axis.get_lines()[list(beyond).index(name)]
        labels.append((name, str(line.get_color()), edges[1:][near], beyond[name][near]))
    label_right(axis, labels)
    axis.set_xlabel("body tilt [deg]")
    axis.set_title("share of the time that the body is tilted further")
    axis.xaxis.set_major_formatter("{x:g}")
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
    handles: list[Any] = []
    for axis, (values, title, colours, top) in zip(axes, maps, strict=True):
        image = axis.pcolormesh(rates, inclines, values, cmap=colours, vmin=0, vmax=top)
        figure.colorbar(image, ax=axis)
        limits = (
            [rates[0], envelope.authority, envelope.authority],
            [envelope.reach, envelope.reach, inclines[0]],
        )
        # On any colour, and on any page.
        handles = axis.plot(*limits, color="black", ls="--", lw=1.8, zorder=3)
        handles = axis.plot(*limits, color="white", lw=3.4, zorder=2) + handles
        axis.set(title=title, xlabel="board speed on each axis [deg/s]")
        axis.grid(visible=False)
    axes[0].set_ylabel("board angle on both axes at once [deg]")
    figure.legend(
        [tuple(handles)],  # pyright: ignore[reportArgumentType]
        ["to the right or above: out of reach for these actions and legs"],
        handler_map={tuple: HandlerTuple(ndivide=1)},
        loc="outside lower left",
    )
    return figure
