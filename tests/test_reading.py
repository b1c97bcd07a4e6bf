"""What is read of a run folder: all there is, checked, and one sentence for the rest."""

import json
from pathlib import Path
from typing import Any

import pytest

from mjx_balance.report import reading


def metrics_line(k: int, seeds: int) -> dict[str, Any]:
    names = "tilt_deg falls_per_minute reward loss epsilon".split()
    line: dict[str, Any] = {"env_steps": 1024 * (k + 1), "gradient_steps": k}
    line |= {f"train/{name}": 1 / (k + 1) for name in names}
    line |= {"perf/env_steps_per_second": 500.0, "perf/physics_steps_per_second": 25_000.0}
    if seeds > 1:
        values = [(n + 1) / (k + 1) for n in range(seeds)]
        line["seeds"] = dict.fromkeys(("tilt_deg", "reward", "loss"), values)
    return line


GOOD_LINE = json.dumps(metrics_line(0, 1))


@pytest.mark.parametrize(
    ("name", "content", "said"),
    [
        ("config.json", "[]", "config.json cannot be used: Config is []; it must map"),
        ("config.json", '{"task": []}', "config.json cannot be used: TaskConfig is []"),
        ("config.json", '{"dqn": {"gamma": "x"}}', "gamma is 'x'; it must be a number"),
        ("metrics.jsonl", f'{GOOD_LINE}\n{{"env_st', "metrics.jsonl is shown up to line 2"),
        ("metrics.jsonl", f'{GOOD_LINE}\n{{"env_steps": 9}}', "it has no 'train/tilt_deg'"),
        ("metrics.jsonl", f"{GOOD_LINE}\n5", "metrics.jsonl is shown up to line 2"),
        ("seeds.json", '{"best": 1}', "seeds.json cannot be used: it has no 'seeds'"),
        ("seeds.json", "[1]", "seeds.json cannot be used"),
        ("evaluation.json", '{"paper": {"falls": 0}}', "evaluation.json cannot be used: it has no"),
        ("evaluation.json", '{"paper": 1}', "evaluation.json cannot be used"),
    ],
)
def test_contents_that_are_not_a_runs_are_named_and_the_rest_is_read(
    tmp_path: Path, name: str, content: str, said: str
) -> None:
    (tmp_path / "metrics.jsonl").write_text(f"{GOOD_LINE}\n")
    (tmp_path / name).write_text(content)
    run = reading.read_run(tmp_path)
    assert said in "\n".join(run.missing)
    assert run.metrics == [metrics_line(0, 1)]


def test_metrics_without_a_line_are_said(tmp_path: Path) -> None:
    (tmp_path / "config.json").write_text("{}")
    (tmp_path / "metrics.jsonl").write_text("")
    said = "\n".join(reading.read_run(tmp_path).missing)
    assert "metrics.jsonl cannot be used: it holds no line yet" in said
