"""The benchmark scripts still fit the package: they are run by hand, so nothing else would say."""

import importlib.util
import json
import runpy
import sys
import types
from pathlib import Path
from typing import Any

import jax
import numpy as np
import probes
import pytest

from mjx_balance.config import DQNConfig
from mjx_balance.dqn.learner import Learner
from mjx_balance.dqn.networks import QNetwork
from mjx_balance.evaluation import Rollout
from mjx_balance.policy import load_policy

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
    after, _ = script["_random_program"](learner, 1)(start, jax.random.PRNGKey(0))
    assert np.asarray(after.obs).shape == seen.shape
    assert (np.asarray(after.obs) != seen).all()


@pytest.fixture
def results(monkeypatch: pytest.MonkeyPatch) -> types.ModuleType:
    """`benchmarks/results.py`; its simulation gives 0.1 deg everywhere and counts its calls."""
    monkeypatch.syspath_prepend(str(BENCHMARKS))
    spec = importlib.util.spec_from_file_location("results", BENCHMARKS / "results.py")
    assert spec is not None
    assert spec.loader is not None
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
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
