"""A learner whose state holds nothing but the parameters that it exports."""

from typing import Any, NamedTuple

import jax
import jax.numpy as jnp

from mjx_balance.config import preset
from mjx_balance.dqn.networks import QNetwork
from mjx_balance.robots.catalogue import find_robot
from mjx_balance.task.observation import observation_names

CONFIG = preset("smoke")
SEED = CONFIG.seed


class State(NamedTuple):
    params: Any
    env_steps: Any
    gradient_steps: Any
    env_state: Any
    replay: Any


class Learner:
    """Exports parameters as they are."""

    network = QNetwork(CONFIG.dqn.hidden_sizes, (21, 21), radial=True)

    @staticmethod
    def exported(state: State) -> Any:
        assert state.env_state is None  # may be gigabytes
        assert state.replay is None
        return state.params


OBS = len(observation_names(CONFIG.task, find_robot(CONFIG.robot)))
PARAMS = Learner.network.init(jax.random.PRNGKey(0), jnp.zeros(OBS))


def state_of(*scales: float, env_steps: int = 64) -> Any:
    """Of as many seeds, parameters times a scale: not a number, for a seed that diverged."""
    count = jnp.full(len(scales), env_steps)
    params = jax.tree.map(lambda x: jnp.stack([x * scale for scale in scales]), PARAMS)
    state = State(params, count, 3 * count, count, count)
    return state if len(scales) > 1 else jax.tree.map(lambda x: x[0], state)
