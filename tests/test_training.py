"""The whole of `train.py`, as a user runs it: a run, an interrupted run, a resumed one."""

import json
import os
import re
import signal
import subprocess
import sys
import time
from pathlib import Path

import numpy as np
import pytest

from mjx_balance import load_policy

REPO = Path(__file__).parent.parent
FLAGS = (
    "--preset smoke --num-env-steps 6144 --eval-scenarios 8 --eval-duration 10 "
    "--checkpoint-every 2048"
).split()


@pytest.fixture(scope="module")
def cache(tmp_path_factory: pytest.TempPathFactory) -> dict[str, str]:
    """An environment with a compilation cache of its own."""
    return os.environ | {"MJX_BALANCE_CACHE": str(tmp_path_factory.mktemp("cache"))}


def start(cache: dict[str, str], *flags: str) -> subprocess.Popen[str]:
    return subprocess.Popen(
        [sys.executable, str(REPO / "train.py"), *flags],
        env=cache,
        stdout=subprocess.PIPE,
        stderr=subprocess.PIPE,
        text=True,
    )


@pytest.fixture(scope="module")
def run(cache: dict[str, str], tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A finished run."""
    folder = tmp_path_factory.mktemp("runs") / "run"
    process = start(cache, *FLAGS, "--run-dir", str(folder))
    out, err = process.communicate()
    assert process.returncode == 0, out + err
    (folder.parent / "said.txt").write_text(out + err)
    assert "Failed to import" not in out + err
    return folder


def test_a_run_leaves_everything_behind(run: Path) -> None:
    figures = {"learning_curves.png", "reward.png", "rollout.png"}
    assert {p.name for p in (run / "figures").iterdir()} == figures
    assert list((run / "tensorboard").iterdir())
    assert list((run / "checkpoints").iterdir())
    results = json.loads((run / "evaluation.json").read_text())
    assert set(results) == {"paper", "corner"}
    assert results["corner"]["scenarios"] == 8
    config = json.loads((run / "config.json").read_text())
    assert config["preset"] == "smoke"
    policy = load_policy(run / "policy.safetensors")
    assert policy.manifest["training"]["env_steps"] == 6144
    assert policy(np.zeros((3, policy.observation_size))).shape == (3,)


def test_metrics_are_logged_and_the_loss_falls(run: Path) -> None:
    lines = [json.loads(x) for x in (run / "metrics.jsonl").read_text().splitlines()]
    assert [x["env_steps"] for x in lines] == list(range(1024, 6145, 1024))
    names = "tilt_deg falls_per_minute reward loss epsilon".split()
    for line in lines:
        assert {f"train/{n}" for n in names} <= set(line)
        assert line["perf/physics_steps_per_second"] == pytest.approx(
            50 * line["perf/env_steps_per_second"]
        )
    assert lines[-1]["train/loss"] < lines[0]["train/loss"]
    assert lines[-1]["train/epsilon"] < lines[0]["train/epsilon"]


def interrupt_after_first_metrics(process: subprocess.Popen[str], folder: Path) -> None:
    """Presses Ctrl-C as soon as the run has logged something."""
    metrics = folder / "metrics.jsonl"
    while not (metrics.is_file() and metrics.read_text()) and process.poll() is None:
        time.sleep(0.05)
    process.send_signal(signal.SIGINT)
    out, err = process.communicate()
    assert process.returncode == 130, out + err
    assert "--resume" in out


def test_an_interrupted_and_resumed_run_equals_an_uninterrupted_one(
    run: Path, cache: dict[str, str], tmp_path: Path
) -> None:
    folder = tmp_path / "run"
    metrics = folder / "metrics.jsonl"
    interrupt_after_first_metrics(start(cache, *FLAGS, "--run-dir", str(folder)), folder)
    assert load_policy(folder / "policy.safetensors").manifest["training"]["env_steps"] < 6144

    process = start(cache, "--resume", str(folder))
    out, err = process.communicate()
    assert process.returncode == 0, out + err
    whole, resumed = (load_policy(p / "policy.safetensors") for p in (run, folder))
    obs = np.random.default_rng(0).normal(size=(50, whole.observation_size))
    np.testing.assert_array_equal(whole.q_values(obs), resumed.q_values(obs))
    steps = [json.loads(x)["env_steps"] for x in metrics.read_text().splitlines()]
    assert steps == list(range(1024, 6145, 1024))


SEVERAL = (
    "--preset smoke --num-env-steps 4096 --eval-scenarios 4 --eval-duration 5 "
    "--num-seeds 2 --seed 3"
).split()


@pytest.fixture(scope="module")
def several(cache: dict[str, str], tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A finished run of two seeds."""
    folder = tmp_path_factory.mktemp("several") / "run"
    process = start(cache, *SEVERAL, "--run-dir", str(folder))
    out, err = process.communicate()
    assert process.returncode == 0, out + err
    return folder


def test_several_seeds_leave_a_policy_each_and_the_best_one(several: Path) -> None:
    folder = several
    seeds = json.loads((folder / "seeds.json").read_text())
    assert [row["seed"] for row in seeds["seeds"]] == [3, 4]
    names = {f"seed-{row['seed']}.safetensors" for row in seeds["seeds"]}
    assert {p.name for p in (folder / "seeds").iterdir()} == names
    each = [load_policy(folder / "seeds" / name) for name in sorted(names)]
    obs = np.random.default_rng(0).normal(size=(5, each[0].observation_size))
    assert not np.array_equal(each[0].q_values(obs), each[1].q_values(obs))

    def score(row) -> tuple[int, float]:
        suites = row["validation"].values()
        return sum(r["falls"] for r in suites), sum(r["tilt_deg"]["mean"] for r in suites)

    best = min(seeds["seeds"], key=score)
    assert seeds["best"] == best["seed"]
    chosen = load_policy(folder / "policy.safetensors")
    assert chosen.fingerprint == each[best["seed"] - 3].fingerprint
    assert chosen.config.seed == best["seed"]
    results = json.loads((folder / "evaluation.json").read_text())
    assert results == best["evaluation"]
    assert results["paper"]["seed"] != best["validation"]["paper"]["seed"]
    assert seeds["statistics"]["corner"]["seeds"] == 2
    line = json.loads((folder / "metrics.jsonl").read_text().splitlines()[-1])
    assert len(line["seeds"]["tilt_deg"]) == 2
    assert line["train/tilt_deg"] == pytest.approx(np.mean(line["seeds"]["tilt_deg"]))


def test_several_seeds_can_be_interrupted_and_resumed(
    several: Path, cache: dict[str, str], tmp_path: Path
) -> None:
    folder = tmp_path / "run"
    interrupt_after_first_metrics(start(cache, *SEVERAL, "--run-dir", str(folder)), folder)
    process = start(cache, "--resume", str(folder))
    out, err = process.communicate()
    assert process.returncode == 0, out + err
    for name in ("seed-3.safetensors", "seed-4.safetensors"):
        whole, resumed = (load_policy(p / "seeds" / name) for p in (several, folder))
        assert whole.fingerprint == resumed.fingerprint


def seconds_compiling(said: str) -> float:
    return float(re.findall(r"compiling .*: ([0-9.]+) s", said)[0])


def test_a_second_start_compiles_nothing(run: Path, cache: dict[str, str], tmp_path: Path) -> None:
    """Tracing and compiling MJX takes a minute; from the cache, seconds."""
    process = start(cache, *FLAGS, "--run-dir", str(tmp_path / "run"))
    metrics = tmp_path / "run" / "metrics.jsonl"
    while not (metrics.is_file() and metrics.read_text()) and process.poll() is None:
        time.sleep(0.05)
    process.send_signal(signal.SIGKILL)
    said = "".join(process.communicate())
    first = (run.parent / "said.txt").read_text()
    assert seconds_compiling(said) < 0.5 * seconds_compiling(first)


def test_a_half_written_line_does_not_stop_a_resumed_run(tmp_path: Path) -> None:
    from mjx_balance.training.loop import drop_metrics_after

    log = tmp_path / "metrics.jsonl"
    log.write_text('{"env_steps": 1024}\n{"env_steps": 2048}\n{"env_steps": 3072}\n{"env_st')
    drop_metrics_after(log, 2048)
    assert log.read_text() == '{"env_steps": 1024}\n{"env_steps": 2048}\n'
