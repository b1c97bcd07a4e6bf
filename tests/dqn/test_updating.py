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
from mjx_balance.dqn.updating import loss, make_optimizer, mirrored
from mjx_balance.policy.heads import Added
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


Q_TM1, Q_T, SELECTOR = ([1.0, 2.0, 3.0], [4.0, -1.0, 2.0], [0.0, 9.0, 1.0])


@pytest.mark.parametrize(
    ("double", "terminated", "error"),
    [(False, 0.0, 0.5 + 0.1 * 4 - 2), (True, 0.0, 0.5 + 0.1 * -1 - 2), (False, 1.0, 0.5 - 2)],
)
def test_loss_by_hand(double: bool, terminated: float, error: float) -> None:
    """Action 1 of three; the online network prefers action 1 in the next state.

    The gradient reaches the value of the action taken and nothing else.
    """
    tables = {"online": [Q_TM1, SELECTOR], "target": [[9.0, 9.0, 9.0], Q_T]}
    params, target = (jnp.asarray(tables[name]) for name in ("online", "target"))
    states = jnp.asarray([[0], [1]])
    action, reward, ended = map(jnp.asarray, ([1], [0.5], [terminated]))
    batch = Transition(states[:1], action, reward, ended, states[1:])

    def q_values(table: jax.Array, state: jax.Array) -> Added:
        return Added(table[state[:, 0]], (3,))

    config = DQNConfig(gamma=0.1, double=double)
    value, (by_params, by_target) = jax.value_and_grad(loss, (0, 1))(
        params, target, batch, q_values, config
    )
    assert float(value) == pytest.approx(error**2)
    np.testing.assert_allclose(by_params, [[0, -2 * error, 0], [0, 0, 0]], rtol=1e-5)
    bootstrapped = 0 if terminated else 2 * error * 0.1
    wanted = np.zeros((2, 3))
    wanted[1, 1 if double else 0] = bootstrapped
    np.testing.assert_allclose(by_target, wanted, atol=1e-6)


def test_a_loss_is_linear_in_errors_beyond_delta() -> None:
    """Errors 0.3, 2 and -5: below delta squared; beyond, the tangent 2 delta |e| - delta^2."""
    zeros = jnp.zeros(3)
    batch = Transition(zeros, zeros.astype(int), jnp.asarray([0.3, 2, -5]), zeros, zeros)
    config = DQNConfig(gamma=0, huber_delta=0.5)
    q_values = lambda value, obs: Added(jnp.broadcast_to(value, (3, 1)), (1,))  # noqa: E731
    got, slope = jax.value_and_grad(loss)(jnp.zeros(()), jnp.zeros(()), batch, q_values, config)
    assert float(got) == pytest.approx((0.09 + 1.75 + 4.75) / 3)
    assert float(slope) == pytest.approx((-2 * 0.3 - 2 * 0.5 + 2 * 0.5) / 3)


def test_loss_is_the_mean_over_the_batch() -> None:
    rng = np.random.default_rng(0)
    q_tm1, q_t = rng.normal(size=(2, 5, 3))
    action, reward = np.asarray([0, 1, 2, 1, 0]), np.arange(5.0)
    ended = np.asarray([0.0, 1, 0, 0, 1])
    batch = Transition(*map(jnp.asarray, (q_tm1, action, reward, ended, q_t)))
    got = loss(None, None, batch, lambda _, obs: Added(obs, (3,)), DQNConfig(gamma=0.3))
    errors = reward + 0.3 * (1 - ended) * q_t.max(axis=-1) - q_tm1[np.arange(5), action]
    assert float(got) == pytest.approx(np.mean(errors**2), rel=1e-5)
