"""What is read of a run folder: all there is, checked, and one sentence for the rest."""

import copy
import functools
import gc
import json
import shutil
import time
import tracemalloc
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

from mjx_balance.config import preset, to_dict
from mjx_balance.files import run_folder
from mjx_balance.report import page, reading
from mjx_balance.report.reading import ReportError, Run

HOSTILE = "<img src=x onerror=alert(1)>"
AGAIN = "the first line again"


@pytest.fixture
def read(tmp_path: Path) -> Callable[[list[dict[str, Any]]], Run]:
    """Lines of a metrics.jsonl -> what is read of a folder that holds them."""

    def read_lines(lines: list[dict[str, Any]]) -> Run:
        (tmp_path / "metrics.jsonl").write_text("\n".join(map(json.dumps, lines)))
        return reading.read_run(tmp_path)

    return read_lines


@pytest.fixture(scope="session")
def good(metrics_line: Any, evaluations: Any) -> dict[str, Any]:
    """The files of a run of two seeds."""
    return {
        "config.json": to_dict(preset("default")),
        "metrics.jsonl": [metrics_line(0, 2), metrics_line(1, 2)],
        "evaluation.json": evaluations(),
        "seeds.json": {"seeds": [{"evaluation": evaluations()}] * 2},
    }


@pytest.mark.parametrize(
    ("name", "content", "said"),
    [
        ("config", "[]", "config.json cannot be used: Config is []; it must map"),
        ("config", '{"task": []}', "config.json cannot be used: task is []; it must map"),
        ("config", '{"dqn": {"gamma": "x"}}', "gamma is 'x'; it must be a finite number"),
        ("config", b"\x80", "config.json cannot be used: it is no JSON"),
        ("seeds", '{"best": 1}', "seeds.json cannot be used: seeds is missing"),
        ("seeds", "[1]", "seeds.json cannot be used: it is [1]; it must map its fields"),
        ("seeds", '{"seeds": {}}', "seeds is {}; it must be a list"),
        ("seeds", f'{{"seeds": [{"{}, " * 1000}{{}}]}}', "length of at most 1000"),
        ("evaluation", '{"paper": {"falls": 0}}', "evaluation.json cannot be used: scenarios is "),
        ("evaluation", '{"paper": 1}', "paper is 1; it must map its fields to values"),
        ("evaluation", "[" * 100_000, "evaluation.json cannot be used: it is nested too deep"),
        ("evaluation", "9" * 5_000, "evaluation.json cannot be used: it is no JSON: Exceeds"),
        ("evaluation", " " * (2**21 + 1), "it is 2.0 MiB long; at most 1 MiB are read"),
        ("evaluation", b"\xff\xfe\x00{", "evaluation.json cannot be used: it is no JSON"),
        ("evaluation", '{"\\u001b[2J\\ud800": 1}', "cannot be used: it is {'\\x1b[2J\\ud800'"),
    ],
)
def test_contents_that_are_not_a_runs_are_named_and_the_rest_is_read(
    tmp_path: Path, name: str, content: str | bytes, said: str, metrics_line: Any, read: Any
) -> None:
    content = content.encode() if isinstance(content, str) else content
    (tmp_path / f"{name}.json").write_bytes(content)
    run = read([metrics_line(0, 1)])
    assert said in "\n".join(run.missing)
    assert len(run.metrics) == 1
    assert all(len(sentence) < 500 for sentence in run.missing)


@pytest.mark.parametrize(
    ("content", "said"),
    [
        ('{"env_st', "metrics.jsonl is shown up to line 2"),
        ('{"env_steps": 9999}', "train/tilt_deg is None; it must"),
        ("5", "metrics.jsonl is shown up to line 2"),
        (AGAIN, "line 2, which cannot be used: env_steps is 1"),
        (" " * 2**19, "line 2, which cannot be used: it is longer"),
    ],
)
def test_metrics_are_read_up_to_the_first_line_that_is_none(
    tmp_path: Path, content: str, said: str, metrics_line: Any
) -> None:
    first = json.dumps(metrics_line(0, 1))
    second = first if content == AGAIN else content
    (tmp_path / "metrics.jsonl").write_text(f"{first}\n{second}")
    run = reading.read_run(tmp_path)
    assert said in "\n".join(run.missing)
    assert len(run.metrics) == 1


