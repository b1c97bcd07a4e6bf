"""The same learning on meshes of one and two devices."""

from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from fixtures import probes
from jax.sharding import PartitionSpec

from mjx_balance.config import DQNConfig
from mjx_balance.dqn import DQN, DQNSpec, QNetwork, normalization
from mjx_balance.dqn.dqn import UpdateState, make_optimizer
from mjx_balance.dqn.mesh import AXIS, REPLICATED, on_each_device
from mjx_balance.dqn.replay import Transition

UPDATES = 50


def learnt(devices: int) -> list[np.ndarray]:
    """Parameters after updates on one global batch each, shared out over so many devices."""
    config = DQNConfig(
        batch_size=8, replay_ratio=1, learning_rate=1e-2, target_update_period=7, gamma=0.5
    )
    network = QNetwork((8,), (3,))
    spec = DQNSpec(config, 8, 8 * UPDATES, devices=jax.devices()[:devices])
    dqn = DQN(probes.OneStep(), network, spec)
    rng = np.random.default_rng(0)
    obs, next_obs = jnp.asarray(rng.normal(size=(2, UPDATES, 8, 4)), jnp.float32)
    action = jnp.asarray(rng.integers(3, size=(UPDATES, 8)))
    reward = jnp.asarray(rng.normal(size=(UPDATES, 8)), jnp.float32)
    rows = Transition(obs, action, reward, jnp.zeros((UPDATES, 8)), next_obs)
    params = network.init(jax.random.PRNGKey(0), obs[0, 0])
    optimizer = make_optimizer(config, spec.total_updates)
    start = UpdateState(params, params, optimizer.init(params), jnp.int32(0))
    statistics = normalization.init(4, 1.0)

    def step(state: UpdateState, share: Transition) -> tuple[UpdateState, None]:
        return dqn.update(state, share, statistics, config)[0], None

    def program(shares: Transition) -> Any:
        return jax.lax.scan(step, start, shares)[0].params

    sharded = PartitionSpec(None, AXIS)
    shared = on_each_device(program, dqn.mesh, sharded, REPLICATED)
    return jax.tree.leaves(jax.device_get(jax.jit(shared)(rows)))


@pytest.mark.slow
def test_a_batch_makes_the_same_updates_on_one_device_and_on_two() -> None:
    """Only the order of sums differs: by 1e-6 of the size after 50 updates."""
    one = learnt(1)
    assert max(np.abs(leaf).max() for leaf in one) > 0.1
    for alone, shared in zip(one, learnt(2), strict=True):
        np.testing.assert_allclose(shared, alone, rtol=0, atol=1e-6 * np.abs(alone).max())
