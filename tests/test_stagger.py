"""First episodes end at different times, later ones have their whole length."""

import jax
import numpy as np

from mjx_balance.config import Config
from mjx_balance.env import BalanceEnv
from mjx_balance.training.devices import make_learner, size_to_device

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


def test_a_run_begins_with_them(config: Config) -> None:
    sized = size_to_device(config)
    env = BalanceEnv(sized)
    assert make_learner(sized, env).first_reset == env.reset_staggered
