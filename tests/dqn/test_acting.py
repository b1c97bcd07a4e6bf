"""Exploration: how much of it, and that it is what it says it is."""

import dataclasses

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from mjx_balance.config import DQNConfig
from mjx_balance.dqn.acting import epsilon, epsilon_greedy, exploration_noise, explore

KEYS = jax.random.split(jax.random.PRNGKey(0), 20_000)


@pytest.mark.parametrize(
    ("env_steps", "expected"), [(0, 0.9), (1, 0.893), (50, 0.55), (100, 0.2), (10**9, 0.2)]
)
def test_epsilon_falls_linearly_and_stays(env_steps: int, expected: float) -> None:
    config = DQNConfig(epsilon_start=0.9, epsilon_end=0.2, epsilon_decay_steps=100)
    assert float(epsilon(config, jnp.int32(env_steps))) == pytest.approx(expected, rel=1e-6)


def test_epsilon_may_rise_or_stand_still() -> None:
    config = DQNConfig(epsilon_start=0.1, epsilon_end=0.1, epsilon_decay_steps=100)
    assert float(epsilon(config, jnp.int32(70))) == pytest.approx(0.1)
    rising = dataclasses.replace(config, epsilon_end=0.5)
    assert float(epsilon(rising, jnp.int32(50))) == pytest.approx(0.3)


@pytest.mark.parametrize("rate", [0.0, 0.3, 1.0])
def test_every_action_is_as_likely_as_epsilon_greedy_says(rate: float) -> None:
    """Five actions: rate / 5 each, and 1 - rate more for the best."""
    draw = jax.vmap(lambda key: epsilon_greedy(key, jnp.int32(2), jnp.float32(rate), 5))
    drawn = np.asarray(draw(KEYS))
    shares = np.bincount(drawn, minlength=5) / len(KEYS)
    expected = np.full(5, rate / 5)
    expected[2] += 1 - rate
    np.testing.assert_allclose(shares, expected, atol=0.015 if rate else 0)


def test_noise_moves_each_digit_by_up_to_its_levels_all_equally_often() -> None:
    """Action 4 * 7 + 3 of (9, 7) is (4, 3); two levels either way are 25 neighbours."""
    drawn = np.asarray(
        jax.vmap(lambda k: exploration_noise(k, jnp.int32(4 * 7 + 3), (9, 7), 2))(KEYS)
    )
    x, y = np.divmod(drawn, 7)
    counts = np.zeros((9, 7))
    np.add.at(counts, (x, y), 1)
    expected = np.zeros((9, 7))
    expected[2:7, 1:6] = len(KEYS) / 25
    assert np.abs(counts - expected).max() < 5 * np.sqrt(len(KEYS) / 25)


def test_noise_stops_at_the_ends() -> None:
    """From the corner (0, 6) half the moves lead out of the grid: they end on its edge."""
    corner = np.asarray(jax.vmap(lambda k: exploration_noise(k, jnp.int32(6), (9, 7), 1))(KEYS))
    shares = np.bincount(corner, minlength=63) / len(KEYS)
    expected = np.zeros((9, 7))
    expected[:2, 5:] = np.outer((2, 1), (1, 2)) / 9
    np.testing.assert_allclose(shares, expected.ravel(), atol=0.015)


def test_noise_keeps_the_actions_type() -> None:
    assert exploration_noise(KEYS[0], jnp.int32(3), (4,), 1).dtype == jnp.int32


def test_noise_is_independent_of_the_action_that_it_moves() -> None:
    """Nine random actions, noise of up to 4: the sums of two independent draws, clipped.

    An action moved by its own draw would end at the last one in 3 of 9 cases, not in 15 of 81.
    """
    draw = jax.vmap(lambda key: explore(key, jnp.int32(0), jnp.float32(1.0), (9,), 4))
    shares = np.bincount(draw(KEYS), minlength=9) / len(KEYS)
    expected = np.zeros(9)
    for action in range(9):
        for move in range(-4, 5):
            expected[min(max(action + move, 0), 8)] += 1 / 81
    np.testing.assert_allclose(shares, expected, atol=0.015)


def test_without_noise_the_greedy_action_is_taken() -> None:
    draw = jax.vmap(lambda key: explore(key, jnp.int32(1), jnp.float32(0.0), (3,), 0))
    assert set(np.asarray(draw(KEYS)).tolist()) == {1}
