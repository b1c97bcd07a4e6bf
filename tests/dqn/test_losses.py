"""The temporal-difference error of paper Eq. 1, by hand."""

from collections.abc import Callable

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from mjx_balance.dqn.losses import td_error

Q_TM1 = jnp.asarray([1.0, 2.0, 3.0])
Q_T = jnp.asarray([4.0, -1.0, 2.0])
ACTION, REWARD, DISCOUNT = jnp.int32(1), jnp.float32(0.5), jnp.float32(0.1)

both = pytest.mark.parametrize("compiled", [lambda f: f, jax.jit], ids=("eager", "jit"))
Wrapper = Callable[[Callable[..., jax.Array]], Callable[..., jax.Array]]


@both
def test_error_by_hand(compiled: Wrapper) -> None:
    """0.5 + 0.1 * max(4, -1, 2) - 2 = -1.1."""
    error = compiled(td_error)(Q_TM1, ACTION, REWARD, DISCOUNT, Q_T)
    assert float(error) == pytest.approx(-1.1)


@both
def test_a_termination_stops_bootstrapping(compiled: Wrapper) -> None:
    """Discount 0 leaves 0.5 - 2 = -1.5."""
    error = compiled(td_error)(Q_TM1, ACTION, REWARD, jnp.float32(0.0), Q_T)
    assert float(error) == pytest.approx(-1.5)


@both
def test_double_dqn_values_the_selectors_choice(compiled: Wrapper) -> None:
    """The selector prefers action 1, which q_t values at -1: 0.5 - 0.1 - 2 = -1.6."""
    selector = jnp.asarray([0.0, 9.0, 1.0])
    error = compiled(td_error)(Q_TM1, ACTION, REWARD, DISCOUNT, Q_T, selector)
    assert float(error) == pytest.approx(-1.6)


def test_gradient_reaches_only_the_value_of_the_action_taken() -> None:
    def error(q_tm1: jax.Array, q_t: jax.Array, selector: jax.Array) -> jax.Array:
        return td_error(q_tm1, ACTION, REWARD, DISCOUNT, q_t, selector)

    grads = jax.grad(error, argnums=(0, 1, 2))(Q_TM1, Q_T, Q_T)
    np.testing.assert_array_equal(grads, [[0, -1, 0], [0, 0, 0], [0, 0, 0]])


def test_vmap_equals_the_formula_on_every_row() -> None:
    q_tm1, q_t = np.random.default_rng(0).normal(size=(2, 5, 3))
    actions, rewards = np.asarray([0, 1, 2, 1, 0]), np.arange(5.0)
    discounts = np.asarray([0.1, 0.0, 0.1, 0.9, 0.0])
    expected = rewards + discounts * q_t.max(axis=-1) - q_tm1[np.arange(5), actions]
    rows = [jnp.asarray(x) for x in (q_tm1, actions, rewards, discounts, q_t)]
    np.testing.assert_allclose(jax.vmap(td_error)(*rows), expected, atol=1e-6)


def test_a_batch_is_refused() -> None:
    with pytest.raises(ValueError, match=r"one transition.*\[2, 1, 1, 1, 2\]"):
        td_error(jnp.ones((5, 3)), jnp.zeros(5, int), jnp.ones(5), jnp.ones(5), jnp.ones((5, 3)))


def test_a_batch_of_selectors_is_refused() -> None:
    with pytest.raises(ValueError, match="one transition"):
        td_error(Q_TM1, ACTION, REWARD, DISCOUNT, Q_T, jnp.ones((5, 3)))
