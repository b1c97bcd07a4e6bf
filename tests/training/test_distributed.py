"""Whole runs of two processes on one machine, over gloo, as on two machines of a cluster."""

import json
import os
import re
import signal
import socket
import sys
import time
import unittest.mock
from collections.abc import Iterator
from concurrent.futures import ProcessPoolExecutor
from multiprocessing import get_context
from pathlib import Path
from typing import Any, Protocol

import jax
import jax.numpy as jnp
import pytest
from mujoco import mjx

from mjx_balance import BalanceEnv, load_policy
from mjx_balance.files.run_folder import RunFolder
from mjx_balance.training.checkpoints import saved_steps

pytestmark = pytest.mark.slow

FLAGS = (
    "--preset smoke --engine mujoco --num-devices 2 --num-env-steps 4096 --eval-every 0 "
    "--eval-scenarios 4 --eval-duration 5 --checkpoint-seconds 0.5"
).split()


class StartTwo(Protocol):
    """Starts two processes of a run."""

    def __call__(self, *flags: object, seeds: tuple[int, int] = (0, 0)) -> list[Any]: ...


@pytest.fixture(scope="module", autouse=True)
def new_code_generator() -> Iterator[None]:
    """XLA's older one, which the suite uses, adds in another order for 32 boards than for 64."""
    with unittest.mock.patch.dict(os.environ, XLA_FLAGS="--xla_backend_optimization_level=0"):
        yield


@pytest.fixture
def start_two(start_train: Any) -> StartTwo:
    def begin(*flags: object, seeds: tuple[int, int] = (0, 0)) -> list[Any]:
        with socket.create_server(("", 0)) as server:
            address = f"localhost:{server.getsockname()[1]}"
        place = ["--coordinator", address, "--num-processes", "2", "--process-id"]
        return [start_train(*flags, *place, k, "--seed", seed) for k, seed in enumerate(seeds)]

    return begin


@pytest.fixture(scope="module")
def alone(tmp_path_factory: pytest.TempPathFactory, start_train: Any) -> RunFolder:
    """The run as one process with two devices makes it, profiled."""
    folder = RunFolder(tmp_path_factory.mktemp("runs") / "alone")
    output = start_train(*FLAGS, "--profile", "--run-dir", folder.path).end(0)
    shares = json.loads((folder.profile / "shares.json").read_text())
    assert sum(shares.values()) == pytest.approx(1)
    assert shares["physics"] > 0.3
    assert re.search(r"\n  physics +\d+\.\d%  the engine's steps", output), output
    return folder


def fingerprint(folder: RunFolder) -> str:
    return load_policy(folder.policy).fingerprint


def test_two_processes_make_the_run_of_one_with_two_devices(
    alone: RunFolder, start_two: StartTwo, tmp_path: Path
) -> None:
    """To the bit: each steps its 32 boards, and the sums of two gradients are the same."""
    folder = RunFolder(tmp_path / "run")
    output, silence = (x.end(0) for x in start_two(*FLAGS, "--run-dir", folder.path))
    assert "64 envs on 2 cpu device" in output
    assert silence == "", "one of them speaks"
    assert fingerprint(folder) == fingerprint(alone)
    assert len(folder.metrics.read_text().splitlines()) == 4
    names = {path.name for path in alone.path.iterdir()} - {"profile"}
    assert {path.name for path in folder.path.iterdir()} == names


