"""Runs killed at random moments, many starts, and the time that a checkpoint takes."""

import dataclasses
import json
import os
import random
import time
from pathlib import Path
from typing import Any

import jax
import pytest

from mjx_balance import load_policy
from mjx_balance.config import preset
from mjx_balance.envs.balance import BalanceEnv
from mjx_balance.files.run_folder import RunFolder
from mjx_balance.training import checkpoints
from mjx_balance.training.sizing import make_learner, size_to_device

pytestmark = pytest.mark.slow

KILLS, STARTS = (int(os.environ.get(f"MJX_BALANCE_{name}", 3)) for name in ("KILLS", "STARTS"))
FLAGS = (
    "--preset smoke --engine mujoco --num-env-steps 3072 --eval-scenarios 4 --eval-duration 5 "
    "--log-every 512 --checkpoint-seconds 1 --eval-every 512 --export best"
).split()


@pytest.fixture(scope="module")
def cache(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return tmp_path_factory.mktemp("cache")


def seconds_from_folder_to_end(process: Any, folder: RunFolder) -> float:
    process.wait(folder.path.exists)
    began = time.monotonic()
    code, output = process.end()
    assert code == 0, output
    return time.monotonic() - began


def test_a_run_killed_at_any_moment_ends_as_an_undisturbed_one(
    cache: Path, tmp_path: Path, start_train: Any
) -> None:
    """In the same policy, the best of six that are validated, bit for bit."""
    seconds = 0.0
    for name in ("cold", "whole"):  # the second start takes the time of those that are killed
        whole = RunFolder(tmp_path / name)
        process = start_train(cache, *FLAGS, "--run-dir", str(whole.path))
        seconds = seconds_from_folder_to_end(process, whole)
    moments = random.Random(0)
    for k in range(KILLS):
        folder = RunFolder(tmp_path / f"run{k}")
        process = start_train(cache, *FLAGS, "--run-dir", str(folder.path))
        process.wait(folder.path.exists)
        time.sleep(moments.uniform(0, seconds))
        process.process.kill()
        process.end()
        if not folder.evaluation.is_file():
            code, output = start_train(cache, "--resume", str(folder.path)).end()
            assert code == 0, output
        assert load_policy(folder.policy).fingerprint == load_policy(whole.policy).fingerprint


@pytest.mark.parametrize("engine", ["mujoco", "mjx"])
def test_a_run_always_starts(engine: str, cache: Path, tmp_path: Path, start_train: Any) -> None:
    """1,024 envs on all cores reach their first gradient steps, again and again."""
    flags = f"--engine {engine} --num-envs 1024 --log-every 1024".split()
    for k in range(STARTS):
        folder = RunFolder(tmp_path / f"{k}")

        def learns(folder: RunFolder = folder) -> bool:
            lines = folder.metrics.read_text().splitlines(True) if folder.metrics.is_file() else []
            return any(json.loads(x)["gradient_steps"] for x in lines if x.endswith("\n"))

        process = start_train(cache, *flags, "--run-dir", str(folder.path))
        process.wait(learns)
        learnt = learns()
        process.process.kill()
        _, output = process.end()
        assert learnt, output


def test_a_checkpoint_takes_seconds(tmp_path: Path) -> None:
    """The whole state of the preset `default`, its replay included, saved and read back."""
    config = size_to_device(dataclasses.replace(preset("default"), engine="mujoco"))
    state = jax.block_until_ready(make_learner(config, BalanceEnv(config)).init(0))
    began = time.monotonic()
    checkpoints.save(tmp_path / "checkpoints", 1, state)
    saved = time.monotonic()
    restored = checkpoints.restore(tmp_path / "checkpoints", state, pytest.fail)
    jax.block_until_ready(restored)
    assert saved - began < 10
    assert time.monotonic() - saved < 10
