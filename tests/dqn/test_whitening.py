"""Whitening: moments, the matrix, and its place in the network."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from mjx_balance.dqn import whitening
from mjx_balance.dqn.networks import QNetwork

FLOOR = 1e-6


def gathered(batches: list[np.ndarray]) -> whitening.InputStatistics:
    seen = whitening.init(batches[0].shape[1], FLOOR)
    for batch in batches:
        mean = jnp.asarray(batch.mean(axis=0))
        seen = whitening.update(seen, mean, jnp.asarray(np.cov(batch.T, bias=True)), FLOOR)
    return seen


def test_moments_are_those_of_all_observations_the_late_ones_weighing_more() -> None:
    """Batch k of n weighs 4 / (n + 3) prod_{j > k} (j - 1) / (j + 3), about (k / n)^3."""
    rng = np.random.default_rng(1)
    batches = [rng.normal(k, 1 + k, (50, 3)) for k in range(6)]
    weights = np.zeros(6)
    for k in range(6):
        weights *= k / (k + 4)
        weights[k] = 4 / (k + 4)
    assert weights.sum() == pytest.approx(1)
    assert weights[-1] > weights[0]
    mean = sum(w * b.mean(axis=0) for w, b in zip(weights, batches, strict=True))
    square = sum(w * b.T @ b / len(b) for w, b in zip(weights, batches, strict=True))
    seen = gathered(batches)
    np.testing.assert_allclose(seen.mean, mean, rtol=1e-4)
    np.testing.assert_allclose(seen.covariance, square - np.outer(mean, mean), rtol=1e-3, atol=1e-3)
    assert float(seen.batches) == 6
    damped = seen.covariance + FLOOR * np.eye(3)
    np.testing.assert_allclose(seen.matrix @ damped @ seen.matrix, np.eye(3), atol=1e-3)


def test_the_first_batch_replaces_what_there_was_before_any() -> None:
    batch = np.random.default_rng(2).normal(7, 3, (100, 2))
    seen = gathered([batch])
    np.testing.assert_allclose(seen.mean, batch.mean(axis=0), rtol=1e-5)
    np.testing.assert_allclose(seen.covariance, np.cov(batch.T, bias=True), rtol=1e-4)


def test_matrix_is_the_inverse_root_of_covariance_and_floor() -> None:
    """By hand: variances 3 and 0 with floor 1 become 1/2 and 1, in any rotated frame."""
    turn = np.asarray([[0.8, -0.6], [0.6, 0.8]])
    covariance = turn @ np.diag([3.0, 0.0]) @ turn.T
    expected = turn @ np.diag([0.5, 1.0]) @ turn.T
    got = whitening.matrix(jnp.asarray(covariance, jnp.float32), 1.0)
    np.testing.assert_allclose(got, expected, atol=1e-6)


def test_a_variance_rounded_below_zero_counts_as_none() -> None:
    covariance = jnp.asarray([[1.0, 0.0], [0.0, -1e-3]])
    np.testing.assert_allclose(whitening.matrix(covariance, 1e-4)[1, 1], 100, rtol=1e-4)


def test_whitened_observations_are_uncorrelated_and_of_equal_size() -> None:
    """Three nearly equal sensors: after whitening, covariance I where there is variance."""
    rng = np.random.default_rng(0)
    common = rng.normal(size=(4_000, 1))
    obs = 5 + common + 0.1 * rng.normal(size=(4_000, 3))
    seen = gathered(np.split(obs, 40))
    white = (obs - np.asarray(seen.mean)) @ np.asarray(seen.matrix)
    np.testing.assert_allclose(np.cov(white.T), np.eye(3), atol=0.15)


@pytest.mark.parametrize("hidden", [(8, 6), (8,), ()])
@pytest.mark.parametrize("radial", [False, True])
def test_folded_parameters_take_raw_observations(radial: bool, hidden: tuple[int, ...]) -> None:
    rng = np.random.default_rng(0)
    network = QNetwork(hidden, (3, 4), radial)
    shapes = jax.eval_shape(network.init, jax.random.PRNGKey(0), jnp.zeros(5))
    params = jax.tree.map(lambda x: jnp.asarray(rng.normal(size=x.shape), jnp.float32), shapes)
    mean = jnp.asarray(rng.normal(size=5), jnp.float32)
    matrix = jnp.asarray(rng.normal(size=(5, 5)), jnp.float32)
    obs = jnp.asarray(rng.normal(size=(20, 5)), jnp.float32)
    expected = network.apply(params, (obs - mean) @ matrix)
    folded = network.folded(params, mean, matrix)
    np.testing.assert_allclose(
        np.asarray(network.apply(folded, obs)), np.asarray(expected), rtol=2e-4, atol=2e-4
    )


def test_before_any_observation_inputs_are_only_shrunk_by_the_floor() -> None:
    seen = whitening.init(3, 3.0)
    np.testing.assert_allclose(seen.matrix, np.eye(3) / 2, atol=1e-6)
    np.testing.assert_array_equal(seen.mean, 0)
