"""What a reader of the figures reads: values, axes, units and labels, from the drawn artists."""

import dataclasses
import os
import re
import subprocess
import sys
from pathlib import Path
from typing import Any

import imageio.v3 as imageio
import numpy as np
import pytest
from matplotlib.axes import Axes
from matplotlib.collections import FillBetweenPolyCollection, QuadMesh
from scipy.spatial.transform import Rotation

from mjx_balance.config import Config
from mjx_balance.evaluation.envelope import Envelope
from mjx_balance.evaluation.rollout import Rollout
from mjx_balance.report import figures
from mjx_balance.sim.scene import Scene

NAMES = "train/tilt_deg train/falls_per_minute train/reward train/loss train/epsilon".split()
NAMES += ["perf/env_steps_per_second"]


def metrics_line(env_steps: int, values: list[float], **seeds: list[float]) -> dict[str, Any]:
    """A line of metrics.jsonl; `values` in the order of `NAMES`."""
    line = {"env_steps": env_steps} | dict(zip(NAMES, values, strict=True))
    return line | ({"seeds": seeds} if seeds else {})


def data(axis: Axes, line: int = 0) -> np.ndarray:
    """(points, 2) x and y of a line."""
    return np.asarray(axis.get_lines()[line].get_xydata())


def test_learning_curves_show_each_metric_under_its_name() -> None:
    lines = [metrics_line(500 * k, [k + 0.1 * n for n in range(6)]) for k in (1, 2, 4)]
    figure = figures.learning_curves([lines])
    assert [(axis.get_title(loc="left"), axis.get_yscale()) for axis in figure.axes] == [
        ("mean body tilt [deg]", "log"),
        ("falls per robot-minute", "symlog"),
        ("reward per decision", "linear"),
        ("squared TD error", "log"),
        ("epsilon", "linear"),
        ("decisions per second", "linear"),
    ]
    for n, axis in enumerate(figure.axes):
        expected = [(0.5, 1 + 0.1 * n), (1.0, 2 + 0.1 * n), (2.0, 4 + 0.1 * n)]
        np.testing.assert_allclose(data(axis), expected)
        assert axis.get_xlabel() == ("thousand decisions" if n >= 3 else "")
        assert not axis.collections, "one curve has no band"
    bottoms = [axis.get_ylim()[0] for axis in figure.axes]
    assert [bottoms[n] for n in (1, 4, 5)] == [0, 0, 0]


def test_learning_curves_show_the_median_and_the_extremes_over_seeds() -> None:
    lines = [
        metrics_line(1_000 * k, [9.0] * 6, tilt_deg=[1.0 * k, 5.0 * k, 2.0 * k]) for k in (1, 2)
    ]
    figure = figures.learning_curves([lines])
    np.testing.assert_allclose(data(figure.axes[0]), [(1, 2), (2, 4)])
    band = figure.axes[0].collections[0]
    assert isinstance(band, FillBetweenPolyCollection)
    corners = {tuple(x) for x in np.asarray(band.get_paths()[0].vertices, float).round(9).tolist()}
    assert corners == {(1, 1), (2, 2), (1, 5), (2, 10)}
    np.testing.assert_allclose(data(figure.axes[2])[:, 1], 9, err_msg="not logged by seed")


def test_learning_curves_join_runs_over_the_longest_of_them() -> None:
    long = [metrics_line(1_000 * k, [2.0 * k] * 6) for k in (1, 2, 3, 4)]
    # More lines, but not as long.
    short = [metrics_line(n, [10.0] * 6) for n in (2_000, 2_250, 2_500, 2_750, 3_000)]
    figure = figures.learning_curves([short, long])
    # Before and after the short run there is the long one alone; where both are, their median.
    np.testing.assert_allclose(data(figure.axes[0]), [(1, 2), (2, 7), (3, 8), (4, 8)])


