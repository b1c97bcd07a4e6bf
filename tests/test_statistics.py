"""Statistics over seeds, by hand."""

import numpy as np
import pytest

from mjx_balance.statistics import interquartile_mean, interval, over_seeds


def test_interquartile_mean_leaves_the_extremes_out() -> None:
    assert interquartile_mean([1.0, 2.0, 3.0, 100.0]) == 2.5
    assert interquartile_mean([5.0]) == 5.0
    assert interquartile_mean([0.0, 1.0, 2.0, 3.0, 4.0, 5.0, 6.0, 70.0]) == 3.5


def test_interval_holds_the_truth_as_often_as_it_says(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("mjx_balance.statistics.RESAMPLES", 1_000)
    rng = np.random.default_rng(0)
    hits = 0
    for _ in range(200):
        low, high = interval(rng.normal(size=20).tolist())
        hits += low <= 0 <= high
    assert 176 <= hits <= 196, "95% is 190; three standard deviations are 9"


def test_one_seed_is_its_own_interval() -> None:
    assert interval([0.1]) == (0.1, 0.1)
    assert interval([0.1, 0.1, 0.1]) == (0.1, 0.1)


def test_summary_over_seeds() -> None:
    results = [
        {"scenarios": 10, "falls": f, "tilt_deg": {"mean": m, "p95": 2 * m, "max": 3 * m}}
        for f, m in ((0, 0.1), (1, 0.2), (0, 0.3), (2, 0.4), (0, 0.5))
    ]
    summary = over_seeds(results)
    assert (summary["seeds"], summary["scenarios"], summary["falls"]) == (5, 50, 3)
    assert summary["mean"]["iqm"] == pytest.approx(0.3)
    assert summary["max"]["worst"] == pytest.approx(1.5)
    assert 0.1 <= summary["mean"]["low"] < 0.3 < summary["mean"]["high"] <= 0.5