def test_a_folder_in_a_files_place_is_said(tmp_path: Path, metrics_line: Any, read: Any) -> None:
    for name in ("config.json", "seeds.json"):
        (tmp_path / name).mkdir()
    said = read([metrics_line(0, 1)]).missing
    assert f"{tmp_path / 'config.json'} is no file" in said
    assert f"{tmp_path / 'evaluation.json'} is missing" in said


HUGE = 10**400


@pytest.mark.parametrize(
    ("where", "value", "said"),
    [
        ("falls", HOSTILE, "falls is '<img"),
        ("falls", "1", "falls is '1'; it must be a whole number"),
        ("falls", True, "falls is True; it must be a whole number"),
        ("falls", 1.5, "falls is 1.5; it must be a whole number"),
        ("falls", -1, "falls is -1; it must be at least 0"),
        ("falls", HUGE, "falls is 10000"),
        ("falls", 9, "falls is 9; it must not exceed scenarios, 8"),
        ("scenarios", [8], "scenarios is [8]; it must be a whole number"),
        ("scenarios", None, "scenarios is None"),
        ("scenarios", HOSTILE, "scenarios is '<img"),
        ("tilt_deg", HOSTILE, "tilt_deg is '<img"),
        ("mean", HOSTILE, "mean is '<img"),
        ("mean", False, "mean is False; it must be a finite number"),
        ("p95", float("nan"), "p95 is nan; it must be a finite number"),
        ("max", float("inf"), "max is inf; it must be a finite number"),
        ("max", HUGE, "max is 1000"),
        ("max", None, "max is None"),
    ],
)
def test_results_are_numbers(
    tmp_path: Path,
    where: str,
    value: Any,
    said: str,
    evaluations: Any,
    metrics_line: Any,
    read: Any,
) -> None:
    results = evaluations()
    corner = results["corner"]
    (corner if where in corner else corner["tilt_deg"])[where] = value
    (tmp_path / "evaluation.json").write_text(json.dumps(results))
    (tmp_path / "seeds.json").write_text(json.dumps({"seeds": [{"evaluation": results}]}))
    run = read([metrics_line(0, 1)])
    assert run.results == []
    for name in ("evaluation.json", "seeds.json"):
        (sentence,) = [x for x in run.missing if f"{name} cannot be used" in x]
        assert said in sentence.replace(" of seeds[0]", "")


@pytest.mark.parametrize(
    ("where", "value"),
    [
        ("env_steps", "1024"),
        ("env_steps", -1),
        ("env_steps", 1024.5),
        ("env_steps", HUGE),
        ("train/loss", HOSTILE),
        ("train/loss", None),
        ("train/loss", HUGE),
        ("perf/env_steps_per_second", True),
        ("seeds", HOSTILE),
        ("seeds", {"loss": HOSTILE}),
        ("seeds", {"loss": 1.0}),
        ("seeds", {"loss": [1.0, HOSTILE]}),
        ("seeds", {"loss": []}),
        ("eval/paper/tilt_mean", HOSTILE),
        ("seeds", {"eval/paper/tilt_mean": [HOSTILE]}),
    ],
)
def test_metrics_are_numbers(where: str, value: Any, metrics_line: Any, read: Any) -> None:
    run = read([metrics_line(0, 1), metrics_line(1, 1) | {where: value}])
    assert len(run.metrics) == 1
    assert "metrics.jsonl is shown up to line 2, which cannot be used: " in "".join(run.missing)


def test_seeds_that_change_along_the_way_are_refused(metrics_line: Any, read: Any) -> None:
    run = read([metrics_line(0, 3), metrics_line(1, 2)])
    assert len(run.metrics) == 1
    assert "other seeds than in line 1" in "".join(run.missing)


