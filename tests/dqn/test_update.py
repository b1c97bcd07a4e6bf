"""One update by hand: TD error, loss, optimiser."""

import dataclasses
import math
from functools import partial
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from mjx_balance.config import DQNConfig
from mjx_balance.dqn import DQN, DQNSpec
from mjx_balance.dqn.dqn import make_optimizer, td_error
from mjx_balance.dqn.replay import Transition
from mjx_balance.policy.heads import Additive

CONFIG = DQNConfig(learning_rate=0.1, learning_rate_end_share=0.1, max_grad_norm=2.0)
Q_TM1, Q_T, SELECTOR = ([1.0, 2.0, 3.0], [4.0, -1.0, 2.0], [0.0, 9.0, 1.0])
ERRORS = [(False, 0.0, 0.5 + 0.1 * 4 - 2), (True, 0.0, 0.5 + 0.1 * -1 - 2), (False, 1.0, 0.5 - 2)]
"""Double DQN, terminated -> TD error of action 1, reward 0.5, gamma 0.1."""


class Table:
    """A network whose parameters are the action values of every state, an integer."""

    head = None  #: there is one, which `apply` calls

    def apply(self, params: jax.Array, obs: jax.Array, method: str) -> Additive:
        assert method == "head"
        values = params[obs[..., 0].astype(int)]
        return Additive(values, (values.shape[-1],))


def table_loss(params: Any, target: Any, batch: Transition, config: DQNConfig) -> jax.Array:
    stub: Any = Table()
    return DQN(stub, stub, DQNSpec(config, 2, 2)).loss(params, target, batch, config)


@pytest.mark.parametrize(("double", "terminated", "error"), ERRORS)
@pytest.mark.parametrize("compiled", [False, True])
def test_td_error_by_hand(double: bool, terminated: float, error: float, compiled: bool) -> None:
    def one(*values: Any) -> jax.Array:
        q_tm1, a_tm1, r_t, discount_t, *others = map(jnp.asarray, values)
        q_t, selector = (Additive(x, (3,)) for x in others)
        return td_error(Additive(q_tm1, (3,)), a_tm1, r_t, discount_t, q_t, selector)

    function = jax.jit(one) if compiled else one
    discount_t = 0.1 * (1 - terminated)
    got = function(Q_TM1, 1, 0.5, discount_t, Q_T, SELECTOR if double else Q_T)
    assert float(got) == pytest.approx(error)


def test_loss_is_linear_in_errors_beyond_delta() -> None:
    """Errors 0.3, 2 and -5: below delta squared; beyond, the tangent 2 delta |e| - delta^2."""
    zeros = jnp.zeros(3)
    rewards = jnp.asarray([0.3, 2, -5])
    batch = Transition(zeros[:, None], zeros.astype(int), rewards, zeros, zeros[:, None])
    config = DQNConfig(gamma=0, huber_delta=0.5)
    q = jnp.zeros((1, 1))
    value, slope = jax.jit(jax.value_and_grad(partial(table_loss, config=config)))(q, q, batch)
    assert float(value) == pytest.approx((0.09 + 1.75 + 4.75) / 3)
    assert slope.item() == pytest.approx((-2 * 0.3 - 2 * 0.5 + 2 * 0.5) / 3)


def test_loss_is_the_mean_over_the_batch() -> None:
    rng = np.random.default_rng(0)
    q_tm1, q_t = rng.normal(size=(2, 5, 3))
    action, reward = np.asarray([0, 1, 2, 1, 0]), np.arange(5.0)
    terminated, states = np.asarray([0.0, 1, 0, 0, 1]), np.arange(5.0)[:, None]
    batch = Transition(*map(jnp.asarray, (states, action, reward, terminated, states)))
    got = jax.jit(partial(table_loss, config=DQNConfig(gamma=0.3)))(q_tm1, q_t, batch)
    errors = reward + 0.3 * (1 - terminated) * q_t.max(axis=-1) - q_tm1[np.arange(5), action]
    assert float(got) == pytest.approx(np.mean(errors**2), rel=1e-5)


def steps(config: DQNConfig, total: int, count: int) -> list[float]:
    """Adam's steps for a gradient that never changes: minus the learning rate."""
    optimizer = make_optimizer(config, total)

    def step(state: Any, _: None) -> tuple[Any, Any]:
        update, state = optimizer.update(jnp.ones(()), state)
        return state, update

    run = jax.jit(lambda: jax.lax.scan(step, optimizer.init(jnp.zeros(())), length=count)[1])
    return run().tolist()


def test_learning_rate_is_a_cosine_from_its_start_to_its_end() -> None:
    rates = steps(CONFIG, 10, 13)
    assert [rates[k] for k in (0, 5, 10, 12)] == pytest.approx(
        [-0.1, -0.055, -0.01, -0.01], rel=1e-4
    )
    constant = dataclasses.replace(CONFIG, learning_rate_end_share=1.0)
    assert steps(constant, 4, 6) == pytest.approx([-0.1] * 6, rel=1e-4)
    assert math.isfinite(steps(CONFIG, 0, 1)[0]), "a run without updates"
