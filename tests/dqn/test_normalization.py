"""Running statistics, the whitening matrix, and its place in the network."""

import dataclasses
from collections.abc import Callable

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from fixtures import probes

from mjx_balance.dqn import DQN, QNetwork, normalization
from mjx_balance.dqn.mesh import AXIS

FLOOR = 1e-6


@jax.jit
def observe(
    statistics: normalization.RunningStatistics, halves: jax.Array
) -> normalization.RunningStatistics:
    """Statistics after a batch, each half of which is on a device of its own."""
    update = jax.vmap(normalization.observe, (None, 0, None), axis_name=AXIS)
    return jax.tree.map(lambda x: x[0], update(statistics, halves, FLOOR))


def statistics_of(batches: list[np.ndarray]) -> normalization.RunningStatistics:
    """Statistics of batches, each split in halves on two devices."""
    statistics = normalization.init(batches[0].shape[1], FLOOR)
    for batch in batches:
        statistics = observe(statistics, np.asarray(np.split(batch, 2), np.float32))
    return statistics


def test_statistics_are_those_of_all_batches_recent_ones_weighing_more() -> None:
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
    got = statistics_of(batches)
    np.testing.assert_allclose(got.mean, mean, rtol=1e-4)
    np.testing.assert_allclose(got.covariance, square - np.outer(mean, mean), rtol=1e-3, atol=1e-3)
    assert float(got.batches) == 6
    damped = got.covariance + FLOOR * np.eye(3)
    np.testing.assert_allclose(got.matrix @ damped @ got.matrix, np.eye(3), atol=1e-3)


def test_the_first_batch_replaces_the_initial_statistics() -> None:
    """Initially inputs are only shrunk by the floor."""
    initial = normalization.init(2, 3.0)
    np.testing.assert_allclose(initial.matrix, np.eye(2) / 2, atol=1e-6)
    np.testing.assert_array_equal(initial.mean, 0)
    batch = np.random.default_rng(2).normal(7, 3, (50, 3))
    got = statistics_of([batch])
    np.testing.assert_allclose(got.mean, batch.mean(axis=0), rtol=1e-5)
    np.testing.assert_allclose(got.covariance, np.cov(batch.T, bias=True), rtol=1e-4)
    again = statistics_of([batch, np.full_like(batch, 1e30)])  # its squares are not finite
    jax.tree.map(np.testing.assert_array_equal, again, got)


def test_matrix_is_the_inverse_root_of_covariance_and_floor() -> None:
    """By hand: variances 3 and 0 with floor 1 become 1/2 and 1, in any rotated frame."""
    turn = np.asarray([[0.8, -0.6], [0.6, 0.8]])
    covariance = turn @ np.diag([3.0, 0.0]) @ turn.T
    got = normalization.whitening_matrix(jnp.asarray(covariance, jnp.float32), 1.0)
    np.testing.assert_allclose(got, turn @ np.diag([0.5, 1.0]) @ turn.T, atol=1e-6)


def test_a_variance_rounded_below_zero_counts_as_none() -> None:
    matrix = normalization.whitening_matrix(jnp.diag(jnp.asarray([1.0, -1e-3])), 1e-4)
    np.testing.assert_allclose(matrix[1, 1], 100, rtol=1e-4)


@pytest.mark.parametrize("hidden", [(8, 6), (8,)])
@pytest.mark.parametrize("radial", [False, True])
def test_folded_parameters_take_raw_observations(radial: bool, hidden: tuple[int, ...]) -> None:
    rng = np.random.default_rng(0)

    def normal(*shape: int) -> jax.Array:
        return jnp.asarray(rng.normal(size=shape), jnp.float32)

    network = QNetwork(hidden, (3, 4), radial)
    shapes = jax.eval_shape(network.init, jax.random.PRNGKey(0), jnp.zeros(5))
    params = jax.tree.map(lambda x: normal(*x.shape), shapes)
    mean, matrix, obs = normal(5), normal(5, 5), normal(20, 5)
    expected = np.asarray(jax.jit(network.apply)(params, (obs - mean) @ matrix))
    folded = network.fold_whitening(params, mean, matrix)
    got = np.asarray(jax.jit(network.apply)(folded, obs))
    np.testing.assert_allclose(got, expected, rtol=2e-4, atol=2e-4)


def test_an_observation_of_zeros_has_its_best_action_at_0(make_dqn: Callable[..., DQN]) -> None:
    """A raw one; the best point of any other moves by as much, and its value stays."""
    rng = np.random.default_rng(0)

    def normal(*shape: int) -> jax.Array:
        return jnp.asarray(rng.normal(size=shape), jnp.float32)

    network = QNetwork((16, 8), (3, 4), radial=True)
    shapes = jax.eval_shape(network.init, jax.random.PRNGKey(0), jnp.zeros(5))
    params = jax.tree.map(lambda x: normal(*x.shape), shapes)
    statistics = normalization.init(5, FLOOR)._replace(mean=normal(5), matrix=normal(5, 5))
    obs = jnp.concatenate((jnp.zeros((1, 5)), normal(20, 5)))

    def head(zero: bool) -> np.ndarray:
        dqn = make_dqn(probes.NoisyState(), head="radial", whiten_steps=8, zero_at_rest=zero)
        dqn = dataclasses.replace(dqn, network=network)
        return np.asarray(dqn.head(dqn.fold(params, statistics), obs).out)

    free, held = head(False), head(True)
    assert np.abs(free[0, 1:]).min() > 0.1
    np.testing.assert_allclose(held[0, 1:], 0, atol=1e-5)
    np.testing.assert_allclose(held[:, 0], free[:, 0])
    np.testing.assert_allclose(held[:, 1:], free[:, 1:] - free[0, 1:], rtol=1e-4, atol=1e-4)