def test_learning_curves_leave_out_what_is_no_number_or_no_loss_yet() -> None:
    losses = (0.0, 0.0, 0.5, np.nan, 0.25)
    lines = [metrics_line(1_000 * k, [1, 0, -1, x, 0, 1]) for k, x in enumerate(losses, 1)]
    figure = figures.learning_curves([lines])
    np.testing.assert_allclose(data(figure.axes[3]), [(3, 0.5), (5, 0.25)])
    np.testing.assert_allclose(data(figure.axes[1])[:, 1], 0, err_msg="no falls are shown as 0")
    np.testing.assert_allclose(data(figure.axes[2])[:, 1], -1)
    assert figure.axes[2].get_ylim()[0] < -1, "a negative reward can be seen"


def test_a_run_whose_first_lines_have_no_loss_yet_is_drawn() -> None:
    """No update has been made, as in preset `paper`: neither a line nor its seeds have a loss."""
    lines = [metrics_line(1_000 * k, [float(k)] * 6) for k in (1, 2, 3)]
    del lines[0]["train/loss"], lines[1]["train/loss"]
    figure = figures.learning_curves([lines])
    np.testing.assert_allclose(data(figure.axes[3]), [(3, 3)])
    lines = [metrics_line(1_000 * k, [9.0] * 6, loss=[1.0 * k, 3.0 * k]) for k in (1, 2)]
    lines[0]["seeds"]["loss"][1] = None
    figure = figures.learning_curves([lines])
    np.testing.assert_allclose(data(figure.axes[3]), [(1, 1), (2, 4)])
    del lines[0]["train/loss"], lines[0]["seeds"]["loss"]
    figure = figures.learning_curves([lines])
    np.testing.assert_allclose(data(figure.axes[3]), [(2, 4)])
    assert len(figure.axes[3].collections) == 1, "the extremes over the seeds"


def test_learning_curves_show_validations_as_points_beside_the_tilt() -> None:
    """Of a run of one seed, and of one of two, of which one has diverged at last."""
    paper, corner = "eval/paper/tilt_mean", "eval/corner/tilt_mean"
    one = [metrics_line(1_000 * k, [1.0] * 6) for k in (1, 2, 3)]
    one[1] |= {paper: 0.5, corner: 0.75}
    one[2] |= {paper: 0.25, corner: np.nan}
    two = [metrics_line(1_000 * k, [1.0] * 6, tilt_deg=[1.0, 1.0]) for k in (1, 4)]
    two[0] |= {paper: 3.0}
    two[0]["seeds"] |= {paper: [2.0, 4.0]}
    two[1] |= {paper: 0.125}
    two[1]["seeds"] |= {paper: [0.125, None]}
    axes = figures.learning_curves([one, two]).axes
    np.testing.assert_allclose(
        data(axes[0], 1), [(2, 0.5), (3, 0.25), (1, 2.0), (1, 4.0), (4, 0.125)]
    )
    np.testing.assert_allclose(data(axes[0], 2), [(2, 0.75)])
    assert [line.get_linestyle() for line in axes[0].get_lines()] == ["-", "None", "None"]
    legend = axes[0].get_legend().get_texts()
    assert [x.get_text() for x in legend] == ["exploring", "held out, paper", "held out, corner"]
    assert [len(axis.get_lines()) for axis in axes] == [3, 1, 1, 1, 1, 1]
    bare = figures.learning_curves([[metrics_line(1_000, [1.0] * 6)]]).axes[0]
    assert bare.get_legend() is None


def test_reward_figure_is_equation_4_and_our_figure_5(config: Config) -> None:
    task = dataclasses.replace(config.task, reward_toward=0.8, reward_toward_scale=1.6)
    left, right = figures.reward_figure(task).axes
    tilt, reward = data(left).T
    assert (tilt[0], tilt[-1]) == (0, 6)
    np.testing.assert_allclose(reward, 0.4 * np.exp(-1.5 * tilt), rtol=1e-6)
    (gain, up), (loss, down) = data(right, 0).T, data(right, 1).T
    assert (gain[0], gain[-1]) == (-2, 2)
    np.testing.assert_allclose(up[gain >= 0], 0.8 * np.clip(gain[gain >= 0] / 1.6, -1, 1))
    np.testing.assert_allclose(down[loss <= 0], 0.8 * np.clip(loss[loss <= 0] / 1.6, -1, 1))
    assert np.isnan(up[gain < 0]).all()
    assert np.isnan(down[loss > 0]).all()
    assert (left.get_xlabel(), left.get_ylabel()) == ("body tilt [deg]", "reward")
    assert right.get_xlabel() == "tilt before less tilt after [deg]"


