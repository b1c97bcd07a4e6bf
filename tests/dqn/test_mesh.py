"""The same learning on meshes of one, two and four devices, in a process that has four."""

from collections.abc import Iterator
from concurrent.futures import Executor, ProcessPoolExecutor
from multiprocessing import get_context
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

DEVICES = 4
UPDATES = 50


def have_devices() -> None:
    jax.config.update("jax_num_cpu_devices", DEVICES)


@pytest.fixture(scope="module")
def elsewhere() -> Iterator[Executor]:
    """A process of its own: how many devices there are is settled once per process."""
    with ProcessPoolExecutor(1, get_context("spawn"), have_devices) as pool:
        yield pool


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


def walked(devices: int) -> Any:
    """What 64 envs that act at random stored, (devices, decisions, envs of each, ...)."""
    config = DQNConfig(replay_capacity=512, epsilon_start=1.0, epsilon_end=1.0, hidden_sizes=(4,))
    spec = DQNSpec(config, 64, 512, devices=jax.devices()[:devices])
    dqn = DQN(probes.Walk(), QNetwork((4,), (2,)), spec)
    state, _ = dqn.train_program(8)(dqn.init(0))
    data = jax.device_get(state.replay.data)
    return jax.tree.map(lambda x: x.reshape(devices, 8, 64 // devices, *x.shape[1:]), data)


def test_a_batch_makes_the_same_updates_however_many_devices_share_it(elsewhere: Executor) -> None:
    """What differs is the order of sums: by 1e-6 of the size after 50 updates."""
    alone, *others = elsewhere.map(learnt, (1, 2, DEVICES))
    assert max(np.abs(leaf).max() for leaf in alone) > 0.1
    for shared in others:
        for theirs, ours in zip(shared, alone, strict=True):
            np.testing.assert_allclose(theirs, ours, rtol=0, atol=1e-6 * np.abs(ours).max())


@pytest.mark.parametrize("devices", [2, DEVICES])
def test_devices_draw_other_keys_and_store_other_envs(elsewhere: Executor, devices: int) -> None:
    """Every walk has a number: no device knows one of another's, and no two envs act alike."""
    data = elsewhere.submit(walked, devices).result()
    walks = [set(np.ravel(own[..., 0])) for own in data.obs]
    assert all(len(own) > 64 // devices for own in walks)
    assert len(set().union(*walks)) == sum(map(len, walks))
    by_env = np.moveaxis(data.action, 1, 2).reshape(64, 8)
    assert len(np.unique(by_env, axis=0)) > 50
