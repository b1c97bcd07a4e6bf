"""What one update is made of: reflections, and the optimiser's steps."""

import dataclasses
import math

import jax
import jax.numpy as jnp
import numpy as np
import optax
import probes
import pytest

from mjx_balance.config import DQNConfig
from mjx_balance.dqn.replay import Transition
from mjx_balance.dqn.updating import make_optimizer, mirrored
from mjx_balance.task.symmetry import Symmetries

COUNT = 400
CONFIG = DQNConfig(learning_rate=0.1, learning_rate_end_share=0.1, max_grad_norm=2.0)


def test_mirrored_transitions_are_reflections_of_themselves() -> None:
    obs = jnp.linspace(0.1, 1, COUNT)[:, None]
    ended = (jnp.arange(COUNT) % 3 == 0).astype(jnp.float32)
    batch = Transition(obs, jnp.zeros(COUNT, int), obs[:, 0], ended, 2 * obs)
    got = mirrored(probes.PositiveState.symmetries, batch, jax.random.PRNGKey(0))
    flipped = np.asarray(got.action) == 1
    assert 0.4 < flipped.mean() < 0.6
    sign = np.where(flipped, -1.0, 1.0)[:, None]
    np.testing.assert_allclose(got.obs, sign * obs, rtol=1e-6)
    np.testing.assert_allclose(got.next_obs, 2 * sign * obs, rtol=1e-6)
    np.testing.assert_array_equal(got.reward, batch.reward)
    np.testing.assert_array_equal(got.terminated, batch.terminated)


def test_mirrored_by_a_group_whose_elements_are_not_their_own_inverses() -> None:
    """Turning a triangle: entry `obs_index[i]` comes to place i, action a becomes a turn on."""
    turns = np.asarray([[0, 1, 2], [1, 2, 0], [2, 0, 1]], np.int32)
    sign = np.asarray([[1, 1, 1], [1, -1, 1], [1, 1, -1]], np.float32)
    group = Symmetries(turns, sign, turns)
    obs = jnp.asarray([[10.0, 20.0, 30.0]] * COUNT)
    batch = Transition(obs, jnp.full(COUNT, 1), obs[:, 0], obs[:, 0], obs + 1)
    got = jax.device_get(mirrored(group, batch, jax.random.PRNGKey(1)))
    wanted = {1: (10, 20, 30), 2: (20, -30, 10), 0: (30, 10, -20)}
    after = {1: (11, 21, 31), 2: (21, -31, 11), 0: (31, 11, -21)}
    for row, action in enumerate(got.action.tolist()):
        assert tuple(got.obs[row]) == wanted[action]
        assert tuple(got.next_obs[row]) == after[action]
    counts = np.bincount(got.action)
    assert np.abs(counts - COUNT / 3).max() < 50, "each reflection as often as another"


@pytest.mark.parametrize(("step", "rate"), [(0, 0.1), (5, 0.055), (10, 0.01), (12, 0.01)])
def test_learning_rate_is_a_cosine_from_its_start_to_its_end(step: int, rate: float) -> None:
    """Adam's step for a gradient that never changes is the learning rate itself."""
    optimizer = make_optimizer(CONFIG, 10)
    state = optimizer.init(jnp.zeros(()))
    for _ in range(step):
        _, state = optimizer.update(jnp.ones(()), state)
    update, _ = optimizer.update(jnp.ones(()), state)
    assert float(np.asarray(update)) == pytest.approx(-rate, rel=1e-4)


def test_a_constant_learning_rate_stays() -> None:
    config = dataclasses.replace(CONFIG, learning_rate_end_share=1.0)
    optimizer = make_optimizer(config, 4)
    state = optimizer.init(jnp.zeros(()))
    for _ in range(6):
        update, state = optimizer.update(jnp.ones(()), state)
        assert float(np.asarray(update)) == pytest.approx(-0.1, rel=1e-4)


def test_gradients_are_clipped_by_their_norm_over_all_arrays() -> None:
    """(6, 8) and 0 have norm 10: all are scaled by 2 / 10 before Adam squares them."""
    optimizer = make_optimizer(CONFIG, 10)
    params = {"a": jnp.zeros(2), "b": jnp.zeros(1)}
    grads = {"a": jnp.asarray([6.0, 8.0]), "b": jnp.zeros(1)}
    _, state = optimizer.update(grads, optimizer.init(params))
    first = optax.tree_utils.tree_get(state, "mu")
    np.testing.assert_allclose(first["a"], (0.12, 0.16), rtol=1e-5)
    small = {"a": jnp.asarray([0.6, 0.8]), "b": jnp.zeros(1)}
    _, state = optimizer.update(small, optimizer.init(params))
    np.testing.assert_allclose(optax.tree_utils.tree_get(state, "mu")["a"], (0.06, 0.08), rtol=1e-5)


def test_a_run_without_an_update_has_a_schedule_all_the_same() -> None:
    optimizer = make_optimizer(CONFIG, 0)
    update, _ = optimizer.update(jnp.ones(()), optimizer.init(jnp.zeros(())))
    assert math.isfinite(float(np.asarray(update)))