def test_tilt_figure_shows_the_share_beyond_each_tilt() -> None:
    shares = {"policy": np.array([0.5, 0.3, 0.2, 0.0]), "none": np.array([0.0, 0.0, 0.0, 1.0])}
    axis = figures.tilt_figure(shares, np.array([0.0, 0.1, 1.0, 2.0, 5.0])).axes[0]
    policy, none = data(axis, 0), data(axis, 1)
    np.testing.assert_allclose(policy[:, 0], [0.1, 1.0, 2.0, 5.0])
    np.testing.assert_allclose(policy[:, 1], [0.5, 0.2, np.nan, np.nan])
    np.testing.assert_allclose(none[:, 1], [1.0, 1.0, 1.0, np.nan])
    labels = {text.get_text(): text for text in axis.texts}
    heights = {name: label.get_position()[1] for name, label in labels.items()}
    assert heights["none"] > heights["policy"] + 0.08, "the farthest on top, none over another"
    for name, line in zip(("policy", "none"), axis.get_lines()[:2], strict=True):
        assert labels[name].get_color() == line.get_color()
        assert labels[name].xy in [tuple(point) for point in np.asarray(line.get_xydata())]
    dashes = {line.get_linestyle() for line in axis.get_lines()[:2]}
    colours = {line.get_color() for line in axis.get_lines()[:2]}
    assert len(colours) == 2
    assert dashes == {"-"}
    assert axis.get_lines()[0].get_linewidth() > axis.get_lines()[1].get_linewidth()
    assert (axis.get_xscale(), axis.get_yscale()) == ("log", "log")
    assert axis.get_xlim() == (0.02, 5.0)
    assert axis.get_ylim()[1] > 1, "a curve that stays at 1 is seen"
    assert axis.get_xlabel() == "body tilt [deg]"


def test_envelope_figure_has_speed_to_the_right_and_incline_upward() -> None:
    falls, tilts = [[0.0, 0.1], [0.2, 0.3], [0.4, 0.5]], [[0.0, 1.0], [2.0, 3.0], [4.0, 5.0]]
    envelope = Envelope([2.0, 4.0, 6.0], [2.5, 3.5], falls, tilts, 3.25, 5.5, 2, 30.0, 0)
    figure = figures.envelope_figure(envelope, 7.5)
    left, right = figure.axes[:2]
    for axis, values, top, title in (
        (left, falls, 1.0, "share of the scenarios with a fall"),
        (right, tilts, 7.5, "mean body tilt [deg]"),
    ):
        mesh = next(c for c in axis.collections if isinstance(c, QuadMesh))
        np.testing.assert_allclose(np.asarray(mesh.get_array()).reshape(3, 2), values)
        corners = np.asarray(mesh.get_coordinates(), float)
        centres = (corners[:-1, :-1] + corners[1:, 1:]) / 2
        np.testing.assert_allclose(centres[..., 0], np.tile([2.5, 3.5], (3, 1)))
        np.testing.assert_allclose(centres[..., 1], np.tile([[2.0], [4.0], [6.0]], 2))
        assert mesh.get_clim() == (0, top)
        assert mesh.colorbar is not None
        np.testing.assert_allclose(data(axis), [(2.5, 5.5), (3.25, 5.5), (3.25, 2.0)])
        assert axis.get_lines()[0].get_linestyle() == "--"
        assert axis.get_title(loc="left") == title
        assert axis.get_xlabel() == "board speed on each axis [deg/s]"
    assert left.get_ylabel() == "board angle on both axes at once [deg]"
    (legend,) = figure.legends
    (text,) = legend.get_texts()
    assert text.get_text().startswith("to the right or above: out of reach")


