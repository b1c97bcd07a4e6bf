"""First episodes end at different times, later ones have their whole length."""

from typing import Any

import jax
import numpy as np

ENVS, EPISODE = 32, 50


def test_first_episodes_are_of_every_length(fleet: Any) -> None:
    keys = jax.random.split(jax.random.PRNGKey(0), 20 * EPISODE)
    state = jax.jit(jax.vmap(fleet.env.reset_staggered))(keys)
    left = np.asarray(state.info["episode_length"])
    # Uniform over 1 to EPISODE: each 20 times, within 5 standard deviations.
    counts = np.bincount(left, minlength=EPISODE + 1)
    assert counts[0] == 0
    assert len(counts) == EPISODE + 1
    assert np.abs(counts[1:] - 20).max() < 5 * np.sqrt(20)
    assert len(np.unique(np.asarray(state.pipeline_state.scenario.phase))) > 0.99 * len(keys)


def test_a_later_episode_has_its_whole_length(fleet: Any) -> None:
    left = fleet.reset(jax.random.split(jax.random.PRNGKey(1), ENVS)).info["episode_length"]
    assert (np.asarray(left) == EPISODE).all()