def test_neither_a_proxy_nor_ipv6_is_in_the_way(
    start_train: Any, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """A proxy at which nobody listens, for all that speak HTTP, as JAX's own service does."""
    for name in ("http_proxy", "https_proxy", "HTTPS_PROXY", "grpc_proxy"):
        monkeypatch.setenv(name, "http://127.0.0.1:9")
    with socket.create_server(("::1", 0), family=socket.AF_INET6) as server:
        place = ["--coordinator", f"[::1]:{server.getsockname()[1]}", "--num-processes", 2]
    flags = [*FLAGS, "--run-dir", tmp_path / "run", *place, "--process-id"]
    for process in [start_train(*flags, k) for k in range(2)]:
        process.end(0)


def test_a_tracker_that_does_not_start_ends_both_at_once(
    start_two: StartTwo, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Only the first process asks it."""
    (tmp_path / "wandb.py").write_text("def init(**given): raise RuntimeError('no login')")
    monkeypatch.setenv("PYTHONPATH", str(tmp_path), prepend=os.pathsep)
    both = start_two(*FLAGS, "--run-dir", tmp_path / "run", "--track", "wandb")
    both[0].wait(lambda: False)
    ended = time.monotonic()
    output = [process.end(2) for process in both]
    assert time.monotonic() - ended < 60, "JAX would wait for 300 s"
    assert "track is wandb, which does not start: no login" in output[0]
    assert "Traceback" not in "".join(output)


def test_a_killed_and_a_stopped_process_lose_nothing(
    alone: RunFolder, start_two: StartTwo, tmp_path: Path, start_train: Any
) -> None:
    """Kill -9 of the second, SIGTERM to the second, then on in one process with two devices."""
    folder = RunFolder(tmp_path / "run")
    first, second = start_two(*FLAGS, "--run-dir", folder.path)
    first.wait(lambda: saved_steps(folder.checkpoints))
    if sys.platform == "linux":  # gloo's thread interrupts no other one
        assert os.sched_getscheduler(second.process.pid) == os.SCHED_BATCH
    second.process.kill()
    killed = time.monotonic()
    output = first.end(1)
    assert time.monotonic() - killed < 60
    sentence = "mjx-balance: process 1 is gone, and the run ends with it; continue with --resume"
    assert f"{sentence} {folder.path}" in output
    assert "Traceback" not in output
    assert not folder.evaluation.exists()

    saved = max(saved_steps(folder.checkpoints))
    boards = len(list(folder.tensorboard.iterdir()))
    first, second = start_two("--resume", folder.path)
    first.wait(lambda: len(list(folder.tensorboard.iterdir())) > boards)
    second.process.send_signal(signal.SIGTERM)
    output, _ = first.end(130), second.end(130)
    assert f"resuming at {saved:,} decisions" in output
    assert f"continue with --resume {folder.path}" in output
    stopped = load_policy(folder.policy).manifest["training"]["env_steps"]
    assert saved <= stopped == max(saved_steps(folder.checkpoints))

    start_train("--resume", folder.path).end(0)
    assert fingerprint(folder) == fingerprint(alone)


def traced(index: int, address: str) -> int:
    """Shapes of a decision of MJX, in one of two processes; the device that the model lies on."""
    jax.config.update("jax_num_cpu_devices", 1)
    jax.distributed.initialize(address, 2, index)
    env = BalanceEnv()
    with unittest.mock.patch("mujoco.mjx.put_model", wraps=mjx.put_model) as put:
        state = jax.eval_shape(env.reset, jax.random.PRNGKey(0))
        jax.eval_shape(env.step, state, jax.ShapeDtypeStruct((), jnp.int32))
    ((_, device), _), *_ = put.call_args_list
    jax.distributed.shutdown()
    return device.process_index


def test_every_process_has_mjxs_model_on_a_device_of_its_own() -> None:
    """MJX puts it on the first device of all, which is process 0's."""
    with socket.create_server(("", 0)) as server:
        address = f"localhost:{server.getsockname()[1]}"
    with ProcessPoolExecutor(2, get_context("spawn")) as pool:
        assert list(pool.map(traced, (0, 1), (address, address))) == [0, 1]


def test_processes_that_were_started_differently_all_say_so(
    start_two: StartTwo, tmp_path: Path
) -> None:
    for process in start_two(*FLAGS, "--run-dir", tmp_path / "run", seeds=(3, 4)):
        assert process.end(2) == (
            "mjx-balance: process 1 has seed = 4, process 0 has 3; start all with the same flags "
            "and the same installation"
        )
    assert not (tmp_path / "run").exists()