def made_up_rollout(
    config: Config, scene: Scene, fell_at: int, level: float = 0.0
) -> tuple[Rollout, dict[str, np.ndarray]]:
    """22 s of a board and a body whose four angles, in deg, are all different."""
    steps = 5_500
    time = 0.004 * np.arange(1, steps + 1)
    angles = {
        "board X": 4 * np.sin(time) + level,
        "board Y": 2 * np.cos(time / 3),
        "body roll": np.sin(5 * time) + 0.5,
        "body pitch": 0.3 * np.cos(7 * time) - 1,
    }
    turned = Rotation.from_euler(
        "ZYX",
        np.stack((np.full(steps, 33.0), angles["body pitch"], angles["body roll"]), axis=-1),
        degrees=True,
    )
    qpos = np.tile(scene.stance.qpos, (1, steps, 1))
    qpos[0][:, scene.board_qpos[0]] = np.radians(angles["board X"])
    qpos[0][:, scene.board_qpos[1]] = np.radians(angles["board Y"])
    qpos[0][:, scene.trunk_quat] = turned.as_quat(scalar_first=True)
    tilt = np.full((1, steps), 0.25)
    tilt[0, :1_100] = 1.0
    actions = np.zeros((1, 110))
    rollout = Rollout(config.task, tilt, np.array([fell_at]), actions, qpos, seconds=1.0)
    return rollout, {"time": time} | angles


def test_rollout_figure_shows_each_angle_in_its_row(config: Config, scene: Scene) -> None:
    policy, angles = made_up_rollout(config, scene, fell_at=5_500)
    other, others = made_up_rollout(config, scene, fell_at=5_500, level=1.5)
    figure = figures.rollout_figure(scene, {"policy": policy, "pd-imu": other})
    board, roll, pitch, tilt = figure.axes
    time = angles["time"]
    for axis, values in (
        (board, [angles["board X"], angles["board Y"]]),
        (roll, [angles["body roll"], others["body roll"]]),
        (pitch, [angles["body pitch"], others["body pitch"]]),
    ):
        for line, expected in enumerate(values):
            curve = data(axis, line)
            np.testing.assert_allclose(curve[:, 0], time)
            np.testing.assert_allclose(curve[:, 1], expected, atol=1e-9)
    for axis in figure.axes:
        dotted = [line for line in axis.get_lines() if line.get_linestyle() == ":"]
        changes = [np.asarray(line.get_xdata(), float)[0] for line in dotted]
        assert changes == [0, 10, 20], "a new target every 10 s"
    # The greatest of both: 1.5 deg of roll, -1.3 of pitch; not that of the board.
    for axis in (roll, pitch):
        assert axis.get_ylim() == pytest.approx((-1.65, 1.65), abs=1e-3)
    x, y = np.radians(angles["board X"]), np.radians(angles["board Y"])
    still = np.degrees(np.arccos(np.cos(x) * np.cos(y)))
    np.testing.assert_allclose(data(tilt, 0)[:, 1], still, atol=1e-6)
    np.testing.assert_allclose(data(tilt, 1)[:, 1], policy.tilt[0])
    assert tilt.get_yscale() == "log"
    assert tilt.get_ylim()[1] > 7, "the steepest board fits"
    assert [axis.get_ylabel() for axis in figure.axes] == [
        *("board [deg]", "body roll [deg]", "body pitch [deg]", "tilt [deg]")
    ]
    assert {text.get_text() for text in board.texts} == {"X", "Y"}
    legend = [text.get_text() for text in figure.legends[0].get_texts()]
    assert legend == [
        f"standing still (the board's tilt): mean {still.mean():.2f}, max {still.max():.2f} deg",
        "policy: mean 0.400, max 1.00 deg",  # a fifth of the time 1, else 0.25
        "pd-imu: mean 0.400, max 1.00 deg",
    ]
    assert tilt.get_xlabel() == "time [s]; dotted: the board takes a new target"


