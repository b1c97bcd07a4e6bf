"""The Q-network: one output per action, or one per level and axis, added up."""

from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from mjx_balance.dqn.networks import QNetwork
from mjx_balance.policy import heads

KEY = jax.random.PRNGKey(0)


def random_params(network: QNetwork) -> Any:
    """Weights and biases for 34 inputs, all of them random."""
    rng = np.random.default_rng(0)
    shapes = jax.eval_shape(network.init, KEY, jnp.zeros(34))
    return jax.tree.map(lambda x: jnp.asarray(rng.normal(size=x.shape), jnp.float32), shapes)


def random_obs(*shape: int) -> jax.Array:
    return jnp.asarray(np.random.default_rng(1).normal(size=shape), jnp.float32)


@pytest.mark.parametrize(
    ("factors", "outputs", "actions"),
    [((441,), 441, 441), ((21, 21), 42, 441), ((2, 3, 4), 9, 24)],
)
def test_shapes(factors: tuple[int, ...], outputs: int, actions: int) -> None:
    network = QNetwork((16, 8), factors)
    params = jax.eval_shape(network.init, KEY, jnp.zeros(34))
    shapes = jax.tree.map(lambda x: x.shape, params["params"])
    assert shapes["hidden_0"] == {"kernel": (34, 16), "bias": (16,)}
    assert shapes["hidden_1"] == {"kernel": (16, 8), "bias": (8,)}
    assert shapes["head"] == {"kernel": (8, outputs), "bias": (outputs,)}
    for batch in ((), (5,), (2, 3)):
        obs = jax.ShapeDtypeStruct((*batch, 34), jnp.float32)
        assert jax.eval_shape(network.apply, params, obs).shape == (*batch, actions)


def test_value_of_an_action_is_the_sum_of_its_levels() -> None:
    """Action 21 i + j is worth branch_x[i] + branch_y[j]; so the best is the best of each."""
    obs = random_obs(50, 34)
    params = random_params(QNetwork((16,), (21, 21)))
    values = np.asarray(QNetwork((16,), (21, 21)).apply(params, obs))
    x, y = np.split(np.asarray(QNetwork((16,), (42,)).apply(params, obs)), 2, axis=-1)
    np.testing.assert_allclose(values.reshape(50, 21, 21), x[:, :, None] + y[:, None], rtol=1e-5)
    best = 21 * x.argmax(axis=-1) + y.argmax(axis=-1)
    np.testing.assert_array_equal(values.argmax(axis=-1), best)


def test_three_factors_are_a_mixed_radix_number() -> None:
    obs = random_obs(34)
    params = random_params(QNetwork((), (2, 3, 4)))
    values = np.asarray(QNetwork((), (2, 3, 4)).apply(params, obs))
    a, b, c = np.split(np.asarray(QNetwork((), (9,)).apply(params, obs)), (2, 5))
    assert values[1 * 12 + 2 * 4 + 3] == pytest.approx(a[1] + b[2] + c[3], rel=1e-5)


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
        heads.Added(joint, (24,)),
        heads.Added(branches, factors),
        heads.Radial(out, profile, stretch, factors),
    ]


def in_jax(head: heads.Head) -> heads.Head:
    if isinstance(head, heads.Added):
        return heads.Added(jnp.asarray(head.branches), head.factors)
    out, profile, stretch = map(jnp.asarray, (head.out, head.profile, head.stretch))
    return heads.Radial(out, profile, stretch, head.factors)


@pytest.mark.parametrize("batch", [(), (3,), (2, 3)])
def test_heads_give_numpy_and_jax_the_same(batch: tuple[int, ...]) -> None:
    rng = np.random.default_rng(4)
    action = rng.integers(24, size=batch)
    for plain in some_heads(batch, 3):
        traced = in_jax(plain)
        for a, b in (
            (plain.q_values(), traced.q_values()),
            (plain.q_value(action), traced.q_value(jnp.asarray(action))),
            (plain.argmax(), traced.argmax()),
        ):
            assert not isinstance(a, jax.Array)
            assert isinstance(b, jax.Array)
            assert a.shape == b.shape
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
        name = "branches" if isinstance(head, heads.Added) else "out"
        array = vars(head)[name].copy()
        array[0] = np.nan
        best = type(head)(**vars(head) | {name: array}).argmax()
        assert 0 <= best[0] < 24
        assert best[1] == head.argmax()[1]


def test_points_of_the_radial_head_follow_the_index() -> None:
    """Action 4 i + j of (3, 4) stands at i of -1, 0, 1 and j of -1, -1/3, 1/3, 1."""
    points = heads.points((3, 4))
    assert points.dtype == np.float32
    np.testing.assert_allclose(points[4 * 2 + 1], (1, -1 / 3), rtol=1e-6)
    np.testing.assert_allclose(points[3], (-1, 1))


def test_best_radial_action_is_the_nearest_to_mu() -> None:
    """Wherever mu is, in the grid or beyond it."""
    network = QNetwork((), (21, 21), radial=True)
    rng = np.random.default_rng(0)
    for _ in range(20):
        mu = rng.uniform(-1.5, 1.5, 2)
        params = {
            "head": {"kernel": np.zeros((4, 3)), "bias": np.asarray((0.0, *mu))},
            "profile": rng.normal(size=4),
            "stretch": np.zeros(2),
        }
        best = int(np.argmax(np.asarray(network.apply({"params": params}, jnp.zeros(2)))))
        nearest = np.rint(10 * (np.clip(mu, -1, 1) + 1)).astype(int)
        assert best == 21 * nearest[0] + nearest[1]


@pytest.mark.parametrize("factors", [(441,), (21, 21)])
def test_gradient_of_one_action_reaches_every_layer(factors: tuple[int, ...]) -> None:
    network, obs = QNetwork((16, 16), factors), random_obs(34)
    value = jax.jit(lambda params: jnp.asarray(network.apply(params, obs))[100])
    grads = jax.grad(value)(random_params(network))
    for leaf in map(np.asarray, jax.tree.leaves(grads)):
        assert np.abs(leaf).max() > 0
    assert np.count_nonzero(grads["params"]["head"]["bias"]) == len(factors)
