"""Lines and results as a run writes them, made up."""

from typing import Any


def metrics_line(k: int, seeds: int) -> dict[str, Any]:
    """Line k of a metrics.jsonl, of one seed or several."""
    names = "tilt_deg falls_per_minute reward loss epsilon".split()
    line: dict[str, Any] = {"env_steps": 1024 * (k + 1), "gradient_steps": k}
    line |= {f"train/{name}": 1 / (k + 1) for name in names}
    line |= {"perf/env_steps_per_second": 500.0, "perf/physics_steps_per_second": 25_000.0}
    if seeds > 1:
        values = [(n + 1) / (k + 1) for n in range(seeds)]
        line["seeds"] = dict.fromkeys(("tilt_deg", "reward", "loss"), values)
    return line


def evaluation_result(suite: str, tilt: float) -> dict[str, Any]:
    """What a report takes from an evaluation."""
    keys = ("mean", "rms", "p50", "p95", "p99", "max")
    return {"suite": suite, "scenarios": 8, "falls": 1, "tilt_deg": dict.fromkeys(keys, tilt)}
