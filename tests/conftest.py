"""Fixtures shared by the tests, and two CPU devices for those that shard."""

import types

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from mjx_balance.config import Config, preset
from mjx_balance.config import RobotConfig as Robot
from mjx_balance.scene import Scene, load_scene

jax.config.update("jax_num_cpu_devices", 2)


@pytest.fixture(scope="session")
def config() -> Config:
    """The preset `default`."""
    return preset("default")


@pytest.fixture(scope="session")
def robot(config: Config) -> Robot:
    """The robot's numbers."""
    return config.robot


@pytest.fixture(scope="session")
def scene(config: Config) -> Scene:
    """The scene of the preset `default`; do not modify its model."""
    return load_scene(config)


@pytest.fixture(params=(np, jnp), ids=("numpy", "jax"))
def xp(request: pytest.FixtureRequest) -> types.ModuleType:
    """Both array libraries that the task's functions run on."""
    return request.param
