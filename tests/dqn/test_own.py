"""Networks and losses of the user's own."""

import dataclasses
from typing import Any

import flax.linen as nn
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from fixtures import probes

from mjx_balance.config import preset
from mjx_balance.dqn import DQN, DQNSpec, QNetwork, td_error
from mjx_balance.dqn.networks import Whitened
from mjx_balance.dqn.normalization import RunningStatistics
from mjx_balance.envs.balance import BalanceEnv
from mjx_balance.training.sizing import check_network


class Plain(nn.Module):
    """The same layers as `QNetwork((16,), (2,))`, without its methods."""

    size: int = 2

    @nn.compact
    def __call__(self, obs: jax.Array) -> jax.Array:
        x = nn.relu(nn.Dense(16, name="hidden_0")(obs))
        return nn.Dense(self.size, name="head")(x)


def dqn_of(network: Any, loss: Any = None, **changes: Any) -> DQN:
    config = dataclasses.replace(probes.CONFIG, **changes)
    spec = DQNSpec(config, num_envs=8, num_env_steps=320)
    return DQN(probes.NoTimeLimit(), network, spec, loss)


def leaves(dqn: DQN) -> list[np.ndarray]:
    state, _ = dqn.train_program(40)(dqn.init(0))
    return [np.asarray(x) for x in jax.tree.leaves((state.params, state.target_params))]


def test_a_network_of_ones_own_learns_as_ours_does() -> None:
    """Action values alone are enough: equal layers end with equal weights."""
    ours, own = leaves(dqn_of(QNetwork((16,), (2,)))), leaves(dqn_of(Plain()))
    for left, right in zip(ours, own, strict=True):
        np.testing.assert_allclose(left, right, rtol=1e-5, atol=1e-6)


def test_observations_are_whitened_for_a_network_that_cannot_fold_it() -> None:
    rng = np.random.default_rng(0)
    ours, own = (dqn_of(network, whiten_steps=800) for network in (QNetwork((16,), (2,)), Plain()))
    params = ours.network.init(jax.random.PRNGKey(0), jnp.zeros(3))
    statistics = RunningStatistics(
        jnp.asarray(rng.normal(size=3), jnp.float32),
        jnp.eye(3),
        jnp.float32(4),
        jnp.asarray(rng.normal(size=(3, 3)), jnp.float32),
    )
    obs = jnp.asarray(rng.normal(size=(5, 3)), jnp.float32)
    folded, whitened = ours.fold(params, statistics), own.fold(params, statistics)
    assert isinstance(whitened, Whitened)
    values = [x.head(y, obs).q_values() for x, y in ((ours, folded), (own, whitened))]
    np.testing.assert_allclose(*values, rtol=1e-4, atol=1e-4)
    assert np.abs(values[0] - ours.head(params, obs).q_values()).max() > 0.01


def test_a_loss_of_ones_own_replaces_the_squared_error() -> None:
    """The squared TD error gives the default's bits; half of it does not."""
    network = Plain()
    default, same, half = (
        leaves(dqn_of(network, loss, max_grad_norm=1e-3))
        for loss in (
            None,
            lambda *terms: td_error(*terms) ** 2,
            lambda q_tm1, a_tm1, *rest: q_tm1.q_value(a_tm1) ** 2,
        )
    )
    assert all(np.array_equal(x, y) for x, y in zip(default, same, strict=True))
    assert not all(np.array_equal(x, y) for x, y in zip(default, half, strict=True))


GRID = preset("smoke").replace(engine="mujoco")


class Headless(Plain):
    """Fails whatever it sees."""

    def __call__(self, obs: jax.Array) -> jax.Array:
        raise RuntimeError("not today")


@pytest.fixture(scope="module")
def env() -> BalanceEnv:
    return BalanceEnv(GRID)


@pytest.mark.parametrize(
    ("network", "changes", "sentence"),
    [
        (Plain(440), {}, r"network Plain gives values of shape \(440,\) for .* be \(441,\), one"),
        (Headless(), {}, r"network Headless fails for an observation of shape \(34,\): not today"),
        (Plain(441), {"action": "continuous"}, "action is 'continuous', .* set action to 'grid'"),
        (Plain(441), {"zero_at_rest": True}, "zero_at_rest is True, .* a method `fold_rest`"),
        (Plain(441), {"export": "best"}, "export is 'best', but network Plain is your own"),
        (object(), {}, "network object fails for an observation"),
    ],
)
def test_a_network_that_does_not_fit_is_refused(
    network: Any, changes: dict[str, Any], sentence: str, env: BalanceEnv
) -> None:
    with pytest.raises(ValueError, match=sentence):
        check_network(network, GRID.replace(**changes), env)


def test_networks_that_fit_pass(env: BalanceEnv) -> None:
    check_network(Plain(441), GRID, env)
    radial = GRID.replace(action="continuous")
    check_network(QNetwork((8,), (21, 21), radial=True), radial, env)
