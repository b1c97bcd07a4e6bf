"""A DQN on one of the probe environments."""

import dataclasses
from collections.abc import Callable
from typing import Any

import pytest
from brax.envs.base import Env
from fixtures import probes

from mjx_balance.dqn import DQN, DQNSpec, QNetwork


@pytest.fixture(scope="session")
def make_dqn() -> Callable[..., DQN]:
    """Makes one from an env, fields of the spec, and changes to the probes' `DQNConfig`."""
    fields = {field.name for field in dataclasses.fields(DQNSpec)} - {"config"}

    def make(env: Env, iterations: int = 400, **values: Any) -> DQN:
        numbers = {name: values.pop(name) for name in fields & values.keys()}
        config = dataclasses.replace(probes.CONFIG, **values)
        num_envs: Any = numbers.setdefault("num_envs", 8)
        numbers.setdefault("num_env_steps", iterations * num_envs)
        network = QNetwork(config.hidden_sizes, (env.action_size,), config.head == "radial")
        return DQN(env, network, DQNSpec(config, **numbers))

    return make
