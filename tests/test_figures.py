"""What a reader of the figures reads: values, axes, units and labels, from the drawn artists."""

import dataclasses
from typing import Any

import numpy as np
import pytest
from matplotlib.axes import Axes
from matplotlib.collections import FillBetweenPolyCollection, QuadMesh

from mjx_balance.config import Config
from mjx_balance.evaluation import Envelope
from mjx_balance.report import figures

NAMES = (
    "train/tilt_deg",
    "train/falls_per_minute",
    "train/reward",
    "train/loss",
    "train/epsilon",
    "perf/env_steps_per_second",
)


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
    titles = [
        "mean body tilt [deg]",
        "falls per robot-minute",
        "reward per decision",
        "squared TD error",
        "epsilon",
        "decisions per second",
    ]
    scales = ["log", "symlog", "linear", "log", "linear", "linear"]
    for n, (axis, title, scale) in enumerate(zip(figure.axes, titles, scales, strict=True)):
        assert title in (axis.get_title(), axis.get_title(loc="left"))
        assert axis.get_yscale() == scale
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
    short = [metrics_line(2_000, [10.0] * 6), metrics_line(3_000, [10.0] * 6)]
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
    legend = axis.get_legend()
    assert legend is not None
    assert [text.get_text() for text in legend.get_texts()] == ["policy", "none"]
    assert axis.get_lines()[0].get_linewidth() > axis.get_lines()[1].get_linewidth()
    assert (axis.get_xscale(), axis.get_yscale()) == ("log", "log")
    assert axis.get_xlim() == (0.02, 5.0)
    assert axis.get_xlabel() == "body tilt [deg]"


def test_envelope_figure_has_speed_to_the_right_and_incline_upward() -> None:
    envelope = Envelope(
        inclines=[2.0, 4.0, 6.0],
        rates=[2.5, 3.5],
        fall_rate=[[0.0, 0.1], [0.2, 0.3], [0.4, 0.5]],
        mean_tilt=[[0.0, 1.0], [2.0, 3.0], [4.0, 5.0]],
        authority=3.25,
        reach=5.5,
        scenarios=2,
        duration_s=30.0,
        seed=0,
    )
    figure = figures.envelope_figure(envelope, 7.5)
    falls, tilt = figure.axes[:2]
    for axis, values, top, title in (
        (falls, envelope.fall_rate, 1.0, "share of the scenarios with a fall"),
        (tilt, envelope.mean_tilt, 7.5, "mean body tilt [deg]"),
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
        assert title in (axis.get_title(), axis.get_title(loc="left"))
        assert axis.get_xlabel() == "board speed on each axis [deg/s]"
    assert falls.get_ylabel() == "board angle on both axes at once [deg]"


@pytest.fixture(autouse=True)
def _close_figures():
    yield
    figures.plt.close("all")
