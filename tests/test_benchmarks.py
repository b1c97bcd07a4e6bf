"""The benchmark scripts still fit the package: they are run by hand, so nothing else would say."""

import importlib.util
import itertools
import json
import runpy
import subprocess
import sys
import types
from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import probes
import pytest
from flax import linen as nn

from mjx_balance.config import DQNConfig, TaskConfig
from mjx_balance.dqn.learner import Learner
from mjx_balance.dqn.networks import QNetwork
from mjx_balance.evaluation.rollout import Rollout
from mjx_balance.policy.file import load_policy

BENCHMARKS = Path(__file__).parent.parent / "benchmarks"
SCRIPTS = sorted(
    path for path in BENCHMARKS.glob("*.py") if "__main__" in path.read_text(encoding="utf-8")
)


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


def test_the_env_that_throughput_times_moves_on_every_device() -> None:
    config = DQNConfig(batch_size=32, replay_capacity=512, min_replay_size=16)
    learner = Learner(probes.TwoSteps(), QNetwork((16,), (2,)), config, 8, 80)
    assert learner.num_devices == 2
    script = runpy.run_path(str(BENCHMARKS / "throughput.py"))
    start = learner.init(0).env_state
    seen = np.asarray(start.obs)
    after, _ = script["env_program"](learner, 1)(start, jax.random.PRNGKey(0))
    assert np.asarray(after.obs).shape == seen.shape
    assert (np.asarray(after.obs) != seen).all()


def load(name: str, monkeypatch: pytest.MonkeyPatch) -> types.ModuleType:
    """A benchmark script as a module, not run."""
    monkeypatch.syspath_prepend(str(BENCHMARKS))
    spec = importlib.util.spec_from_file_location(name, BENCHMARKS / f"{name}.py")
    assert spec is not None
    assert spec.loader is not None
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    return module


def test_a_kick_is_overcome_when_the_twins_part_no_more(monkeypatch: pytest.MonkeyPatch) -> None:
    """Decisions of 50 steps of 4 ms, kicked at 2 and 5 of 8, in three scenarios, by hand."""
    calm = np.full((3, 400), 0.5)
    pushed = calm.copy()
    pushed[:, 40:60] = 5.0  # before the first kick
    pushed[0, 100:125] -= 0.3  # 25 steps
    pushed[0, 130] += 0.25  # the 31st
    pushed[0, 140] += 0.15  # as good as none
    pushed[1, 260:] += 1.0  # to the end
    expected = [(31, 0), (0, 150), (0, 0)]
    found = load("pushes", monkeypatch).settling(TaskConfig(), pushed, calm, np.asarray((2, 5)))
    np.testing.assert_allclose(found, 0.004 * np.asarray(expected))


@pytest.fixture
def results(monkeypatch: pytest.MonkeyPatch) -> types.ModuleType:
    """`benchmarks/results.py`; its simulation gives 0.1 deg everywhere and counts its calls."""
    module = load("results", monkeypatch)
    module.asked, module.tilt = [], 0.1

    def run_suite(scene, controller, suite, scenarios, *more):
        module.asked.append(scenarios)
        tilt = np.full((scenarios, 5), module.tilt)
        fell_at, action = np.full(scenarios, 5), np.zeros((scenarios, 1))
        return Rollout(scene.config.task, tilt, fell_at, action, None, 1.0)

    monkeypatch.setattr(module, "run_suite", run_suite)
    return module


