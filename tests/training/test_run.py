"""The whole of `train.py`, as a user runs it: a run, and one that is killed wherever it can be."""

import json
import os
import re
import signal
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from mjx_balance import load_policy
from mjx_balance.files.run_folder import RunFolder
from mjx_balance.training.checkpoints import saved_steps

FLAGS = (
    "--preset smoke --engine mujoco --num-env-steps 6144 --eval-scenarios 8 --eval-duration 10 "
    "--checkpoint-seconds 1"
).split()


@pytest.fixture(scope="module")
def cache(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A cache of its own, cold at first."""
    return tmp_path_factory.mktemp("cache")


def cores() -> int:
    return os.cpu_count() or 1


@pytest.fixture(scope="module")
def run(cache: Path, tmp_path_factory: pytest.TempPathFactory, start_train: Any) -> RunFolder:
    """A finished run; it fills the cache."""
    folder = RunFolder(tmp_path_factory.mktemp("runs") / "run")
    code, said = start_train(cache, *FLAGS, "--run-dir", str(folder.path)).end()
    assert code == 0, said
    assert "Failed to import" not in said
    used = re.search(r"preset smoke, seed 0, 64 envs on (\d+) (\w+) device", said)
    assert used is not None, said
    if used[2] == "cpu":  # as many cores as share 64 envs evenly
        assert int(used[1]) == max(n for n in (1, 2, 4, 8, 16, 32, 64) if n <= cores())
    return folder


def lines(folder: RunFolder) -> list[dict[str, float]]:
    if not folder.metrics.is_file():
        return []
    return [
        json.loads(line)
        for line in folder.metrics.read_text().splitlines(keepends=True)
        if line.endswith("\n")
    ]


def test_a_run_leaves_everything_behind(run: RunFolder) -> None:
    figures = {"learning_curves.png", "reward.png", "rollout.png"}
    assert {path.name for path in run.figures.iterdir()} == figures
    assert list(run.tensorboard.iterdir())
    assert (run.checkpoints / "6144").is_dir()
    results = json.loads(run.evaluation.read_text())
    assert set(results) == {"paper", "corner"}
    assert results["corner"]["scenarios"] == 8
    assert json.loads(run.config.read_text())["preset"] == "smoke"
    policy = load_policy(run.policy)
    assert policy.manifest["training"]["env_steps"] == 6144
    assert policy(np.zeros((3, policy.observation_size))).shape == (3,)


def test_metrics_are_logged_and_the_loss_falls(run: RunFolder) -> None:
    logged = lines(run)
    assert [x["env_steps"] for x in logged] == list(range(1024, 6145, 1024))
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
    """Fingerprints of the validated policies that are kept."""
    found = sorted(folder.validated.rglob("*.safetensors"))
    return {str(x.relative_to(folder.path)): load_policy(x).fingerprint for x in found}


def test_greedy_policies_are_validated_on_the_way(run: RunFolder) -> None:
    assert [steps for steps, *_ in held_out(run)] == [4096, 6144]
    kept = validated(run)
    assert list(kept) == [f"validated/{n}/seed-0.safetensors" for n in (4096, 6144)]
    assert kept["validated/6144/seed-0.safetensors"] == load_policy(run.policy).fingerprint


def files(folder: Path) -> set[str]:
    return {str(path.relative_to(folder)) for path in folder.rglob("*") if path.is_file()}


@pytest.mark.slow
def test_a_run_that_is_killed_again_and_again_equals_an_undisturbed_one(
    run: RunFolder, cache: Path, tmp_path: Path, start_train: Any
) -> None:
    """As soon as its folder exists, after a checkpoint, by Ctrl-C, and while it evaluates."""
    folder = RunFolder(tmp_path / "run")
    cached = files(cache)
    first = start_train(cache, *FLAGS, "--run-dir", str(folder.path))
    _, said = first.interrupt(signal.SIGKILL, folder.path.exists)
    assert not folder.checkpoints.exists(), said

    def resume() -> Any:
        return start_train(cache, "--resume", str(folder.path))

    code, said = resume().interrupt(
        signal.SIGKILL, lambda: list(folder.checkpoints.glob("[0-9]???"))
    )
    assert code == -signal.SIGKILL, said
    assert len(lines(folder)) < 6, "the kill came too late to show anything"

    saved = max(saved_steps(folder.checkpoints))
    before = len(list(folder.tensorboard.iterdir()))
    at_work = resume()
    # A TensorBoard file is opened when the loop begins.
    begun = lambda: len(list(folder.tensorboard.iterdir())) > before  # noqa: E731
    code, said = at_work.interrupt(signal.SIGINT, begun)
    assert code == 130, said
    assert f"continue with --resume {folder.path}" in said
    so_far = load_policy(folder.policy).manifest["training"]["env_steps"]
    assert saved <= so_far <= 6144
    assert f"resuming at {saved:,} decisions" in said

    code, said = resume().interrupt(signal.SIGKILL, (folder.checkpoints / "6144").is_dir)
    assert code == -signal.SIGKILL, said
    assert not folder.evaluation.exists()

    code, said = resume().end()
    assert code == 0, said
    assert "resuming at 6,144 decisions" in said
    assert load_policy(folder.policy).fingerprint == load_policy(run.policy).fingerprint
    assert [x["env_steps"] for x in lines(folder)] == list(range(1024, 6145, 1024))
    assert held_out(folder) == held_out(run)
    assert validated(folder) == validated(run)
    evaluations = [json.loads(x.evaluation.read_text()) for x in (run, folder)]
    for results in evaluations:
        for result in results.values():
            del result["physics_steps_per_second"]
    assert evaluations[0] == evaluations[1]
    # Five starts, and nothing was traced or compiled again.
    new = {name for name in files(cache) - cached if "jit_call" in name or "programs" in name}
    assert not new
    assert "cpu_aot_loader" not in said  # XLA's chatter about what it cached
