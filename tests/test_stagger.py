"""First episodes end at different times, later ones have their whole length."""

import jax
import numpy as np

from mjx_balance.config import Config
from mjx_balance.env import BalanceEnv

COUNT = 600


def test_first_episodes_are_of_every_length(config: Config) -> None:
    env = BalanceEnv(config)
    keys = jax.random.split(jax.random.PRNGKey(0), COUNT)
    first, later = (
        np.asarray(jax.jit(jax.vmap(reset))(keys).info["decisions_left"])
        for reset in (env.reset_staggered, env.reset)
    )
    length = config.task.episode_length
    assert (later == length).all()
    assert first.min() >= 1
    assert first.max() <= length
    # Uniform: each quarter of the length has a quarter of the envs, within 4 standard deviations.
    quarters = np.histogram(first, 4, (1, length + 1))[0]
    assert np.abs(quarters - COUNT / 4).max() < 4 * np.sqrt(COUNT * 3 / 16)
