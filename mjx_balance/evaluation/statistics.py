"""Statistics over training seeds."""

from collections.abc import Sequence
from typing import Any

import numpy as np

CONFIDENCE = 0.95
RESAMPLES = 10_000
TILTS = ("mean", "p95", "max")


def interquartile_mean(values: Sequence[float] | np.ndarray, axis: int = 0) -> Any:
    """Mean of the middle half, the robust average of Agarwal et al. 2021.

    https://arxiv.org/abs/2108.13264, section 4.3
    """
    from scipy import stats  # half a second that a training's start need not wait for

    return stats.trim_mean(values, 0.25, axis=axis)


def interval(values: Sequence[float]) -> tuple[float, float]:
    """95% percentile bootstrap interval of the interquartile mean; equal values are their own."""
    from scipy import stats

    if min(values) == max(values):
        return values[0], values[0]
    result = stats.bootstrap(
        (values,),
        interquartile_mean,
        confidence_level=CONFIDENCE,
        n_resamples=RESAMPLES,
        method="percentile",
        rng=np.random.default_rng(0),
    )
    return float(result.confidence_interval.low), float(result.confidence_interval.high)


def over_seeds(results: Sequence[dict[str, Any]]) -> dict[str, Any]:
    """Summarises one suite's evaluations, one per training seed.

    Args:
      results: JSON of `rollout.summarize`, one per seed.

    Returns:
      seeds, falls (their sum), scenarios (their sum), and for each of mean, p95 and max the
      interquartile mean, its interval, and the worst seed's value.
    """
    summary: dict[str, Any] = {"seeds": len(results)}
    summary |= {name: sum(r[name] for r in results) for name in ("scenarios", "falls")}
    for name in TILTS:
        values = [r["tilt_deg"][name] for r in results]
        low, high = interval(values)
        iqm = float(interquartile_mean(values))
        summary[name] = {"iqm": iqm, "low": low, "high": high, "worst": max(values)}
    return summary
