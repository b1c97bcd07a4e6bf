"""Draws the pictures of these pages from the code that they show: python docs/figures.py [NAME].

decision.svg, radial.svg; peers.svg, from what benchmarks/peers.py has measured; balance.webp, which
needs an OpenGL backend (EGL or OSMesa).
"""

import contextlib
import itertools
import json
import sys
from pathlib import Path

import matplotlib
import matplotlib.pyplot as plt
import numpy as np
from matplotlib.ticker import NullLocator
from PIL import Image, ImageDraw, ImageFont

from mjx_balance import load_policy
from mjx_balance.config import preset
from mjx_balance.evaluation.controllers import make_controller
from mjx_balance.evaluation.rollout import observing, policy_scene, run_suite
from mjx_balance.evaluation.suites import SEEDS
from mjx_balance.render.drawing import Painter
from mjx_balance.report import figures
from mjx_balance.robots.catalogue import find_robot
from mjx_balance.task.kinematics import ramp

HERE = Path(__file__).resolve().parent
STYLE = figures.STYLE | {"font.size": 9, "axes.grid": False}
BLUE, RED, GREY = figures.BLUE, figures.ORANGE, figures.GREY


def decision() -> plt.Figure:
    """Foot heights over two decisions, and the samples that the one in the middle looks back on."""
    task, legs = preset("paper").task, len(find_robot("quadruped").legs)
    heights = np.zeros((3, legs)) + np.asarray([0.0, 2.4, 0.9])[:, None]
    path = np.concatenate([ramp(task, a, b)[:, 0] for a, b in itertools.pairwise(heights)])
    ms = 1000 * task.sim_dt
    time = ms * np.arange(len(path) + 1)
    figure, (top, low) = plt.subplots(2, 1, figsize=(7.5, 3.0), sharex=True, height_ratios=(3, 2))
    top.plot(time, [0, *path], color=BLUE)
    top.set_ylabel("foot height [mm]")
    now = 1000 * task.ctrl_dt
    for at, word in ((0.0, "a decision"), (now, "the next")):
        for axis in (top, low):
            axis.axvline(at, color=GREY, linestyle=":")
        top.annotate(word, (at, 2.75), (4, 0), textcoords="offset points", va="center")
    top.set_ylim(-0.3, 3.0)
    samples = ms * np.arange(len(path))
    for row, lags in enumerate((task.accel_lags, task.gyro_lags)):
        seen = now - ms - ms * np.asarray(lags)
        low.plot(samples, np.full(len(samples), row), "|", color=GREY, alpha=0.5, markersize=7)
        low.plot(seen, np.full(len(seen), row), "|", color=RED, markersize=11, markeredgewidth=1.8)
    low.set_yticks((0, 1), ("accelerometer", "gyro"))
    low.set_ylim(-0.7, 1.7)
    low.set_xlabel("time [ms]; orange: the samples that the second decision sees (Eq. 2)")
    return figure


def radial() -> plt.Figure:
    """The profile and the values of all actions, of the shipped policy standing still."""
    policy = load_policy(HERE.parent / "policies" / "best.safetensors")
    alpha, beta, kappa, delta = np.logaddexp(0, policy.profile)
    figure, (left, right) = plt.subplots(1, 2, figsize=(7.5, 3.0), width_ratios=(3, 2))
    away = np.linspace(-2, 2, 401)
    for sigma, name, color in zip(policy.stretch, ("roll", "pitch"), (BLUE, RED), strict=True):
        z = np.sqrt(delta**2 + (np.exp(sigma) * away) ** 2)
        left.plot(away, alpha * np.exp(-beta * z) - kappa * z, color=color, label=name)
    left.set_xlabel(r"distance from the best action, $x - \mu$")
    left.set_ylabel(r"$Q - V$")
    left.legend(frameon=False)
    values = policy.q_values(np.zeros(policy.observation_size)).reshape(policy.factors)
    most = 1000 * policy.config.task.action_max
    shown = right.imshow(
        values.T, origin="lower", extent=(-most, most, -most, most), cmap="cividis"
    )
    right.set_xlabel(r"$a_x$ [mm]")
    right.set_ylabel(r"$a_y$ [mm]")
    figure.colorbar(shown, ax=right, label="Q")
    return figure


OURS = ("quick", "quick-16k", "default")
COLOURS = {"rejax": RED, "brax": figures.GREEN, "sb3": figures.PURPLE}
DASHES = {"dqn": "-", "pqn": (0, (1, 1)), "sac": (0, (5, 1, 1, 1)), "ppo": (0, (4, 1.5))}


