"""What a run computes on: sizes that fit the devices, and a state that fits the memory."""

import dataclasses
import types
from pathlib import Path
from typing import Any
from unittest import mock

import jax
import jax.numpy as jnp
import psutil
import pytest
from jax.sharding import PartitionSpec

from mjx_balance.config import ConfigError, preset
from mjx_balance.dqn import DQNSpec
from mjx_balance.dqn.mesh import AXIS, REPLICATED
from mjx_balance.envs.balance import BalanceEnv
from mjx_balance.training import program_cache, run, sizing
from mjx_balance.training.processes import Processes
from mjx_balance.training.sizing import check_memory, explained, make_learner, size_to_device

CONFIG = preset("default")


def with_batch(size: int, **changes: Any):
    """One gradient step per decision of an env: a whole number, whatever their number."""
    own = {name: changes.pop(name) for name in list(changes) if hasattr(CONFIG.dqn, name)}
    dqn = dataclasses.replace(CONFIG.dqn, batch_size=size, replay_ratio=float(size), **own)
    return dataclasses.replace(CONFIG, dqn=dqn, **changes)


def test_a_cpu_gets_256_envs_over_both_cores_whatever_is_measured(
    monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> None:
    monkeypatch.setenv("MJX_BALANCE_CACHE", str(tmp_path))
    sizing.remember_envs("mjx", {8_192: 1.0})
    sized = size_to_device(CONFIG)
    assert (sized.num_envs, sized.num_devices) == (256, 2)
    assert dataclasses.replace(sized, num_envs=None, num_devices=None) == CONFIG


@pytest.fixture
def on_h100(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    """One GPU that nobody has measured."""
    device = types.SimpleNamespace(platform="gpu", device_kind="NVIDIA H100")
    monkeypatch.setattr(jax, "devices", lambda: [device])
    monkeypatch.setenv("MJX_BALANCE_CACHE", str(tmp_path))


@pytest.mark.usefixtures("on_h100")
def test_an_accelerator_gets_2048_envs_and_eight_times_of_what_is_counted_in_them() -> None:
    """The replay ratio, the updates of a run and the decisions of an env are the laptop's."""
    sized = size_to_device(CONFIG)
    assert (sized.num_envs, sized.num_devices) == (2048, 1)
    assert (sized.num_env_steps, sized.log_every, sized.eval_every) == (320_000, 8_192, 160_000)
    dqn = sized.dqn
    assert (dqn.batch_size, dqn.replay_capacity, dqn.min_replay_size) == (2048, 1_048_576, 8_192)
    assert (dqn.epsilon_decay_steps, dqn.whiten_steps) == (40_000, 400_000)
    assert dqn.updates_per_step(2048) == CONFIG.dqn.updates_per_step(256) == 32
    same = dataclasses.replace(
        sized,
        **{name: getattr(CONFIG, name) for name in (*sizing.COUNTED_IN_ENVS, "num_devices")},
        num_envs=None,
        dqn=CONFIG.dqn,
    )
    assert same == CONFIG, "nothing else"
    assert sizing.describe_growth(CONFIG, sized) == (
        "with num_envs 2,048 come num_env_steps 320,000, log_every 8,192, eval_every 160,000, "
        "batch_size 2,048, replay_capacity 1,048,576, min_replay_size 8,192, "
        "epsilon_decay_steps 40,000, whiten_steps 400,000; what you say stays"
    )


@pytest.mark.usefixtures("on_h100")
def test_what_the_user_says_is_not_grown() -> None:
    dqn = dataclasses.replace(CONFIG.dqn, batch_size=1_024, epsilon_decay_steps=7_000)
    said = dataclasses.replace(CONFIG, num_env_steps=50_000, dqn=dqn)
    sized = size_to_device(said)
    assert (sized.num_env_steps, sized.log_every) == (50_000, 8_192)
    assert (sized.dqn.batch_size, sized.dqn.epsilon_decay_steps) == (1_024, 7_000)
    assert sized.dqn.updates_per_step(2048) == 64
    with_envs = dataclasses.replace(CONFIG, num_envs=2_048)
    assert size_to_device(with_envs) == dataclasses.replace(with_envs, num_devices=1)
    assert sizing.describe_growth(with_envs, size_to_device(with_envs)) == ""


@pytest.mark.usefixtures("on_h100")
def test_a_measured_device_gets_the_fewest_envs_that_come_near_the_best() -> None:
    """Of the engine that was measured; what is damaged counts as nothing."""
    rates = {256: 0.5e6, 1_024: 1.9e6, 4_096: 4.5e6, 8_192: 4.9e6, 32_768: 5.0e6}
    assert sizing.remember_envs("mjx", rates) == 4_096
    assert sizing.remember_envs("warp", {256: 1e6}) == 256
    assert size_to_device(CONFIG).num_envs == 4_096
    assert size_to_device(dataclasses.replace(CONFIG, engine="warp")).num_envs == 256
    for text in ("{", "[]", '{"NVIDIA H100, engine mjx": "many"}'):
        (program_cache.cache_dir() / "sizes.json").write_text(text)
        assert size_to_device(CONFIG).num_envs == 2_048
        assert sizing.remember_envs("warp", {1_024: 1e6}) == 1_024
        assert size_to_device(dataclasses.replace(CONFIG, engine="warp")).num_envs == 1_024


@pytest.mark.parametrize(
    ("engine", "platform", "sentence"),
    [
        ("mujoco", "gpu", "runs on CPUs, and JAX uses this device; set JAX_PLATFORMS=cpu, or "),
        ("warp", "tpu", "runs on NVIDIA GPUs and CPUs, and JAX uses this device; choose"),
    ],
)
def test_an_engine_is_refused_where_it_does_not_run(
    engine: Any, platform: str, sentence: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    device = types.SimpleNamespace(platform=platform, device_kind="this device")
    monkeypatch.setattr(jax, "devices", lambda: [device])
    with pytest.raises(ConfigError, match=f"engine is {engine}, which {sentence}"):
        size_to_device(dataclasses.replace(CONFIG, engine=engine))


@pytest.mark.parametrize(
    ("num_envs", "batch_size", "available", "expected"),
    [(64, 512, 8, 8), (60, 512, 8, 4), (64, 510, 8, 2), (63, 512, 8, 1), (6, 9, 4, 3)],
)
def test_as_many_devices_as_share_evenly(
    num_envs: int, batch_size: int, available: int, expected: int, monkeypatch: pytest.MonkeyPatch
) -> None:
    cpus = [types.SimpleNamespace(platform="cpu", device_kind="cpu")] * available
    monkeypatch.setattr(jax, "devices", lambda: cpus)
    sized = size_to_device(with_batch(batch_size, num_envs=num_envs))
    assert sized.num_devices == expected
    one = with_batch(batch_size, num_envs=num_envs, num_devices=1)
    assert size_to_device(one) == one, "what is given stays"


def test_every_process_has_as_many_devices(monkeypatch: pytest.MonkeyPatch) -> None:
    """Of 6 devices of two processes, 5 would share 50 envs evenly."""
    cpus = [types.SimpleNamespace(platform="cpu", device_kind="cpu")] * 6
    monkeypatch.setattr(jax, "devices", lambda: cpus)
    monkeypatch.setattr(jax, "process_count", lambda: 2)
    assert size_to_device(with_batch(50, num_envs=50)).num_devices == 2
    assert size_to_device(with_batch(48, num_envs=48)).num_devices == 6
    with pytest.raises(ConfigError, match="num_devices is 3; it must be a multiple of num_proc"):
        size_to_device(with_batch(48, num_envs=48, num_devices=3))


@pytest.mark.parametrize(
    ("config", "sentence"),
    [
        (
            with_batch(256, replay_capacity=255, min_replay_size=10),
            "replay_capacity is 255; it must hold at least one",
        ),
        (with_batch(512, num_devices=3), "num_devices is 3; this machine has 2 JAX devices"),
        (with_batch(511, num_devices=2), "batch_size is 511; it must be a multiple of num_dev"),
        (with_batch(512, num_devices=2, num_envs=9), "num_envs is 9; it must be a multiple of"),
    ],
)
def test_impossible_sizes_are_refused(config: Any, sentence: str) -> None:
    with pytest.raises(ConfigError, match=sentence):
        size_to_device(config)


@pytest.mark.parametrize(
    ("head", "factors"), [("joint", (441,)), ("factored", (21, 21)), ("radial", (21, 21))]
)
def test_the_learner_is_the_configs(head: Any, factors: tuple[int, ...]) -> None:
    sizes = {"num_envs": 32, "num_devices": 1, "num_env_steps": 320, "num_seeds": 3}
    task = dataclasses.replace(CONFIG.task, action="continuous" if head == "radial" else "grid")
    config = with_batch(16, head=head, hidden_sizes=(8, 4), task=task, **sizes)
    env = BalanceEnv(config)
    learner = make_learner(config, env)
    network = learner.network
    assert (network.hidden_sizes, network.factors) == ((8, 4), factors)
    assert network.radial == (head == "radial")
    spec = learner.spec
    assert (learner.env, spec.config) == (env, config.dqn)
    assert (spec.num_envs, len(spec.devices), spec.num_seeds) == (32, 1, 3)
    assert spec.action_factors == (21, 21)
    assert spec.symmetries is not None
    assert spec.first_reset == env.reset_staggered
    # 10 decisions of 32 envs, each transition replayed 16 times in batches of 16.
    assert spec.total_updates == 320
    assert spec.sweep == {}


def test_the_learner_gets_the_sweep() -> None:
    config = with_batch(
        512, num_envs=32, num_devices=1, num_seeds=2, sweep=("gamma=0,0.5", "huber_delta=1,2")
    )
    spec = make_learner(config, BalanceEnv(config)).spec
    assert spec.num_seeds == 8
    assert spec.sweep == {
        "gamma": [0, 0, 0, 0, 0.5, 0.5, 0.5, 0.5],
        "huber_delta": [1, 1, 2, 2, 1, 1, 2, 2],
    }


MIB = 2**20


class Learner:
    """8 MiB that every device has, and 4 MiB shared out; 2 runs of 64 envs."""

    def __init__(self, *devices: Any) -> None:
        dqn = dataclasses.replace(CONFIG.dqn, mirror=False)
        self.spec = DQNSpec(dqn, 64, 64, devices, num_seeds=2)
        self.state_specs = {"parameters": REPLICATED, "replay": PartitionSpec(None, AXIS)}

    def init(self, seed: int) -> Any:
        rows = {"a": jnp.zeros((MIB // 2,), jnp.float32), "b": jnp.zeros((2 * MIB,), jnp.int8)}
        return {"parameters": jnp.zeros(2 * MIB), "replay": rows}


def cpu(process_index: int = 0) -> Any:
    return types.SimpleNamespace(platform="cpu", process_index=process_index)


def gpu(limit: int | None) -> Any:
    stats = None if limit is None else {"bytes_limit": limit, "bytes_in_use": 7 * MIB}
    return types.SimpleNamespace(platform="gpu", memory_stats=lambda: stats)


@pytest.fixture
def needs(monkeypatch: pytest.MonkeyPatch) -> None:
    """100 MiB of libraries, and 1 MiB per env and device."""
    monkeypatch.setattr(sizing, "PROGRAM_BYTES", 100 * MIB)
    monkeypatch.setattr(sizing, "ENV_BYTES", MIB)


def test_a_run_of_many_envs_takes_gibibytes(monkeypatch: pytest.MonkeyPatch) -> None:
    """1.3 GiB of libraries, 2 runs of 64 envs at 40 kB, and 24 MiB of state."""
    needed = 1.3 * 2**30 + 2 * 64 * 40_000 + 24 * MIB
    free = [needed]
    memory = lambda: types.SimpleNamespace(available=free[0])  # noqa: E731
    monkeypatch.setattr(psutil, "virtual_memory", memory)
    learner: Any = Learner(cpu())
    check_memory(learner)
    free[0] -= 1
    with pytest.raises(ConfigError, match=r"take about 1\.3 GiB of this machine"):
        check_memory(learner)


@pytest.mark.usefixtures("needs")
@pytest.mark.parametrize(
    ("mesh", "least"),
    [
        ((cpu(),), 100 + 2 * (8 + 4) + 128),
        ((cpu(), cpu()), 100 + 2 * 2 * (8 + 2) + 128),
        ((cpu(), cpu(1)), 100 + 2 * (8 + 2) + 64),
    ],
    ids=("one device", "two", "two of which one is another process's"),
)
def test_a_machine_must_hold_twice_what_its_own_devices_have(
    mesh: Any, least: int, monkeypatch: pytest.MonkeyPatch
) -> None:
    free = [least * MIB]
    memory = lambda: types.SimpleNamespace(available=free[0])  # noqa: E731
    monkeypatch.setattr(psutil, "virtual_memory", memory)
    learner: Any = Learner(*mesh)
    check_memory(learner)
    free[0] -= 1
    with pytest.raises(ConfigError) as refused:
        check_memory(learner)
    assert str(refused.value) == (
        "2 runs with num_envs 64 and replay_capacity 131072 take about "
        f"{least / 1024:.1f} GiB of this machine, and {least / 1024:.1f} GiB are free; lower "
        "num_envs, replay_capacity or the number of runs"
    )


@pytest.mark.usefixtures("needs")
def test_every_accelerator_takes_its_share_of_what_is_free() -> None:
    least = 100 + 2 * (8 + 2) + 64 + 7
    fits: Any = Learner(gpu(least * MIB), gpu(least * MIB))
    check_memory(fits)
    too_much: Any = Learner(gpu(least * MIB - 1), gpu(least * MIB - 1))
    with pytest.raises(ConfigError, match=r"take about 0\.2 GiB of each device, and 0\.2 GiB are"):
        check_memory(too_much)
    unknown: Any = Learner(gpu(None))
    check_memory(unknown)


@pytest.mark.usefixtures("on_h100")
def test_envs_that_nobody_asked_for_are_halved_until_they_fit(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    """2,048 for 64 runs are too many here; 512 that somebody asked for are refused."""

    def check(learner: Any) -> None:
        if learner.spec.num_envs > 300:
            raise ConfigError("too much")

    with_spec = lambda config, *_: types.SimpleNamespace(spec=config)  # noqa: E731
    monkeypatch.setattr(sizing, "make_learner", with_spec)
    monkeypatch.setattr(sizing, "check_memory", check)
    sized, *_ = run._set_up(CONFIG, None, None)
    assert (sized.num_envs, sized.num_env_steps, sized.dqn.batch_size) == (256, 40_000, 256)
    with pytest.raises(ConfigError, match="too much"):
        run._set_up(dataclasses.replace(CONFIG, num_envs=512), None, None)
    monkeypatch.setattr(sizing, "CPU_ENVS", 512)
    with pytest.raises(ConfigError, match="too much"):
        run._set_up(CONFIG, None, None)


def test_errors_of_a_running_program_are_explained_where_they_can_be() -> None:
    with pytest.raises(jax.errors.JaxRuntimeError) as caught:
        jax.block_until_ready(jnp.zeros((2**22, 2**22), jnp.float32))
    assert explained(caught.value) == (
        "the device has no memory left; lower num_envs, num_seeds or replay_capacity"
    )
    full = "INTERNAL: CpuCallback error: Traceback\n  x.py\nmine.WarpOverflowError: a buffer\n--"
    assert explained(jax.errors.JaxRuntimeError(full)) == "a buffer"
    assert explained(jax.errors.JaxRuntimeError("INTERNAL: something else")) is None


def test_a_resumed_run_has_its_devices_where_there_are_fewer_cores(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    """Of every process its share; a new run has one for each core, whatever it asks for."""
    monkeypatch.setattr(run, "cores", lambda: 2)
    config, here = dataclasses.replace(CONFIG, num_devices=8), Path("run")
    assert run._num_cores(config, here, Processes()) == 8
    assert run._num_cores(config, None, Processes()) == 2
    assert run._num_cores(dataclasses.replace(config, num_devices=1), here, Processes()) == 2
    assert run._num_cores(config, here, Processes(index=1, count=4, cores=1)) == 2
    assert run._num_cores(config, here, Processes(index=1, count=4, cores=3)) == 3


@pytest.mark.parametrize(
    ("error", "reason"),
    [(AssertionError(), ""), (RuntimeError("no\x1b[2J\n" + 500 * "x"), " (no?[2J xxx")],
)
def test_a_platform_that_is_not_there_is_named(
    error: Exception, reason: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    """JAX raises either, depending on the name."""
    monkeypatch.setattr(jax, "process_count", mock.Mock(side_effect=error))
    monkeypatch.setattr(sizing, "enable_compilation_cache", lambda log_fn: None)
    with pytest.raises(ConfigError) as refused:
        sizing.configure_jax(lambda line: None)
    said = str(refused.value)
    assert f", and JAX finds no such device{reason}" in said
    assert said.endswith("; set JAX_PLATFORMS=cpu, or unset it")
    assert len(said) < 300
