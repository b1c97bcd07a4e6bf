"""The benchmark scripts still fit the package: they are run by hand, so nothing else would say."""

import runpy
import sys
from pathlib import Path

import jax
import numpy as np
import probes
import pytest

from mjx_balance.config import DQNConfig
from mjx_balance.dqn.learner import Learner
from mjx_balance.dqn.networks import QNetwork

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
