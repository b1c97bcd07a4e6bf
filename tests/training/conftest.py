"""Fixtures of the tests of training: whole runs as processes, and a learner that learns nothing."""

import io
import os
import subprocess
import sys
import time
import types
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from rich.console import Console

from mjx_balance.config import Config, preset
from mjx_balance.dqn import QNetwork
from mjx_balance.files.run_folder import RunFolder
from mjx_balance.report.progress import Display
from mjx_balance.robots.catalogue import find_robot
from mjx_balance.task.observation import input_rows
from mjx_balance.training.loop import Run

REPO = Path(__file__).parents[2]
PATIENCE_S = 300.0


class TrainProcess:
    """`train.py` as a user starts it, with a program cache of its own."""

    def __init__(self, cache: Path, *flags: str):
        environment = os.environ | {"MJX_BALANCE_CACHE": str(cache)}
        environment.pop("TF_CPP_MIN_LOG_LEVEL", None)  # JAX, imported here, has set it
        self.process = subprocess.Popen(
            [sys.executable, str(REPO / "train.py"), *flags],
            env=environment,
            stdout=subprocess.PIPE,
            stderr=subprocess.STDOUT,
            text=True,
        )

    def end(self, code: int | None = None) -> str:
        """Waits for its end, with this exit code; returns its output, but for gloo's own line."""
        output, _ = self.process.communicate(timeout=PATIENCE_S)
        assert code is None or self.process.returncode == code, output
        return "\n".join(x for x in output.splitlines() if not x.startswith("[Gloo]"))

    def wait(self, when: Callable[[], object]) -> None:
        """Until something is the case, or the process has ended."""
        until = time.monotonic() + PATIENCE_S
        while not when() and self.process.poll() is None and time.monotonic() < until:
            time.sleep(0.02)

    def interrupt(self, number: int, when: Callable[[], object], code: int | None = None) -> str:
        """Sends a signal as soon as something is the case."""
        self.wait(when)
        self.process.send_signal(number)
        return self.end(-number if code is None else code)


@pytest.fixture(scope="module")
def cache(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A program cache, cold at first."""
    return tmp_path_factory.mktemp("cache")


@pytest.fixture(scope="module")
def start_train(cache: Path) -> Iterator[Callable[..., TrainProcess]]:
    """Flags -> `TrainProcess`; those that still run are killed at the end."""
    started: list[TrainProcess] = []

    def start(*flags: object) -> TrainProcess:
        started.append(TrainProcess(cache, *map(str, flags)))
        return started[-1]

    yield start
    for each in started:
        with each.process as process:
            process.kill()


@pytest.fixture
def folder(tmp_path: Path) -> RunFolder:
    return RunFolder(tmp_path)


class Listener(Display):
    """Remembers its lines."""

    def __init__(self) -> None:
        super().__init__(Console(file=io.StringIO(), width=200))
        self.lines: list[str] = []

    def say(self, message: str) -> None:
        self.lines.append(message)


@pytest.fixture
def display() -> Listener:
    """A display whose `lines` can be read."""
    return Listener()


class StubState(NamedTuple):
    """A state that holds nothing but the parameters that are exported."""

    params: Any
    env_steps: Any
    gradient_steps: Any
    env_state: Any
    replay: Any


class StubLearner:
    """Exports the parameters of its state as they are, of a network of the preset `smoke`."""

    def __init__(self) -> None:
        config = preset("smoke")
        self.network = QNetwork(config.dqn.hidden_sizes, (21, 21), radial=True)
        self.obs_size = len(input_rows(config.task, find_robot(config.robot)))
        init = jax.jit(self.network.init)
        self.params: Any = init(jax.random.PRNGKey(0), jnp.zeros(self.obs_size))
        self.first_weight = float(self.params["params"]["hidden_0"]["kernel"].ravel()[0])

    def export_params(self, state: StubState) -> Any:
        """The parameters."""
        assert state.env_state is None  # may be gigabytes
        assert state.replay is None
        return state.params

    def scale_of(self, policy: Any) -> float:
        """The factor of a policy's weights."""
        return float(policy.layers[0][0].ravel()[0]) / self.first_weight

    def state_of(self, *scales: float, env_steps: int = 64) -> Any:
        """Of as many seeds, parameters times a scale: not a number, for a seed that diverged."""
        count = jnp.full(len(scales), env_steps)
        params = jax.tree.map(lambda x: jnp.stack([x * scale for scale in scales]), self.params)
        state = StubState(params, count, 3 * count, count, count)
        return state if len(scales) > 1 else jax.tree.map(lambda x: x[0], state)


@pytest.fixture(scope="session")
def stub_learner() -> StubLearner:
    return StubLearner()


@pytest.fixture
def make_run(folder: RunFolder, display: Listener, stub_learner: StubLearner) -> Callable[..., Run]:
    """Config, scene -> a run of the stub learner."""

    def make(config: Config, scene: Any = None) -> Run:
        stance = types.SimpleNamespace(leg_trim=np.zeros((4, 3)))
        scene = scene or types.SimpleNamespace(hash="hash", stance=stance)
        env: Any = types.SimpleNamespace(scene=scene, metrics={})
        learner: Any = stub_learner
        return Run(config, env, learner, folder, display)

    return make
