"""The whole of `train.py`, as a user runs it: a run, and one that is killed wherever it can be."""

import json
import os
import random
import re
import signal
import time
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from mjx_balance import load_policy
from mjx_balance.files.run_folder import RunFolder
from mjx_balance.training.checkpoints import saved_steps

KILLS, STARTS = (int(os.environ.get(f"MJX_BALANCE_{name}", 3)) for name in ("KILLS", "STARTS"))
FLAGS = (
    "--preset smoke --engine mujoco --num-env-steps 4096 --eval-every 3072 --eval-scenarios 2 "
    "--eval-duration 5 --checkpoint-seconds 1"
).split()


@pytest.fixture(scope="module")
def run(tmp_path_factory: pytest.TempPathFactory, start_train: Any) -> RunFolder:
    """A finished run; it fills the cache."""
    folder = RunFolder(tmp_path_factory.mktemp("runs") / "run")
    output = start_train(*FLAGS, "--run-dir", folder.path).end(0)
    assert "Failed to import" not in output
    used = re.search(r"preset smoke, seed 0, 64 envs on (\d+) (\w+) device", output)
    assert used is not None, output
    if used[2] == "cpu":  # as many cores as share 64 envs evenly
        assert int(used[1]) == max(2**n for n in range(7) if 2**n <= (os.cpu_count() or 1))
    return folder


def lines(folder: RunFolder) -> list[dict[str, float]]:
    text = folder.metrics.read_text() if folder.metrics.is_file() else ""
    return [json.loads(line) for line in text.splitlines(keepends=True) if line.endswith("\n")]


def test_a_run_leaves_everything_behind(run: RunFolder) -> None:
    figures = {"learning_curves.png", "reward.png", "rollout.png"}
    assert {path.name for path in run.figures.iterdir()} == figures
    assert list(run.tensorboard.iterdir())
    assert (run.checkpoints / "4096").is_dir()
    results = json.loads(run.evaluation.read_text())
    assert set(results) == {"paper", "corner"}
    assert results["corner"]["scenarios"] == 2
    assert json.loads(run.config.read_text())["preset"] == "smoke"
    policy = load_policy(run.policy)
    assert policy.manifest["training"]["env_steps"] == 4096
    assert policy(np.zeros((3, policy.observation_size))).shape == (3,)


def test_metrics_are_logged_and_the_loss_falls(run: RunFolder) -> None:
    logged = lines(run)
    assert [x["env_steps"] for x in logged] == list(range(1024, 4097, 1024))
    for line in logged:
        for name in "tilt_deg falls_per_minute reward loss epsilon".split():
            assert f"train/{name}" in line
        assert line["perf/physics_steps_per_second"] == pytest.approx(
            50 * line["perf/env_steps_per_second"]
        )
    assert logged[-1]["train/loss"] < logged[0]["train/loss"]
    assert logged[-1]["train/epsilon"] < logged[0]["train/epsilon"]


def held_out(folder: RunFolder) -> list[tuple[float, ...]]:
    """Decisions and results of every validation that is logged."""
    names = [f"eval/{s}/{n}" for s in ("paper", "corner") for n in ("falls", "tilt_mean")]
    return [(x["env_steps"], *(x[n] for n in names)) for x in lines(folder) if names[0] in x]


def validated(folder: RunFolder) -> dict[str, str]:
    """Fingerprints of the validated policies."""
    found = sorted(folder.validated.rglob("*.safetensors"))
    return {str(x.relative_to(folder.path)): load_policy(x).fingerprint for x in found}


def test_greedy_policies_are_validated_on_the_way(run: RunFolder) -> None:
    assert [steps for steps, *_ in held_out(run)] == [3072, 4096]
    policies = validated(run)
    assert list(policies) == [f"validated/{n}/seed-0.safetensors" for n in (3072, 4096)]
    last = policies["validated/4096/seed-0.safetensors"]
    assert last == load_policy(run.policy).fingerprint


def files(folder: Path) -> set[str]:
    return {str(path.relative_to(folder)) for path in folder.rglob("*") if path.is_file()}


