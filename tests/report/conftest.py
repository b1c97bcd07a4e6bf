"""Fixtures of the tests of reports: lines and results as a run writes them."""

from collections.abc import Callable
from typing import Any

import pytest


@pytest.fixture(scope="session")
def metrics_line() -> Callable[[int, int], dict[str, Any]]:
    """Number of a line, seeds -> that line of a metrics.jsonl."""

    def line(k: int, seeds: int) -> dict[str, Any]:
        names = "tilt_deg falls_per_minute reward loss epsilon".split()
        values: dict[str, Any] = {"env_steps": 1024 * (k + 1), "gradient_steps": k}
        values |= {f"train/{name}": 1 / (k + 1) for name in names}
        values |= {"perf/env_steps_per_second": 500.0, "perf/physics_steps_per_second": 25_000.0}
        if seeds > 1:
            each = [(n + 1) / (k + 1) for n in range(seeds)]
            values["seeds"] = dict.fromkeys(("tilt_deg", "reward", "loss"), each)
        return values

    return line


@pytest.fixture(scope="session")
def evaluation_result() -> Callable[[str, float], dict[str, Any]]:
    """Suite, tilt in degrees -> what a report takes from an evaluation."""

    def result(suite: str, tilt: float) -> dict[str, Any]:
        keys = ("mean", "rms", "p50", "p95", "p99", "max")
        tilts = dict.fromkeys(keys, tilt)
        return {"suite": suite, "scenarios": 8, "falls": 1, "tilt_deg": tilts}

    return result


@pytest.fixture(scope="session")
def evaluations(evaluation_result: Any) -> Callable[..., dict[str, Any]]:
    """Tilts on the suites paper and corner, in degrees -> the results of both."""

    def results(paper: float = 0.1, corner: float | None = None) -> dict[str, Any]:
        tilts = {"paper": paper, "corner": paper if corner is None else corner}
        return {suite: evaluation_result(suite, tilt) for suite, tilt in tilts.items()}

    return results
