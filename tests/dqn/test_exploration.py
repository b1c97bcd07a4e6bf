"""Exploration: its share, and its distribution."""

from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from mjx_balance.config import DQNConfig
from mjx_balance.dqn import DQN, DQNSpec
from mjx_balance.dqn.dqn import epsilon_greedy, exploration_noise, linear_epsilon
from mjx_balance.policy.heads import Additive

KEYS = jax.random.split(jax.random.PRNGKey(0), 20_000)


@pytest.mark.parametrize(
    ("start", "end", "env_steps", "expected"),
    [
        *((0.9, 0.2, *x) for x in ((0, 0.9), (1, 0.893), (50, 0.55), (100, 0.2), (10**9, 0.2))),
        (0.1, 0.1, 70, 0.1),
        (0.1, 0.5, 50, 0.3),
    ],
)
def test_epsilon_is_linear_then_flat(
    start: float, end: float, env_steps: int, expected: float
) -> None:
    config = DQNConfig(epsilon_start=start, epsilon_end=end, epsilon_decay_steps=100)
    assert float(linear_epsilon(config, jnp.int32(env_steps))) == pytest.approx(expected, rel=1e-6)


@jax.jit
def choose(epsilon: jax.Array) -> jax.Array:
    """An action per key, of five; action 2 is the best."""
    return jax.vmap(lambda key: epsilon_greedy(key, jnp.int32(2), epsilon, 5))(KEYS)


@pytest.mark.parametrize("epsilon", [0.0, 0.3, 1.0])
def test_epsilon_greedy_shares(epsilon: float) -> None:
    """Five actions: epsilon / 5 each, and 1 - epsilon more for the best."""
    shares = np.bincount(choose(np.float32(epsilon)), minlength=5) / len(KEYS)
    expected = np.full(5, epsilon / 5)
    expected[2] += 1 - epsilon
    np.testing.assert_allclose(shares, expected, atol=0.015 if epsilon else 0)


def noise_shares(action: int, levels: int) -> np.ndarray:
    """Shares of the actions of (9, 7) that noise makes of one of them."""
    noise = lambda key: exploration_noise(key, jnp.int32(action), (9, 7), levels)  # noqa: E731
    drawn = jax.jit(jax.vmap(noise))(KEYS)
    assert drawn.dtype == jnp.int32
    return np.bincount(drawn, minlength=63).reshape(9, 7) / len(KEYS)


def test_noise_moves_each_digit_by_up_to_its_levels_all_equally_often() -> None:
    """Action 4 * 7 + 3 is (4, 3); two levels either way are 25 neighbours."""
    expected = np.zeros((9, 7))
    expected[2:7, 1:6] = 1 / 25
    assert np.abs(noise_shares(31, 2) - expected).max() < 5 / np.sqrt(25 * len(KEYS))


def test_noise_stops_at_the_ends() -> None:
    """From the corner (0, 6), two thirds of each digit's moves end on the edge."""
    expected = np.zeros((9, 7))
    expected[:2, 5:] = np.outer((2, 1), (1, 2)) / 9
    np.testing.assert_allclose(noise_shares(6, 1), expected, atol=0.015)


class Favourite:
    """A network of 9 actions that likes action 5 best."""

    head = None  #: there is one, which `apply` calls

    def apply(self, params: Any, obs: jax.Array, method: str) -> Additive:
        return Additive(jax.nn.one_hot(5, 9), (9,))


def actions(epsilon: float, levels: int) -> np.ndarray:
    """Actions of the DQN in training, one per key."""
    stub: Any = Favourite()
    spec = DQNSpec(DQNConfig(exploration_noise=levels), 2, 2, action_factors=(9,))
    act = jax.vmap(DQN(stub, stub, spec).act, (None, None, 0, None))
    return np.asarray(jax.jit(act)(None, jnp.zeros(1), KEYS, jnp.float32(epsilon)))


def test_noise_is_independent_of_the_action_that_it_moves() -> None:
    """Nine random actions, noise of up to 4: the sums of two independent draws, clipped.

    An action moved by its own draw would end at the last one in 3 of 9 cases, not in 15 of 81.
    """
    sums = np.clip(np.add.outer(np.arange(9), np.arange(-4, 5)), 0, 8)
    shares = np.bincount(actions(epsilon=1.0, levels=4), minlength=9) / len(KEYS)
    np.testing.assert_allclose(shares, np.bincount(sums.ravel()) / 81, atol=0.015)


def test_without_epsilon_and_noise_the_greedy_action_is_taken() -> None:
    assert set(actions(epsilon=0.0, levels=0).tolist()) == {5}