def peers() -> plt.Figure:
    """Tilt over time of our learner and of others: median and extremes of the seeds."""
    rows = json.loads((HERE.parent / "benchmarks" / "peers.json").read_text())["rows"]
    figure, axes = plt.subplots(1, 3, figsize=(12, 4.6), sharey=True)
    names = [x for x in dict.fromkeys(row["contender"] for row in rows) if "-" in x or x in OURS]
    names = [x for x in names if x in OURS or x.split("-")[0] in COLOURS]
    for axis, suite in zip(axes, ("paper", "corner", "push"), strict=True):
        axis.set(xscale="log", yscale="log", title=suite, xlabel="s from the start of the process")
        labels = []
        for name in names:
            colour = COLOURS.get(name.split("-")[0], BLUE)
            dashes = DASHES.get(name.split("-")[-1], "-")
            runs = [row["points"] for row in rows if row["contender"] == name]
            low = max(points[0]["seconds"] for points in runs)
            high = min(points[-1]["seconds"] for points in runs)
            time = np.geomspace(low, high, 40)
            curves = [
                np.exp(
                    np.interp(
                        np.log(time),
                        np.log([x["seconds"] for x in points]),
                        np.log([x[suite]["mean"] for x in points]),
                    )
                )
                for points in runs
            ]
            middle = np.median(curves, axis=0)
            band = np.min(curves, axis=0), np.max(curves, axis=0)
            axis.fill_between(time, *band, color=colour, alpha=0.15, lw=0)
            axis.plot(time, middle, color=colour, ls=dashes, lw=2.2 if name in OURS else 1.3)
            library, _, algorithm = name.partition("-")
            text = f"ours, {name}" if name in OURS else f"{library} {algorithm.upper()}"
            labels.append((text, colour, time[-1], middle[-1]))
        axis.set_xticks((5, 10, 20, 40, 80, 150), ("5", "10", "20", "40", "80", "150"))
        axis.xaxis.set_minor_locator(NullLocator())
        axis.yaxis.set_major_formatter("{x:g}")
        if axis is axes[-1]:
            figure.tight_layout()
            figures.label_right(axis, labels)
    axes[0].set_ylabel("mean tilt [deg]")
    return figure


ANIMATION_FPS, ANIMATION_S, ANIMATION_SIZE = 10, 14.0, (400, 300)


def balance() -> None:
    """Writes balance.webp: the shipped policy beside a robot that stands still, tilt over time."""
    policy = load_policy(HERE.parent / "policies" / "best.safetensors")
    scene = policy_scene(policy)
    names, controllers = (
        ("stands still", "policy"),
        (make_controller("none", scene), observing(policy)),
    )
    rollouts = [
        run_suite(scene, controller, "corner", 1, ANIMATION_S, SEEDS.held_out, record=True)
        for controller in controllers
    ]
    dt = scene.task.sim_dt
    time = dt * np.arange(1, rollouts[0].tilt.shape[1] + 1)
    figure, axis = plt.subplots(figsize=(ANIMATION_SIZE[0] / 50, 1.7), dpi=100)
    lines = [
        axis.plot([], [], color=color, linewidth=2, label=name)[0]
        for name, color in zip(names, (RED, BLUE), strict=True)
    ]
    axis.set(xlim=(0, ANIMATION_S), ylim=(0, 6.5), xlabel="time [s]", ylabel="body tilt [deg]")
    axis.axhline(scene.task.fail_tilt, color=GREY, linestyle=":")
    axis.text(0.1, scene.task.fail_tilt - 0.15, "a fall", color=GREY, va="top")
    axis.legend(frameon=False, loc="center", ncols=2)
    figure.tight_layout()
    frames, stride = [], round(1 / (ANIMATION_FPS * dt))
    with contextlib.closing(Painter(scene, ANIMATION_SIZE)) as painter:
        for step in range(0, len(time), stride):
            bodies = [
                labelled(painter.draw(rollout.qpos[0, step]), name, rollout.fell_at[0] <= step)
                for name, rollout in zip(names, rollouts, strict=True)
            ]
            for line, rollout in zip(lines, rollouts, strict=True):
                line.set_data(time[:step], rollout.tilt[0, :step])
            figure.canvas.draw()
            plot = np.asarray(figure.canvas.buffer_rgba())[..., :3]
            frames.append(Image.fromarray(np.vstack((np.hstack(bodies), plot))))
    first, *others = frames
    first.save(
        HERE / "balance.webp",
        save_all=True,
        append_images=others,
        duration=1000 // ANIMATION_FPS,
        loop=0,
        quality=60,
        method=6,
    )


def labelled(picture: np.ndarray, name: str, fallen: bool) -> np.ndarray:
    """The picture with a robot's name on it; a robot that has fallen is not simulated any more."""
    image = Image.fromarray(picture)
    words, font = f"{name}: fallen" if fallen else name, ImageFont.load_default(18)
    ImageDraw.Draw(image).text((12, 10), words, RED if fallen else "#10202c", font)
    return np.asarray(image)


def main() -> None:
    """Draws the named pictures, or all."""
    names = sys.argv[1:] or ["decision", "radial", "peers", "balance"]
    with matplotlib.rc_context(STYLE):
        if "balance" in names:
            balance()
        for draw in (decision, radial, peers):
            if draw.__name__ in names:
                figure = draw()
                figure.tight_layout()
                (HERE / f"{draw.__name__}.svg").write_bytes(figures.svg(figure))


if __name__ == "__main__":
    main()
