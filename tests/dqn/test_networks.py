"""The Q-network and its heads: one output per action, per level and axis, or a radial profile."""

import functools
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from mjx_balance.dqn import QNetwork
from mjx_balance.policy import heads

KEY = jax.random.PRNGKey(0)


def random_params(network: QNetwork) -> Any:
    """Weights and biases for 34 inputs, all of them random."""
    rng = np.random.default_rng(0)
    shapes = jax.eval_shape(network.init, KEY, jnp.zeros(34))
    return jax.tree.map(lambda x: jnp.asarray(rng.normal(size=x.shape), jnp.float32), shapes)


def random_obs(*shape: int) -> jax.Array:
    return jnp.asarray(np.random.default_rng(1).normal(size=shape), jnp.float32)


@pytest.mark.parametrize("factors", [(21, 21), (2, 3, 4)])
def test_value_of_an_action_is_the_sum_of_its_levels(factors: tuple[int, ...]) -> None:
    """An action's index is a mixed-radix number; the joint head gives the levels' own values."""
    obs = random_obs(10, 34)
    params = random_params(QNetwork((16,), factors))
    values, levels = (
        np.asarray(jax.jit(QNetwork((16,), shape).apply)(params, obs))
        for shape in (factors, (sum(factors),))
    )
    branches = np.split(levels, np.cumsum(factors)[:-1], axis=-1)
    for row in range(10):
        sums = functools.reduce(np.add.outer, [branch[row] for branch in branches])
        np.testing.assert_allclose(values[row], sums.ravel(), rtol=1e-4, atol=1e-5)


def test_radial_values_by_hand() -> None:
    """No hidden layer, no input: the head's bias is V and mu."""
    network = QNetwork((), (3, 5), radial=True)
    alpha, beta, kappa, delta = profile = np.asarray((2.0, 0.5, 3.0, 0.7))
    params = {
        "head": {"kernel": np.zeros((4, 3)), "bias": np.asarray((2.0, 0.5, -0.5))},
        "profile": np.log(np.exp(profile) - 1),  # softplus makes them what they are
        "stretch": np.log(np.asarray((2.0, 1.0))),
    }
    values = np.asarray(network.apply({"params": params}, jnp.zeros(2))).reshape(3, 5)
    for i, x in enumerate((-1.0, 0.0, 1.0)):
        for j, y in enumerate((-1.0, -0.5, 0.0, 0.5, 1.0)):
            z = np.sqrt(delta**2 + (2 * (x - 0.5)) ** 2 + (y + 0.5) ** 2)
            expected = 2 + alpha * np.exp(-beta * z) - kappa * z
            assert values[i, j] == pytest.approx(expected, abs=1e-5)


def some_heads(batch: tuple[int, ...], seed: int) -> list[heads.Head]:
    """One of each kind, of 3 x 4 x 2 actions; mu lies in the grid or beyond it."""
    rng = np.random.default_rng(seed)
    factors = (3, 4, 2)
    branches, out, profile, stretch = (
        rng.normal(size=(*shape,)).astype(np.float32)
        for shape in ((*batch, 9), (*batch, 4), (4,), (3,))
    )
    joint = rng.normal(size=(*batch, 24)).astype(np.float32)
    return [
        heads.Additive(joint, (24,)),
        heads.Additive(branches, factors),
        heads.Radial(out, profile, stretch, factors),
    ]


def results(head: heads.Head, action: Any) -> tuple[Any, Any, Any]:
    return head.q_values(), head.q_value(action), head.argmax()


def results_of(kind: Any, factors: Any, arrays: Any, action: Any) -> tuple[Any, Any, Any]:
    return results(kind(*arrays, factors), action)


@pytest.mark.parametrize("batch", [(), (2, 3)])
def test_heads_give_numpy_and_jax_the_same(batch: tuple[int, ...]) -> None:
    rng = np.random.default_rng(4)
    action = rng.integers(24, size=batch)
    for plain in some_heads(batch, 3):
        *arrays, factors = vars(plain).values()
        traced = jax.jit(functools.partial(results_of, type(plain), factors))
        for a, b in zip(results(plain, action), traced(arrays, action), strict=True):
            assert not isinstance(a, jax.Array)
            assert a.shape == b.shape
            assert a.dtype in (np.float32, np.int32, np.int64)
            np.testing.assert_allclose(b, a, rtol=1e-4, atol=1e-5)


@pytest.mark.parametrize("batch", [(), (50,), (2, 30)])
def test_value_of_one_action_and_the_best_one_are_those_of_all_values(
    batch: tuple[int, ...],
) -> None:
    action = np.random.default_rng(5).integers(24, size=batch)
    best = set()
    for seed in range(5):
        for head in some_heads(batch, seed):
            values = head.q_values()
            assert values.shape == (*batch, 24)
            expected = np.take_along_axis(values, action[..., None], axis=-1)[..., 0]
            np.testing.assert_allclose(head.q_value(action), expected, rtol=1e-6, atol=1e-6)
            np.testing.assert_array_equal(head.argmax(), values.argmax(axis=-1))
            best |= set(np.ravel(head.argmax()).tolist())
    assert not batch or len(best) > 15, "some of them inside the grid, some on its edge"


def test_what_is_not_a_number_is_worth_an_action_all_the_same() -> None:
    """A robot that diverged observes NaN; it is counted as fallen, and stops nobody."""
    for head in some_heads((2,), 0):
        name = "branches" if isinstance(head, heads.Additive) else "out"
        array = vars(head)[name].copy()
        array[0] = np.nan
        best = type(head)(**vars(head) | {name: array}).argmax()
        assert 0 <= best[0] < 24
        assert best[1] == head.argmax()[1]