def test_a_fall_of_another_does_not_flatten_the_policys_angles(
    config: Config, scene: Scene
) -> None:
    policy, _ = made_up_rollout(config, scene, fell_at=5_500)
    other, _ = made_up_rollout(config, scene, fell_at=5_499)
    other.qpos[0, :, scene.trunk_quat[1]] += 0.5  # pyright: ignore[reportOptionalSubscript]
    figure = figures.rollout_figure(scene, {"policy": policy, "none": other})
    assert figure.axes[1].get_ylim() == pytest.approx((-1.65, 1.65), abs=1e-3)
    assert figure.legends[0].get_texts()[-1].get_text().endswith("max 1.00 deg, falls")


def luminance(colour: str) -> float:
    """Relative luminance of `#rrggbb`, 0 to 1 (WCAG 2.2)."""
    values = np.asarray([int(colour[k : k + 2], 16) / 255 for k in (1, 3, 5)])
    linear = np.where(values <= 0.04045, values / 12.92, ((values + 0.055) / 1.055) ** 2.4)
    return float(linear @ (0.2126, 0.7152, 0.0722))


def test_every_colour_is_seen_on_both_grounds() -> None:
    """A contrast of at least 3 to 1, as WCAG 2.2 asks of graphics."""
    for light, dark in figures.DARK.items():
        assert 1.05 / (luminance(light) + 0.05) >= 3, light
        assert (luminance(dark) + 0.05) / (luminance("#12161c") + 0.05) >= 3, dark


def test_an_svg_has_no_colour_that_only_a_light_page_shows(config: Config) -> None:
    text = figures.svg(figures.reward_figure(config.task)).decode()
    style = re.findall(r"<style>(.*?)</style>", text)[0]
    light, dark = style.split("@media(prefers-color-scheme:dark)")
    for name, colour in enumerate(figures.DARK):
        assert f"--c{name}:{colour};" in light
        assert f"--c{name}:{figures.DARK[colour]};" in dark
    rest = text.replace(style, "")
    colours = set(re.findall(r"#[0-9a-f]{6}\b", rest)) - {"#000000", "#ffffff"}
    assert not colours, "all are variables"
    assert f"var(--c{list(figures.DARK).index(figures.BLUE)})" in rest
    assert "fill: #ffffff" not in rest, "no white ground"
    again = figures.svg(figures.reward_figure(config.task)).decode()
    assert again == text, "the same file from the same figure"


def test_a_runs_figures_are_drawn_from_what_they_are_given(
    config: Config, scene: Scene, tmp_path: Path
) -> None:
    lines = [metrics_line(1_000, [1.0] * 6), metrics_line(2_000, [0.5] * 6)]
    rollout, _ = made_up_rollout(config, scene, 5_500)
    folder = tmp_path / "figures"
    files = figures.draw_figures(folder, lines, config.task, scene, {"policy": rollout})
    assert [file.name for file in files] == ["learning_curves.png", "reward.png", "rollout.png"]
    assert sorted(folder.iterdir()) == sorted(files)
    sizes = [imageio.imread(file).shape[:2] for file in files]
    for (height, width), (tall, wide) in zip(sizes, ((6, 12), (3.4, 9), (7.6, 11)), strict=True):
        assert 140 * wide < width < 160 * wide, "150 dots per inch"
        assert 140 * tall < height < 160 * tall


@pytest.mark.parametrize("backend", ["module://of_a_notebook.backend", "pdf"])
def test_figures_need_no_backend_of_the_user_and_leave_it_alone(backend: str) -> None:
    """A notebook's, inherited by a command in it, is often not installed where we are."""
    draw = (
        "import os\n"
        "from mjx_balance.config import preset\n"
        "from mjx_balance.report import figures\n"
        "assert figures.png(figures.reward_figure(preset('paper').task))[1:4] == b'PNG'\n"
        "print(os.environ['MPLBACKEND'], figures.mpl.rcParams['backend'])\n"
    )
    command, environment = [sys.executable, "-c", draw], os.environ | {"MPLBACKEND": backend}
    output = subprocess.run(command, env=environment, capture_output=True, text=True, check=True)
    name, used = output.stdout.split()
    assert name == backend
    assert backend != "pdf" or used == "pdf", "others' figures take it"