def test_published_results_stand_while_the_code_gives_them(
    results: types.ModuleType, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    policy = load_policy(BENCHMARKS.parent / "policies" / "best.safetensors")

    def result(scenarios: int = 20) -> dict[str, Any]:
        results.asked.clear()
        return results.suite_result(
            tmp_path / "r.json", "me", policy, lambda: None, "paper", scenarios, (4, 8)
        )

    first = result()
    assert results.asked == [20]
    assert first["tilt_deg"]["mean"] == pytest.approx(0.1)
    assert set(first["mean_of_first"]) == {"4", "8"}
    assert result() == first
    assert results.asked == [], "the same code: read back"
    monkeypatch.setattr(results, "code_digest", lambda: "other")
    results.tilt += 1e-9  # another machine
    again = result()
    assert results.asked == [4], "other code: the first are tried"
    assert again == first | {"code": again["code"]}
    assert again["code"].startswith("other, scene ")
    result()
    assert results.asked == []
    monkeypatch.setattr(results, "code_digest", lambda: "wrong")
    results.tilt = 0.10001
    assert result()["tilt_deg"]["mean"] == pytest.approx(0.10001)
    assert results.asked == [4, 20], "it gives other figures: all are measured"
    result(4)
    monkeypatch.setattr(results, "code_digest", lambda: "last")
    result(4)
    assert results.asked == [4], "as few as are tried: measured at once"
    assert len(json.loads((tmp_path / "r.json").read_text())) == 2


@pytest.fixture
def sb3(monkeypatch: pytest.MonkeyPatch) -> types.ModuleType:
    """`benchmarks/sb3_dqn.py`, but for the training, which needs torch."""
    return load("sb3_dqn", monkeypatch)


def test_the_peers_network_becomes_a_policy(sb3: types.ModuleType, tmp_path: Path) -> None:
    rng = np.random.default_rng(0)
    sizes = (34, 256, 256, 441)
    layers = {}
    for k, (rows, columns) in enumerate(itertools.pairwise(sizes)):
        layers[f"q_net.{2 * k}.weight"] = rng.normal(size=(columns, rows)).astype(np.float32)
        layers[f"q_net.{2 * k}.bias"] = rng.normal(size=columns).astype(np.float32)
    sb3.to_policy(tmp_path / "p.safetensors", layers, sb3.peer_config(0), "scene", 700)
    policy = load_policy(tmp_path / "p.safetensors")
    obs = rng.normal(size=34).astype(np.float32)
    x = obs
    for k in range(3):
        x = layers[f"q_net.{2 * k}.weight"] @ x + layers[f"q_net.{2 * k}.bias"]
        x = x if k == 2 else x * (x > 0)
    np.testing.assert_allclose(policy.q_values(obs), x, rtol=1e-4, atol=1e-2)
    assert policy.manifest["training"]["env_steps"] == 700


@pytest.fixture
def timing(monkeypatch: pytest.MonkeyPatch) -> types.ModuleType:
    """`benchmarks/time_to_balance.py`; every look at its clock takes a second, judging 100."""
    module = load("time_to_balance", monkeypatch)
    module.now, module.verdicts = 0.0, {}

    def look() -> float:
        module.now += 1
        return module.now

    def judged(policy: Path, suite: str, display: Any) -> dict[str, Any]:
        module.now += 100
        mean, falls = module.verdicts.get(policy.stem, (0.1, 0))
        return {"mean": mean if suite == "paper" else 3.0, "falls": falls}

    clock = types.SimpleNamespace(perf_counter=look, sleep=lambda seconds: None)
    monkeypatch.setattr(module, "time", clock)
    monkeypatch.setattr(module, "judged", judged)
    return module


PRETENDED = """
import pathlib, sys
for k in range(10, 50, 10):
    pathlib.Path(sys.argv[1], f"{k}.safetensors").touch()
    print(k, flush=True)
    if not sys.stdin.readline():
        break
"""


def test_the_peer_is_timed_to_the_first_checkpoint_that_passes(
    timing: types.ModuleType, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    (tmp_path / "sb3_dqn.py").write_text(PRETENDED)
    monkeypatch.setattr(timing, "HERE", tmp_path)
    timing.verdicts = {"10": (0.1, 1), "20": (0.21, 0), "30": (0.2, 0)}
    row = timing.peer(40, 10, 0.2, tmp_path, timing.Display())
    assert row == {
        "contender": "sb3",
        "engine": "mujoco",
        "start": "cold",
        "seconds": 3.0,  # one for each stretch of training, none of the judging
        "decisions": 30,
        "paper": {"mean": 0.2, "falls": 0},
        "corner": {"mean": 3.0, "falls": 0},
    }
    assert not (tmp_path / "40.safetensors").exists()
    never = timing.peer(20, 10, 0.01, tmp_path, timing.Display())
    assert (never["seconds"], never["decisions"]) == (None, 20)
    with pytest.raises(timing.Failed, match="ended after 40 decisions"):
        timing.peer(100, 10, 0.01, tmp_path, timing.Display())


def test_our_clock_stops_when_the_policy_is_there(timing: types.ModuleType, tmp_path: Path) -> None:
    script = (
        (
            "import os, pathlib, time; p = pathlib.Path('part');"
            "p.write_text(os.environ['MJX_BALANCE_CACHE']); p.rename('file'); time.sleep(600)"
        )
        .replace("'part'", repr(str(tmp_path / "part")))
        .replace("'file'", repr(str(tmp_path / "file")))
    )
    assert timing.time_to_file([sys.executable, "-c", script], tmp_path / "file", tmp_path) == 1
    assert (tmp_path / "file").read_text() == str(tmp_path)
    with pytest.raises(timing.Failed, match="exit code 3"):
        timing.time_to_file([sys.executable, "-c", "exit(3)"], tmp_path / "none", tmp_path)


def test_a_warm_start_is_the_same_again(
    timing: types.ModuleType, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    shipped = BENCHMARKS.parent / "policies" / "best.safetensors"
    asked = []

    def time_to_file(command: list[str], file: Path, cache: Path) -> float:
        asked.append((" ".join(command[1:-1]), cache, cache.exists()))
        cache.mkdir(exist_ok=True)
        file.parent.mkdir()
        file.write_bytes(shipped.read_bytes())
        return 30.0 - 10 * len(asked)

    monkeypatch.setattr(timing, "time_to_file", time_to_file)
    rows = [
        row
        for engine in ("mjx", "mujoco")
        for row in timing.ours(engine, 640, tmp_path, timing.Display())
    ]
    assert [(row["engine"], row["start"]) for row in rows] == [
        *(("mjx", "cold"), ("mjx", "warm")),
        *(("mujoco", "cold"), ("mujoco", "warm")),
    ]
    assert [existed for _, _, existed in asked] == [False, True, False, True]
    assert asked[0] == (*asked[1][:2], False)
    assert "train.py --preset quick --engine mjx --num-env-steps 640 --run-dir" in asked[0][0]
    trained = load_policy(shipped).manifest["training"]["env_steps"]
    assert rows[0] == {
        "contender": "mjx",
        "engine": "mjx",
        "start": "cold",
        "seconds": 20.0,
        "decisions": trained,
        "paper": {"mean": 0.1, "falls": 0},
        "corner": {"mean": 3.0, "falls": 0},
    }


def test_the_ratio_is_the_peers_time_over_ours(timing: types.ModuleType) -> None:
    tilts = {"paper": {"mean": 0.1, "falls": 0}, "corner": {"mean": 0.25, "falls": 7}}
    mine = {"contender": "mujoco", "start": "warm", "seconds": 24.0, "decisions": 20224} | tilts
    other = {"contender": "sb3", "start": "cold", "seconds": 300.0, "decisions": 75000} | tilts
    machine = {"cpu": "a CPU", "cores": 2}

    def last(*rows: dict[str, Any]) -> list[str]:
        lines = timing.lines_of(list(rows), 0.2, machine)
        return [line.split(" | ")[-1] for line in lines if line.startswith("| `m")]

    line = timing.lines_of([mine, other], 0.2, machine)[2]
    assert line == "| `mujoco` | warm | 24.0 | 20,224 | 0.100 (0) | 0.250 (7) | 12.5 |"
    assert last(mine) == last(mine, other | {"seconds": None}) == ["- |"]


def test_without_the_peer_nothing_is_started(
    timing: types.ModuleType,
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
) -> None:
    kept = tmp_path / "old.json"
    kept.write_text("[]")
    monkeypatch.setattr(timing.importlib.util, "find_spec", lambda name: None)
    for flags in ([], ["--contenders", "sb3"]):
        monkeypatch.setattr(sys, "argv", ["time_to_balance.py", "--json", str(kept), *flags])
        assert timing.main() == 2
        said = capsys.readouterr().err
        assert said.count("\n") == 1
        assert "--contenders mujoco mjx" in said
    assert kept.read_text() == "[]"


def test_what_is_measured_is_kept_when_a_contender_fails(
    timing: types.ModuleType,
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
) -> None:
    row = {"contender": "mujoco", "start": "cold", "seconds": 24.0, "decisions": 20224}
    row |= {"paper": {"mean": 0.1, "falls": 0}, "corner": {"mean": 0.2, "falls": 0}}

    ends: list[BaseException] = [KeyboardInterrupt(), timing.Failed("mjx gave up")]

    def ours(engine: str, *more: Any):
        if engine == "mjx":
            raise ends.pop()
        yield row

    file, page = tmp_path / "t.json", tmp_path / "page.md"
    monkeypatch.setattr(timing, "ours", ours)
    flags = f"--contenders mujoco mjx --json {file} --write {page}".split()
    monkeypatch.setattr(sys, "argv", ["time_to_balance.py", *flags])
    for code in (2, 130):
        file.unlink(missing_ok=True)
        assert timing.main() == code
        assert json.loads(file.read_text())["rows"] == [row]
        assert "| 24.0 |" in capsys.readouterr().out
    assert not page.exists()


def counting(work: int) -> Any:
    """A pretended buffer for `benchmarks/replay.py`: (adds, samples), and some work."""
    one = jnp.zeros(1)

    def sample(state: jax.Array, key: jax.Array) -> tuple[jax.Array, Any]:
        spent = jax.lax.fori_loop(0, work, lambda k, x: jnp.sin(x + k), 0.1 * state.sum())
        return state + jnp.asarray((0, 1)) + (0 * spent).astype(int), one

    return types.SimpleNamespace(
        init=lambda: jnp.zeros(2, int),
        add=lambda state, batch: state + jnp.asarray((1, 0)),
        sample=sample,
    )


def test_replay_compares_as_many_adds_and_samples(monkeypatch: pytest.MonkeyPatch) -> None:
    module = load("replay", monkeypatch)
    run = module.program(counting(1), lambda number: None, 8, 3)
    state, _ = run(jnp.zeros(2, int), jax.random.PRNGKey(0))
    assert state.tolist() == [8, 24]
    fast, slow = counting(1), counting(100_000)
    monkeypatch.setattr(module, "buffers", lambda *size: {"ours": fast, "a": slow, "b": fast})
    assert {row["best_other"] for row in module.measure(1, 256, 1, 3)} == {"b"}
    monkeypatch.setattr(module, "buffers", lambda *size: {"ours": slow, "a": fast})
    rows = module.measure(1, 256, 1, 3)
    assert [row["buffer"] for row in rows] == ["filling", "full"]
    assert all(row["ours_over_best_other"] < 0.5 for row in rows)


def test_a_validation_passes_without_a_fall_in_both_suites(
    monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> None:
    """A line that is half written, or of no validation, says nothing."""
    passes = load("accelerator", monkeypatch).passes
    file = tmp_path / "metrics.jsonl"
    assert not passes(file, 0.2)
    names = [
        f"eval/{suite}/{what}" for what in ("tilt_mean", "falls") for suite in ("paper", "corner")
    ]
    lines = [json.dumps({"env_steps": 1})]
    for tilts, good in (((0.1, 0.3), False), ((0.1, 0.1, 0, 1), False), ((0.19, 0.2, 0, 0), True)):
        lines.append(json.dumps(dict(zip(names, (*tilts, 0, 0)[:4], strict=True))))
        file.write_text("\n".join(lines))
        assert not passes(file, 0.2)
        file.write_text("\n".join(lines) + "\n")
        assert passes(file, 0.2) == good
    assert not passes(file, 0.19)


def test_a_part_that_fails_or_takes_too_long_is_said(monkeypatch: pytest.MonkeyPatch) -> None:
    module = load("accelerator", monkeypatch)
    parts = module.Parts(1_000)
    assert parts.lines("rates", "steam", "--sizes", "8") == []
    [failure] = parts.failures
    assert failure.startswith("rates, steam: ")
    assert "engine is 'steam'; it must be one of mjx, mujoco, warp" in failure
    assert module.Parts(9).lines("rates", "mjx", "--sizes", "8") == []
    slow = module.Parts(1_000)
    monkeypatch.setitem(module.SHARES, "rates", 0.0101)
    assert slow.lines("rates", "mjx", "--sizes", "64") == []
    assert slow.failures == ["rates, mjx: stopped after 10 s"]


def test_what_a_machine_gave_is_written_down_with_what_failed(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    row = {"engine": "mjx", "device": "1 x H", "num_envs": 2048, "physics_steps_per_second": 5e6}
    row |= {"compile_s": 40.2, "device_memory_mib": None}
    tilt = {"mean": 0.07, "p95": 0.2, "max": 1.1, "falls": 0, "of": 128}
    found = {
        "hardware": {"cpu": "a", "cores": 16, "gpu": ["NVIDIA H100, 81559 MiB"]},
        "versions": {"jax": "0.11", "warp-lang": None},
        "rates": [row],
        "training": [row | {"share_of_rate": 0.876}],
        "runs": [
            {
                "start": "warm",
                "engine": "mjx",
                "reached_s": {0.2: 9.04},
                "evaluation": {"paper": tilt},
            }
        ],
        "failures": ["warp: warp-lang is not installed"],
        "seconds": 300.4,
    }
    text = "\n".join(load("accelerator", monkeypatch).shown(found))
    assert "a, 16 cores, NVIDIA H100, 81559 MiB; jax 0.11." in text
    assert "| `mjx` | 1 x H | 2,048 | 5,000,000 | - | 40 s | - |" in text
    assert "| 0.88 | 40 s |" in text
    assert (
        "`train.py --engine mjx`, warm: 0.2 deg after 9.0 s, 0.1 deg never; `paper` 0.070" in text
    )
    assert "- warp: warp-lang is not installed" in text
    assert text.endswith("300 s in all.")


def test_why_a_part_of_a_benchmark_ended(monkeypatch: pytest.MonkeyPatch) -> None:
    why = load("accelerator", monkeypatch).why
    crash = "import sys, os; print('warning', file=sys.stderr); os.kill(os.getpid(), 11)"
    ended = subprocess.run([sys.executable, "-c", crash], capture_output=True, text=True)
    assert why(ended.returncode, ended.stderr) == "ended by SIGSEGV"
    assert why(1, "Traceback\nMemoryError: 8 GiB\n\n") == "MemoryError: 8 GiB"
    assert why(3, "") == "exit code 3"


def test_the_efficiency_that_exchanges_alone_would_leave(monkeypatch: pytest.MonkeyPatch) -> None:
    """1,000 decisions of each of two take 1 s of work; 2,000 in all come with 2,000 u exchanges."""
    predicted = load("scaling", monkeypatch).predicted
    one = {"decisions_per_second": 1_000.0}
    for kind, updates, seconds in (("weak", 1 / 16, 1.25), ("strong", 1 / 8, 1.5)):
        row = {"updates_per_decision": updates, "exchange_s": 2e-3}
        assert predicted(row, one, kind) == pytest.approx(1 / seconds)


def test_hosts_at_which_exchanges_take_half_of_the_time(monkeypatch: pytest.MonkeyPatch) -> None:
    """An update per 56 ms; 100,000 bits take 100 us of 1 Gbit/s beside 900 of the message."""
    module = load("scaling", monkeypatch)
    monkeypatch.setattr(module, "MESSAGE_S", {1: 900e-6})
    monkeypatch.setattr(module, "NETWORKS_GBIT", (1,))
    one = {"decisions_per_second": 100 / 5.6, "updates_per_decision": 1.0, "gradient_bytes": 12_500}
    *_, row = module.arithmetic(one)
    # 57 hosts: 56 messages of 1 ms. 8 that update 8 times as often: 7 messages in 7 ms.
    assert row == "| 1 Gbit/s | 1,000 us | 7,000 us | 63,000 us | 57 | 8 |"


@pytest.mark.parametrize(("name", "bits"), [("TF32", 10), ("bfloat16", 7)])
def test_products_are_rounded_forward_and_backward(
    name: str, bits: int, monkeypatch: pytest.MonkeyPatch
) -> None:
    """A factor of 1 + 2^-bits survives, half a bit more is lost; sums are not rounded."""
    module = load("precision", monkeypatch)
    assert module.MANTISSA[name] == bits
    kept, lost = 1 + 2.0**-bits, 1 + 2.0**-bits * 1.25
    layer = nn.Dense(1, use_bias=False)
    x = jnp.asarray([lost, 2.0**-12])

    def value(kernel: jax.Array, x: jax.Array) -> jax.Array:
        return jnp.asarray(layer.apply({"params": {"kernel": kernel}}, x))[0] * lost

    kernel = jnp.asarray([[1.0], [1.0]])
    with module.with_products_of(bits):
        by_kernel, by_x = jax.grad(value, (0, 1))(kernel, x)
        whole = value(kernel, x)
    assert float(whole) == np.float32(np.float32(kept + 2.0**-12) * np.float32(lost))
    np.testing.assert_array_equal(by_kernel[:, 0], (kept * kept, 2.0**-12 * kept))
    np.testing.assert_array_equal(by_x, (kept, kept))
    assert float(value(kernel, x)) != float(whole)


def test_compiling_is_no_part_of_the_time_that_brax_trains(monkeypatch: pytest.MonkeyPatch) -> None:
    """Stretches of 22 and 12 s where the others take 2, but for one that was disturbed."""
    module = load("brax_agents", monkeypatch)
    compiling, found = module.marks([(10, 22.0), (20, 34.0), (30, 41.0), (40, 43.0), (50, 45.0)])
    assert compiling == pytest.approx(30)
    assert [mark.seconds for mark in found] == pytest.approx([2, 4, 11, 13, 15])
    assert [module.reached(found, t).decisions for t in (1, 2, 5, 12, 99)] == [10, 10, 30, 40, 50]
