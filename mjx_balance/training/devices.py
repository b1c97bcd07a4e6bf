"""What a run computes on: one process, its JAX devices, their memory, the learner over them."""

import contextlib
import dataclasses
import math
from typing import Any

import jax
import psutil

from mjx_balance.config import Config, ConfigError, check, combinations, members
from mjx_balance.dqn.learner import Learner
from mjx_balance.dqn.networks import QNetwork
from mjx_balance.engines.mujoco import cores
from mjx_balance.env import BalanceEnv
from mjx_balance.policy import network_branches
from mjx_balance.training.program_cache import Say, enable_compilation_cache

STATE_COPIES = 2
"""A checkpoint is read back beside the state that it replaces."""
PROGRAM_BYTES = 1.3 * 2**30
"""Memory of a run besides its state: libraries, compiler, program (benchmarks/README.md)."""
CPU_ENVS = 256
ACCELERATOR_ENVS = 2048


def configure_jax(say: Say) -> None:
    """Makes every CPU core of this process a JAX device and turns the compilation cache on."""
    # Too late if JAX is already in use, as in a notebook: its devices do as they are.
    with contextlib.suppress(RuntimeError):
        jax.config.update("jax_num_cpu_devices", cores())
    enable_compilation_cache(say)


def size_to_device(config: Config) -> Config:
    """Fills in what the config leaves to the device.

    Raises:
      ConfigError: if the envs cannot be spread over that many devices.
    """
    available = jax.devices()
    on_cpu = available[0].platform == "cpu"
    if config.engine == "mujoco" and not on_cpu:
        raise ConfigError(
            f"engine is mujoco, which runs on CPUs, and JAX uses {available[0].device_kind}; set "
            "JAX_PLATFORMS=cpu, or choose engine mjx"
        )
    if config.engine == "warp" and available[0].platform not in ("cpu", "gpu", "cuda"):
        raise ConfigError(
            f"engine is warp, which runs on NVIDIA GPUs and CPUs, and JAX uses "
            f"{available[0].device_kind}; choose engine mjx"
        )
    num_envs, batch_size = config.num_envs, config.dqn.batch_size
    if num_envs is None:
        num_envs = CPU_ENVS if on_cpu else ACCELERATOR_ENVS
    num_devices, processes = config.num_devices, jax.process_count()
    if num_devices is None:
        num_devices = _even_share(len(available), processes, num_envs, batch_size)
    elif num_devices > len(available):
        raise ConfigError(
            f"num_devices is {num_devices}; this machine has {len(available)} JAX devices"
        )
    if num_devices % processes:
        raise ConfigError(
            f"num_devices is {num_devices}; it must be a multiple of num_processes, {processes}"
        )
    for name, value in (("num_envs", num_envs), ("batch_size", batch_size)):
        if value % num_devices:
            raise ConfigError(
                f"{name} is {value}; it must be a multiple of num_devices, {num_devices}"
            )
    sized = dataclasses.replace(config, num_envs=num_envs, num_devices=num_devices)
    return check(sized)


def _even_share(available: int, processes: int, *counts: int) -> int:
    """As many devices as share each of the counts out evenly, the same number in each process."""
    possible = range(available - available % processes, processes, -processes)
    return next((n for n in possible if not any(count % n for count in counts)), processes)


def used_devices(num_devices: int) -> list[Any]:
    """The devices of a run's mesh, the same number of every process, in their order.

    Raises:
      ConfigError: if one has fewer.
    """
    each, found = num_devices // jax.process_count(), []
    for k in range(jax.process_count()):
        own = jax.local_devices(process_index=k)
        if len(own) < each:
            raise ConfigError(
                f"num_devices is {num_devices}, {each} per process; process {k} has {len(own)}"
            )
        found += own[:each]
    return found


def make_learner(config: Config, env: BalanceEnv) -> Learner:
    """The DQN for a config that `size_to_device` has completed."""
    assert config.num_envs is not None
    assert config.num_devices is not None
    runs = members(config)
    swept = combinations(config)[0]
    return Learner(
        env,
        QNetwork(config.dqn.hidden_sizes, network_branches(config), config.dqn.head == "radial"),
        config.dqn,
        config.num_envs,
        config.num_env_steps,
        used_devices(config.num_devices),
        len(runs),
        env.symmetries,
        env.action_factors,
        env.reset_staggered,
        {name: [getattr(own.dqn, name) for own in runs] for name in swept},
    )


def check_memory(learner: Learner) -> None:
    """Refuses a state that would not fit, before anything is allocated.

    Raises:
      ConfigError: with the estimate.
    """
    shapes = jax.eval_shape(lambda: learner.init(0))
    state = sum(x.size * x.dtype.itemsize for x in jax.tree.leaves(shapes))
    needed = STATE_COPIES * state + PROGRAM_BYTES
    device = learner.mesh.devices.ravel()[0]
    if device.platform == "cpu":
        available = psutil.virtual_memory().available
    else:
        needed /= learner.num_devices
        available = (device.memory_stats() or {}).get("bytes_limit", math.inf)
    if needed > available:
        raise ConfigError(
            f"num_seeds is {learner.num_seeds}, num_envs {learner.num_envs} and replay_capacity "
            f"{learner.config.replay_capacity}: that takes about {needed / 2**30:.1f} GiB, and "
            f"{available / 2**30:.1f} GiB are free; lower one of them"
        )


def explained(error: Exception) -> str | None:
    """What the user can do about an error of a running program, in a sentence; none if unknown."""
    said = str(error)
    if "RESOURCE_EXHAUSTED" in said:
        return "the device has no memory left; lower num_envs, num_seeds or replay_capacity"
    if "WarpOverflowError: " in said:
        return said.partition("WarpOverflowError: ")[2].splitlines()[0]
    return None
