"""What a run computes on: sizes that fit the devices, and a state that fits the memory."""

import dataclasses
import types
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import psutil
import pytest

from mjx_balance.config import ConfigError, preset
from mjx_balance.env import BalanceEnv
from mjx_balance.training import devices
from mjx_balance.training.devices import check_memory, explained, make_learner, size_to_device

CONFIG = preset("default")


def with_batch(size: int, **changes: Any):
    """One gradient step per decision of an env: a whole number, whatever their number."""
    dqn = dataclasses.replace(CONFIG.dqn, batch_size=size, replay_ratio=float(size))
    return dataclasses.replace(CONFIG, dqn=dqn, **changes)


def test_a_cpu_gets_256_envs_over_both_cores() -> None:
    sized = size_to_device(CONFIG)
    assert (sized.num_envs, sized.num_devices) == (256, 2)
    assert dataclasses.replace(sized, num_envs=None, num_devices=None) == CONFIG


def test_an_accelerator_gets_2048(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(jax, "devices", lambda: [types.SimpleNamespace(platform="gpu")])
    sized = size_to_device(CONFIG)
    assert (sized.num_envs, sized.num_devices) == (2048, 1)


def test_the_c_engine_is_refused_where_jax_has_no_cpu(monkeypatch: pytest.MonkeyPatch) -> None:
    gpu = types.SimpleNamespace(platform="gpu", device_kind="NVIDIA H100")
    monkeypatch.setattr(jax, "devices", lambda: [gpu])
    said = "engine is mujoco, which runs on CPUs, and JAX uses NVIDIA H100; set JAX_PLATFORMS=cpu"
    with pytest.raises(ConfigError, match=said):
        size_to_device(dataclasses.replace(CONFIG, engine="mujoco"))


def test_warp_is_refused_where_it_has_no_kernels(monkeypatch: pytest.MonkeyPatch) -> None:
    tpu = types.SimpleNamespace(platform="tpu", device_kind="TPU v6e")
    monkeypatch.setattr(jax, "devices", lambda: [tpu])
    said = "engine is warp, which runs on NVIDIA GPUs and CPUs, and JAX uses TPU v6e; choose"
    with pytest.raises(ConfigError, match=said):
        size_to_device(dataclasses.replace(CONFIG, engine="warp"))


@pytest.mark.parametrize(
    ("num_envs", "batch_size", "available", "expected"),
    [(64, 512, 8, 8), (60, 512, 8, 4), (64, 510, 8, 2), (63, 512, 8, 1), (6, 9, 4, 3)],
)
def test_as_many_devices_as_share_evenly(
    num_envs: int, batch_size: int, available: int, expected: int, monkeypatch: pytest.MonkeyPatch
) -> None:
    cpus = [types.SimpleNamespace(platform="cpu")] * available
    monkeypatch.setattr(jax, "devices", lambda: cpus)
    sized = size_to_device(with_batch(batch_size, num_envs=num_envs))
    assert sized.num_devices == expected


@pytest.mark.parametrize(
    ("config", "said"),
    [
        (with_batch(512, num_devices=3), "num_devices is 3; this machine has 2 JAX devices"),
        (with_batch(511, num_devices=2), "batch_size is 511; it must be a multiple of num_dev"),
        (with_batch(512, num_devices=2, num_envs=9), "num_envs is 9; it must be a multiple of"),
    ],
)
def test_what_cannot_be_shared_is_refused(config: Any, said: str) -> None:
    with pytest.raises(ConfigError, match=said):
        size_to_device(config)


def test_sizes_that_are_given_stay() -> None:
    given = with_batch(512, num_envs=32, num_devices=1)
    assert size_to_device(given) == given


def test_a_replay_smaller_than_one_decision_of_all_envs_is_refused() -> None:
    dqn = dataclasses.replace(CONFIG.dqn, replay_capacity=255, min_replay_size=10)
    with pytest.raises(ConfigError, match="replay_capacity is 255; it must hold at least one"):
        size_to_device(dataclasses.replace(CONFIG, dqn=dqn))


@pytest.mark.parametrize(
    ("head", "factors"), [("joint", (441,)), ("factored", (21, 21)), ("radial", (21, 21))]
)
def test_the_learner_is_the_configs(head: Any, factors: tuple[int, ...]) -> None:
    dqn = dataclasses.replace(CONFIG.dqn, head=head, hidden_sizes=(8, 4), replay_ratio=512.0)
    config = dataclasses.replace(
        CONFIG, num_envs=32, num_devices=1, num_env_steps=320, num_seeds=3, dqn=dqn
    )
    env = BalanceEnv(config)
    learner = make_learner(config, env)
    network = learner.network
    assert (network.hidden_sizes, network.factors) == ((8, 4), factors)
    assert network.radial == (head == "radial")
    assert (learner.env, learner.config) == (env, dqn)
    assert (learner.num_envs, learner.num_devices, learner.num_seeds) == (32, 1, 3)
    assert learner.action_factors == (21, 21)
    assert learner.symmetries is not None
    assert learner.first_reset == env.reset_staggered
    # 10 decisions of 32 envs, each transition replayed 512 times in batches of 256.
    assert learner.total_updates == 640
    assert learner.sweep == {}


def test_a_sweep_is_told_to_the_learner() -> None:
    config = with_batch(
        512, num_envs=32, num_devices=1, num_seeds=2, sweep=("gamma=0,0.5", "huber_delta=1,2")
    )
    learner = make_learner(config, BalanceEnv(config))
    assert learner.num_seeds == 8
    assert {name: values.tolist() for name, values in learner.sweep.items()} == {
        "gamma": [0, 0, 0, 0, 0.5, 0.5, 0.5, 0.5],
        "huber_delta": [1, 1, 2, 2, 1, 1, 2, 2],
    }


MIB = 2**20


class Learner:
    """With a state of 3 MiB on a device of some kind."""

    num_seeds, num_envs = 2, 64
    config = CONFIG.dqn

    def __init__(self, device: Any, num_devices: int = 1) -> None:
        self.mesh = types.SimpleNamespace(devices=np.asarray([device] * num_devices))
        self.num_devices = num_devices

    def init(self, seed: int) -> Any:
        return {"a": jnp.zeros((MIB // 2,), jnp.float32), "b": jnp.zeros((MIB,), jnp.int8)}


def cpu() -> Any:
    return types.SimpleNamespace(platform="cpu")


def gpu(limit: int | None) -> Any:
    stats = None if limit is None else {"bytes_limit": limit}
    return types.SimpleNamespace(platform="gpu", memory_stats=lambda: stats)


def needs(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(devices, "PROGRAM_BYTES", 100 * MIB)


def test_a_state_must_fit_twice_beside_the_program(monkeypatch: pytest.MonkeyPatch) -> None:
    needs(monkeypatch)
    free = [106 * MIB]
    memory = lambda: types.SimpleNamespace(available=free[0])  # noqa: E731
    monkeypatch.setattr(psutil, "virtual_memory", memory)
    learner: Any = Learner(cpu())
    check_memory(learner)
    free[0] -= 1
    with pytest.raises(ConfigError, match="num_seeds is 2, num_envs 64 and replay_capacity 131072"):
        check_memory(learner)


def test_every_accelerator_takes_its_share(monkeypatch: pytest.MonkeyPatch) -> None:
    needs(monkeypatch)
    fits: Any = Learner(gpu(53 * MIB), num_devices=2)
    check_memory(fits)
    too_much: Any = Learner(gpu(52 * MIB), num_devices=2)
    with pytest.raises(ConfigError, match=r"takes about 0\.1 GiB, and 0\.1 GiB are free"):
        check_memory(too_much)
    unknown: Any = Learner(gpu(None))
    check_memory(unknown)


def test_errors_of_a_running_program_are_explained_where_they_can_be() -> None:
    made = jax.errors.JaxRuntimeError
    memory = made("RESOURCE_EXHAUSTED: Out of memory while trying to allocate 94371840000 bytes.")
    assert explained(memory) == (
        "the device has no memory left; lower num_envs, num_seeds or replay_capacity"
    )
    full = made(
        "INTERNAL: CpuCallback error: Traceback\n  x.py\nmine.WarpOverflowError: a buffer\n--"
    )
    assert explained(full) == "a buffer"
    assert explained(made("INTERNAL: something else")) is None


def test_an_allocation_that_no_memory_takes_is_explained() -> None:
    with pytest.raises(jax.errors.JaxRuntimeError) as caught:
        jax.block_until_ready(jnp.zeros((2**22, 2**22), jnp.float32))
    assert "no memory left" in (explained(caught.value) or "")