def test_validations_are_read_where_there_are_any(metrics_line: Any, read: Any) -> None:
    name = "eval/corner/tilt_mean"
    lines = [metrics_line(k, 2) for k in range(3)]
    lines[1] |= {name: 0.5, "eval/corner/falls": 1}
    lines[1]["seeds"] = lines[1]["seeds"] | {name: [0.5, None]}
    lines[2] |= {name: 0.25}
    run = read(lines)
    assert [line.get(name) for line in run.metrics] == [None, 0.5, 0.25]
    np.testing.assert_array_equal(run.metrics[1]["seeds"][name], [0.5, np.nan])
    assert name not in run.metrics[2]["seeds"]
    assert "eval/corner/falls" not in run.metrics[1]


def test_a_loss_that_is_no_number_is_a_gap(metrics_line: Any, read: Any) -> None:
    """And so is one that is missing, before the first update."""
    lines = [metrics_line(k, 2) for k in range(3)]
    del lines[0]["train/loss"]
    lines[0]["seeds"] = {name: x for name, x in lines[0]["seeds"].items() if name != "loss"}
    lines[1]["train/loss"] = float("nan")
    lines[1]["seeds"] = lines[1]["seeds"] | {"loss": [float("-inf"), 1.0]}
    run = read(lines)
    assert not any("metrics" in sentence for sentence in run.missing)
    np.testing.assert_array_equal([x["train/loss"] for x in run.metrics], [np.nan, np.nan, 1 / 3])
    assert "loss" not in run.metrics[0]["seeds"]
    np.testing.assert_array_equal(run.metrics[1]["seeds"]["loss"], [np.nan, 1.0])


def test_of_long_metrics_the_beginning_is_read(
    monkeypatch: pytest.MonkeyPatch, metrics_line: Any, read: Any
) -> None:
    lines = [metrics_line(k, 1) for k in range(4)]
    assert 10_000 * len(json.dumps(lines[0])) < reading.METRICS_BYTES, "no run logs so much"
    monkeypatch.setattr(reading, "METRICS_BYTES", len("\n".join(map(json.dumps, lines[:3]))) - 1)
    run = read(lines)
    assert [line["env_steps"] for line in run.metrics] == [1024, 2048], "the third is cut off"
    assert "metrics.jsonl is 0.0 MiB long; its first 0 MiB are shown" in "".join(run.missing)


def test_only_what_the_report_shows_is_kept(
    tmp_path: Path, metrics_line: Any, evaluation_result: Any, read: Any
) -> None:
    line = metrics_line(0, 2) | {"train/note": HOSTILE, "more": [HOSTILE]}
    line["seeds"] = {"loss": [1, 2.5], "note": [HOSTILE]}
    result = evaluation_result("paper", 0.25) | {"note": HOSTILE, "falls": 8}
    (tmp_path / "evaluation.json").write_text(json.dumps({"paper": result}))
    run = read([line])
    assert run.metrics[0]["seeds"] == {"loss": [1.0, 2.5]}
    assert run.metrics[0]["train/tilt_deg"] == 1.0
    tilt = {"mean": 0.25, "p95": 0.25, "max": 0.25}
    expected = {"scenarios": 8, "falls": 8, "tilt_deg": tilt, "action_mm_settled": None}
    assert run.results == [{"paper": expected}]
    assert "<" not in repr((run.metrics, run.results))


def test_metrics_without_a_line_are_said(tmp_path: Path, read: Any) -> None:
    (tmp_path / "config.json").write_text("{}")
    said = "\n".join(read([]).missing)
    assert "metrics.jsonl cannot be used: it holds no line yet" in said


JSON = st.recursive(
    st.none()
    | st.booleans()
    | st.integers()
    | st.integers(10**15, 10**60)
    | st.floats()
    | st.text(max_size=8)
    | st.just(HOSTILE),
    lambda inner: (
        st.lists(inner, max_size=3) | st.dictionaries(st.text(max_size=6), inner, max_size=3)
    ),
    max_leaves=6,
)


