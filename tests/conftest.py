"""Fixtures shared by the tests, and two CPU devices for those that shard."""

import dataclasses
import gc
import os
import re
import socket
import subprocess
import types
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import imageio_ffmpeg
import jax
import jax.numpy as jnp
import jaxtyping
import numpy as np
import pytest
from hypothesis import settings

from mjx_balance.config import Config, preset
from mjx_balance.robots.catalogue import Robot, find_robot
from mjx_balance.sim.scene import Scene, load_scene

# The same examples in every run: what fails here fails everywhere. `--hypothesis-profile=default`
# draws others.
settings.register_profile("repeatable", derandomize=True)
settings.load_profile("repeatable")
pytest_plugins = ("fixtures.bodies", "fixtures.fleet", "fixtures.headers")

jax.config.update("jax_num_cpu_devices", 2)
# The suite compiles longer than it computes. XLA reads this when its first device is asked for.
XLA_FLAGS = "--xla_backend_optimization_level=0"
if jax.__version_info__ < (0, 10):  # a third of the time; a later XLA has no such flag
    XLA_FLAGS += " --xla_cpu_use_fusion_emitters=false"
os.environ.setdefault("XLA_FLAGS", XLA_FLAGS)
# Imports and traces make millions of objects that live on: with the usual 700, the collector walks
# through them for a tenth of the time.
gc.set_threshold(100_000, 20, 100)

CHECKED = ("task", "sim", "envs")
"""Folders whose tests check the shapes in annotations; that takes half as long again."""
FLEET = (
    "test_engines",
    "test_compiled_engine",
    "test_env",
    "test_env_randomization",
    "test_stagger",
)
"""Files that share the fixture `fleet`, which takes a minute to compile over MJX."""
FIRST = ("test_run", "test_distributed", "test_learning", *FLEET, "dqn", "test_page")
"""Files and folders that begin first, so that the last of several processes is not left alone."""


def pytest_collection_modifyitems(config: pytest.Config, items: list[pytest.Item]) -> None:
    """Puts what takes long first, where several processes share the tests."""

    def rank(item: pytest.Item) -> int:
        names = (item.path.stem, item.path.parent.name)
        return next((k for k, name in enumerate(FIRST) if name in names), len(FIRST))

    if hasattr(config, "workerinput"):
        items.sort(key=rank)


@pytest.hookimpl(optionalhook=True)
def pytest_xdist_make_scheduler(config: pytest.Config, log: Any) -> Any:
    """Keeps a file's tests, and those of all files that share a fixture, in one process."""
    from xdist.scheduler import LoadScopeScheduling

    class ByFile(LoadScopeScheduling):
        def _split_scope(self, nodeid: str) -> str:
            file = nodeid.split("::", 1)[0]
            return "fleet" if Path(file).stem in FLEET else file

    return ByFile(config, log)


def pytest_runtest_setup(item: pytest.Item) -> None:
    """Checks shapes where the functions that have them are tested."""
    jaxtyping.config.update("jaxtyping_disable", item.path.parent.name not in CHECKED)


def pytest_sessionfinish(session: pytest.Session) -> None:
    """Where everything can be installed, a skipped test has not passed."""
    reporter = session.config.pluginmanager.get_plugin("terminalreporter")
    if os.environ.get("CI") and reporter is not None and reporter.stats.get("skipped"):
        session.exitstatus = pytest.ExitCode.TESTS_FAILED


@pytest.fixture(scope="session")
def config() -> Config:
    """The preset `default`, on the paper's grid."""
    default = preset("default")
    return dataclasses.replace(default, task=dataclasses.replace(default.task, action="grid"))


@pytest.fixture(scope="session")
def scene(config: Config) -> Scene:
    """The scene of the preset `default`; do not modify its model."""
    return load_scene(config)


@pytest.fixture(scope="session")
def robot() -> Robot:
    """Our quadruped."""
    return find_robot("quadruped")


@pytest.fixture(params=(np, jnp), ids=("numpy", "jax"))
def xp(request: pytest.FixtureRequest) -> types.ModuleType:
    """Both array libraries that the task's functions run on."""
    return request.param


@pytest.fixture
def compiled(xp: types.ModuleType) -> Callable[..., Any]:
    """Function -> the same, compiled by JAX if arrays are JAX's: operation by operation is slow."""
    return jax.jit if xp is jnp else lambda function: function


@pytest.fixture
def address() -> tuple[str, int]:
    """An IP and a port at which nobody listens."""
    with socket.create_server(("127.0.0.1", 0)) as server:
        return server.getsockname()


@pytest.fixture
def opened() -> Iterator[list[socket.socket]]:
    """Connections to close at the end."""
    connections: list[socket.socket] = []
    yield connections
    for connection in connections:
        connection.close()


@pytest.fixture
def read_video() -> Callable[[Path], tuple[float, np.ndarray]]:
    """Path of a video -> frames per second, and the frames (n, height, width, 3)."""

    def read(path: Path) -> tuple[float, np.ndarray]:
        # By ffmpeg itself: imageio's readers leave pipes open, which is a warning.
        command = [imageio_ffmpeg.get_ffmpeg_exe(), "-i", str(path)]
        done = subprocess.run(
            [*command, "-f", "rawvideo", "-pix_fmt", "rgb24", "-"], capture_output=True, check=True
        )
        log = done.stderr.decode()
        width, height = map(int, re.findall(r"Video: .*?(\d{2,})x(\d{2,})", log)[0])
        frames = np.frombuffer(done.stdout, np.uint8).reshape(-1, height, width, 3)
        return float(re.findall(r"([\d.]+) fps", log)[0]), frames.astype(float)

    return read