@pytest.mark.slow
def test_a_run_that_is_killed_again_and_again_equals_an_undisturbed_one(
    run: RunFolder, cache: Path, folder: RunFolder, start_train: Any
) -> None:
    """As soon as its folder exists, after a checkpoint, by Ctrl-C, and while it evaluates."""
    cached = files(cache)
    folder = RunFolder(folder.path / "run")
    first = start_train(*FLAGS, "--run-dir", folder.path)
    output = first.interrupt(signal.SIGKILL, folder.path.exists)
    assert not folder.checkpoints.exists(), output

    def resume() -> Any:
        return start_train("--resume", folder.path)

    resume().interrupt(signal.SIGKILL, lambda: list(folder.checkpoints.glob("[0-9]???")))
    assert len(lines(folder)) < 4, "the kill came too late to show anything"

    saved = max(saved_steps(folder.checkpoints))
    before = len(list(folder.tensorboard.iterdir()))
    at_work = resume()
    # A TensorBoard file is opened when the loop begins.
    begun = lambda: len(list(folder.tensorboard.iterdir())) > before  # noqa: E731
    output = at_work.interrupt(signal.SIGINT, begun, code=130)
    assert f"continue with --resume {folder.path}" in output
    so_far = load_policy(folder.policy).manifest["training"]["env_steps"]
    assert saved <= so_far <= 4096
    assert f"resuming at {saved:,} decisions" in output

    resume().interrupt(signal.SIGKILL, (folder.checkpoints / "4096").is_dir)
    assert not folder.evaluation.exists()

    output = resume().end(0)
    assert "resuming at 4,096 decisions" in output
    assert load_policy(folder.policy).fingerprint == load_policy(run.policy).fingerprint
    assert [x["env_steps"] for x in lines(folder)] == list(range(1024, 4097, 1024))
    assert held_out(folder) == held_out(run)
    assert validated(folder) == validated(run)
    evaluations = [json.loads(x.evaluation.read_text()) for x in (run, folder)]
    for results in evaluations:
        for result in results.values():
            del result["physics_steps_per_second"]
    assert evaluations[0] == evaluations[1]
    # Five starts, and nothing was traced or compiled again.
    new = {name for name in files(cache) - cached if "jit_call" in name or "traced" in name}
    assert not new
    assert "cpu_aot_loader" not in output  # XLA's chatter about what it cached


@pytest.mark.slow
def test_a_run_killed_at_any_moment_ends_as_an_undisturbed_one(
    run: RunFolder, tmp_path: Path, start_train: Any
) -> None:
    seconds = run.evaluation.stat().st_mtime - run.config.stat().st_mtime
    moments = random.Random(0)
    for k in range(KILLS):
        folder = RunFolder(tmp_path / f"run{k}")
        process = start_train(*FLAGS, "--run-dir", folder.path)
        process.wait(folder.path.exists)
        time.sleep(moments.uniform(0, seconds))
        process.process.kill()
        process.end()
        if not folder.evaluation.is_file():
            start_train("--resume", folder.path).end(0)
        assert validated(folder) == validated(run)
        assert load_policy(folder.policy).fingerprint == load_policy(run.policy).fingerprint


@pytest.mark.slow
@pytest.mark.skipif(not hasattr(os, "sched_setaffinity"), reason="cores cannot be taken away")
def test_a_run_goes_on_where_there_are_fewer_cores(
    run: RunFolder, folder: RunFolder, start_train: Any
) -> None:
    """To the same bits: as many devices as before share the only core."""
    folder = RunFolder(folder.path / "run")
    first = start_train(*FLAGS, "--run-dir", folder.path)
    first.interrupt(signal.SIGHUP, lambda: len(lines(folder)) > 1, code=130)
    before = os.sched_getaffinity(0)
    os.sched_setaffinity(0, {min(before)})
    try:
        output = start_train("--resume", folder.path).end(0)
    finally:
        os.sched_setaffinity(0, before)
    assert "resuming at" in output
    assert load_policy(folder.policy).fingerprint == load_policy(run.policy).fingerprint
    assert held_out(folder) == held_out(run)


@pytest.mark.slow
@pytest.mark.parametrize("engine", ["mujoco", "mjx"])
def test_a_run_always_starts(engine: str, tmp_path: Path, start_train: Any) -> None:
    """1,024 envs on all cores reach their first gradient steps, again and again."""
    flags = f"--engine {engine} --num-envs 1024 --log-every 1024".split()
    for k in range(STARTS):
        folder = RunFolder(tmp_path / f"{k}")
        learns = lambda folder=folder: any(x["gradient_steps"] for x in lines(folder))  # noqa: E731
        process = start_train(*flags, "--run-dir", folder.path)
        process.wait(learns)
        learnt = learns()
        process.process.kill()
        output = process.end()
        assert learnt, output
