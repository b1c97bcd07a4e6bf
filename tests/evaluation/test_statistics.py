"""Statistics over seeds, by hand and by a second bootstrap."""

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from mjx_balance.evaluation.statistics import interquartile_mean, interval, over_seeds

SKEWED = np.geomspace(0.1, 4.0, 16).tolist()


def test_interquartile_mean_leaves_the_extremes_out() -> None:
    assert interquartile_mean([3.0, 100.0, 1.0, 2.0]) == 2.5, "sorted first"
    assert interquartile_mean([5.0]) == 5.0
    assert interquartile_mean([0.0, 1.0, 2.0, 3.0, 4.0, 5.0, 6.0, 70.0]) == 3.5
    assert interquartile_mean([-9.0, 1.0, 2.0, 6.0, 50.0]) == 3.0, "of five, the middle three"
    assert interquartile_mean([1.0, 2.0, 6.0]) == 3.0, "of three, all"


def test_interval_holds_the_truth_as_often_as_it_says(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("mjx_balance.evaluation.statistics.RESAMPLES", 1_000)
    rng = np.random.default_rng(0)
    hits = 0
    for _ in range(200):
        low, high = interval(rng.normal(size=20).tolist())
        hits += low <= 0 <= high
    assert 176 <= hits <= 196, "95% is 190; three standard deviations are 9"


def test_interval_is_that_of_a_bootstrap_written_out() -> None:
    """Of skewed numbers, where other intervals and other averages lie elsewhere."""
    drawn = np.random.default_rng(1).choice(SKEWED, (20_000, 16))
    means = np.sort(drawn, axis=1)[:, 4:12].mean(axis=1)
    assert interval(SKEWED) == pytest.approx(np.percentile(means, (2.5, 97.5)), rel=0.03)
    assert interval(SKEWED) == interval(SKEWED), "the same whenever it is asked"


def test_one_seed_is_its_own_interval() -> None:
    assert interval([0.1]) == (0.1, 0.1)
    assert interval([0.1, 0.1, 0.1]) == (0.1, 0.1)


@settings(deadline=None, max_examples=20)
@given(st.lists(st.floats(0, 6), min_size=1, max_size=6))
def test_the_mean_lies_in_its_interval_and_that_in_the_values(values: list[float]) -> None:
    low, high = interval(values)
    mean, slack = interquartile_mean(values), 1e-9
    assert min(values) - slack <= low <= mean + slack
    assert mean - slack <= high <= max(values) + slack


def test_summary_over_seeds() -> None:
    results = [
        {"scenarios": n, "falls": f, "tilt_deg": {"mean": m, "p95": 2 * m, "max": 3 * m}}
        for n, f, m in ((10, 0, 0.4), (10, 1, 0.2), (20, 0, 0.6), (10, 2, 0.1), (10, 0, 0.5))
    ]
    summary = over_seeds(results)
    assert list(summary) == ["seeds", "scenarios", "falls", "mean", "p95", "max"]
    assert (summary["seeds"], summary["scenarios"], summary["falls"]) == (5, 60, 3)
    middle = (0.4 + 0.2 + 0.5) / 3
    for name, factor in (("mean", 1), ("p95", 2), ("max", 3)):
        row = summary[name]
        low, high = interval([factor * m for m in (0.4, 0.2, 0.6, 0.1, 0.5)])
        assert row["iqm"] == pytest.approx(factor * middle)
        assert (row["low"], row["high"]) == (low, high)
        assert low < row["iqm"] < high
        assert row["worst"] == pytest.approx(factor * 0.6), "more tilt is worse"