def places(value: Any) -> list[tuple]:
    """The paths of all values inside a JSON value."""
    inside = value.items() if isinstance(value, dict) else enumerate(value)
    found: list[tuple] = []
    for key, part in inside:
        found.append((key,))
        if isinstance(part, (dict, list)):
            found += [(key, *more) for more in places(part)]
    return found


def written(name: str, value: Any) -> bytes:
    lines = value if name == "metrics.jsonl" and isinstance(value, list) else [value]
    return "\n".join(map(json.dumps, lines)).encode("utf-8", "surrogatepass")


@st.composite
def damaged(draw: st.DrawFn, good: dict[str, Any]) -> dict[str, bytes]:
    """A run folder in which one file was exchanged, edited, cut off or flipped."""
    files = {name: written(name, value) for name, value in good.items()}
    name = draw(st.sampled_from(sorted(good)))
    how = draw(st.sampled_from(("any JSON", "edited", "key lost", "cut off", "flipped", "garbage")))
    if how == "any JSON":
        files[name] = written(name, draw(JSON))
    elif how in ("edited", "key lost"):
        value = copy.deepcopy(good[name])
        *path, last = draw(st.sampled_from(places(value)))
        inside = functools.reduce(lambda part, key: part[key], path, value)
        if how == "key lost":
            del inside[last]
        else:
            inside[last] = draw(JSON)
        files[name] = written(name, value)
    elif how == "cut off":
        files[name] = files[name][: draw(st.integers(0, len(files[name]) - 1))]
    elif how == "flipped":
        content = bytearray(files[name])
        content[draw(st.integers(0, len(content) - 1))] ^= draw(st.integers(1, 255))
        files[name] = bytes(content)
    else:
        files[name] = draw(st.binary(max_size=64))
    return files


@pytest.mark.slow
@settings(deadline=1_000, max_examples=300, suppress_health_check=[HealthCheck.too_slow])
@given(data=st.data())
def test_a_damaged_folder_is_read_as_far_as_it_goes(
    tmp_path_factory: pytest.TempPathFactory, data: st.DataObject, good: dict[str, Any]
) -> None:
    files = data.draw(damaged(good))
    folder = tmp_path_factory.mktemp("run")
    for name, content in files.items():
        (folder / name).write_bytes(content)
    run = reading.read_run(folder)
    assert sum(bool(x) for x in (run.config, run.metrics, run.results)) >= 2, "one file is damaged"
    for sentence in run.missing:
        assert sentence.isprintable()
        assert len(sentence) < 600
        sentence.encode()
    for line in run.metrics:
        assert all(isinstance(line[name], (int, float)) for name in line if name != "seeds")
    for results in run.results:
        assert results == reading.suite_results(results)
    page.seeds_statistics(run, [run, run])
    shutil.rmtree(folder)


UNITS = (b"[", b"[],", b"9", b"\n", b'{"a":', b"\xff", b'"', b"{}\n", b"1e9,")


@pytest.mark.slow
@pytest.mark.parametrize("unit", UNITS)
@pytest.mark.parametrize("name", ["config.json", "evaluation.json", "metrics.jsonl", "seeds.json"])
def test_a_flood_is_refused_soon_and_in_little_memory(
    tmp_path: Path, name: str, unit: bytes
) -> None:
    for size in (run_folder.READ_AT_MOST - 100, 16 * 2**20):
        flood = unit * (size // len(unit))
        if unit.endswith(b","):
            flood = b"[%s0]" % flood
        (tmp_path / name).write_bytes(flood)
        gc.collect()
        gc.freeze()  # what other tests have left is not the reader's to look through
        began = time.process_time()
        with pytest.raises(ReportError, match="is no run folder"):
            reading.read_run(tmp_path)
        assert time.process_time() - began < 1
        gc.unfreeze()
        tracemalloc.start()
        with pytest.raises(ReportError, match="is no run folder"):
            reading.read_run(tmp_path)
        _, peak = tracemalloc.get_traced_memory()
        tracemalloc.stop()
        # One line of the metrics at a time, 1/4 MiB of it at most.
        assert peak < (12 if name == "metrics.jsonl" else 150) * 2**20
