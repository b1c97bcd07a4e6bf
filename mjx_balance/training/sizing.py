"""What a run computes on: one process, its JAX devices, their memory, the learner over them."""

import contextlib
import dataclasses
import json
import math
from collections.abc import Mapping
from typing import Any

import jax
from jax.sharding import PartitionSpec

from mjx_balance.config import Config, ConfigError, check, expand_runs, preset, sweep_grid
from mjx_balance.dqn import DQN, DQNSpec, Loss, Network, QNetwork
from mjx_balance.dqn.mesh import REPLICATED
from mjx_balance.envs.balance import BalanceEnv
from mjx_balance.errors import MESSAGE, quote, shorten
from mjx_balance.files.run_folder import write_json
from mjx_balance.machine import available_memory, cores, share_heap
from mjx_balance.policy.manifest import network_factors
from mjx_balance.sim.engines.table import check_platform
from mjx_balance.training.program_cache import LogFn, cache_dir, enable_compilation_cache

SIZES_FILE = "sizes.json"  #: in the cache: numbers of envs by device and engine, as measured
NEAR_BEST = 0.9  #: share of the best rate from which on more envs are not worth it
STATE_COPIES = 2  #: a checkpoint is read back beside the state that it replaces
ENV_BYTES = 40_000  #: per env while MJX steps it: twice XLA's plan on a CPU, which fuses more
PROGRAM_BYTES = 1.3 * 2**30  #: libraries, compiler, program (benchmarks/README.md)
CPU_ENVS = 256  #: what the sizes of presets without `num_envs` are meant for
ACCELERATOR_ENVS = 2_048  #: of an accelerator that has not been measured
COUNTED_IN_ENVS = ("num_env_steps", "log_every", "eval_every")
LEARNER_COUNTED_IN_ENVS = (
    *("batch_size", "replay_capacity", "min_replay_size", "epsilon_decay_steps", "whiten_steps"),
)
"""Sizes that grow with the number of envs, so that a run keeps its decisions of each env and its
updates, each with more transitions: the replay ratio stays."""


def configure_jax(log_fn: LogFn, num_cores: int | None = None) -> None:
    """Makes CPU cores (None: all of this process) JAX devices; turns the compilation cache on.

    Raises:
      ConfigError: if JAX has no device, or not all processes have the same number of devices.
    """
    share_heap()  # before JAX starts threads
    # Too late if JAX is already in use, as in a notebook: its devices do as they are.
    with contextlib.suppress(RuntimeError):
        jax.config.update("jax_num_cpu_devices", num_cores or cores())
    enable_compilation_cache(log_fn)
    try:
        counts = [len(jax.local_devices(process_index=k)) for k in range(jax.process_count())]
    except (RuntimeError, AssertionError) as error:  # the second for "cuda" without its plugin
        reason = f" ({shorten(error, 100)})" if str(error) else ""
        raise ConfigError(
            f"JAX_PLATFORMS is {quote(jax.config.jax_platforms)}, and JAX finds no such device"
            f"{reason}; set JAX_PLATFORMS=cpu, or unset it"
        ) from error
    if len(set(counts)) > 1:
        raise ConfigError(
            f"the processes have {counts} JAX devices; all must have the same number, as "
            "CUDA_VISIBLE_DEVICES can make them"
        )


def size_to_device(config: Config, most: int | None = None) -> Config:
    """Fills in `num_envs`, at most `most`, and `num_devices` if they are None.

    Raises:
      ConfigError: if the config is invalid, its engine does not run here, or the envs cannot be
        spread over the devices.
    """
    device, num_envs = jax.devices()[0], check(config).num_envs
    check_platform(config.engine, device.platform, device.device_kind)
    if num_envs is None:
        num_envs = CPU_ENVS
        if device.platform != "cpu":
            num_envs = _measured_sizes().get(_device(config.engine), ACCELERATOR_ENVS)
        num_envs = min(num_envs, most or num_envs)
        config = scale_sizes(config, num_envs)
    num_devices = _share_out(config.num_devices, num_envs, config.dqn.batch_size)
    return check(dataclasses.replace(config, num_devices=num_devices))


def _share_out(num_devices: int | None, num_envs: int, batch_size: int) -> int:
    """The number of devices, the same in every process, which share envs and batch evenly."""
    available, processes = len(jax.devices()), jax.process_count()
    if num_devices is None:
        possible = range(available - available % processes, processes, -processes)
        even = (n for n in possible if num_envs % n == batch_size % n == 0)
        num_devices = next(even, processes)
    if num_devices > available:
        raise ConfigError(f"num_devices is {num_devices}; this machine has {available} JAX devices")
    for name, value, divisor, size in (
        ("num_devices", num_devices, "num_processes", processes),
        ("num_envs", num_envs, "num_devices", num_devices),
        ("batch_size", batch_size, "num_devices", num_devices),
    ):
        if value % size:
            raise ConfigError(f"{name} is {value}; it must be a multiple of {divisor}, {size}")
    return num_devices


def scale_sizes(config: Config, num_envs: int) -> Config:
    """The config with so many envs; every size that is still its preset's grows with them."""
    defaults, scale = preset(config.preset), num_envs / CPU_ENVS

    def scaled(own: Any, default: Any, names: tuple[str, ...]) -> Any:
        values = {name: getattr(own, name) for name in names}
        grown = {k: round(scale * x) for k, x in values.items() if x == getattr(default, k)}
        return dataclasses.replace(own, **grown)

    dqn = scaled(config.dqn, defaults.dqn, LEARNER_COUNTED_IN_ENVS)
    config = scaled(config, defaults, COUNTED_IN_ENVS)
    return dataclasses.replace(config, num_envs=num_envs, dqn=dqn)


def describe_growth(config: Config, sized: Config) -> str:
    """The line for the user about sizes that follow from the device; empty if there are none."""
    pairs = (config, sized, COUNTED_IN_ENVS), (config.dqn, sized.dqn, LEARNER_COUNTED_IN_ENVS)
    changed = [
        f"{name} {getattr(after, name):,}"
        for before, after, names in pairs
        for name in names
        if getattr(after, name) != getattr(before, name)
    ]
    if not changed:
        return ""
    return f"with num_envs {sized.num_envs:,} come {', '.join(changed)}; what you say stays"


def remember_envs(engine: str, rates: Mapping[int, float]) -> int:
    """Saves the number of envs for runs on this device: the fewest that come near the best rate.

    Args:
      engine: of the measurement.
      rates: number of envs -> physics steps per second.
    """
    enough = NEAR_BEST * max(rates.values())
    chosen = min(num_envs for num_envs, rate in rates.items() if rate >= enough)
    sizes = _measured_sizes() | {_device(engine): chosen}
    cache_dir().mkdir(parents=True, exist_ok=True)
    write_json(cache_dir() / SIZES_FILE, sizes)
    return chosen


def _measured_sizes() -> dict[str, int]:
    """Numbers of envs by device and engine; what is missing or damaged is left out."""
    try:
        sizes = json.loads((cache_dir() / SIZES_FILE).read_text())
        return {k: v for k, v in sizes.items() if isinstance(v, int) and v > 0}
    except (OSError, ValueError, AttributeError):
        return {}


def _device(engine: str) -> str:
    return f"{jax.devices()[0].device_kind}, engine {engine}"


def make_learner(
    config: Config, env: BalanceEnv, network: Network | None = None, loss: Loss | None = None
) -> DQN:
    """The DQN for a config that `size_to_device` has completed.

    Args:
      config: of the run.
      env: of the run.
      network: the user's own; None: that of the config.
      loss: the user's own, of a transition; None: the DQN's.

    Raises:
      ConfigError: if the network is none for this env and config.
    """
    assert config.num_envs is not None
    assert config.num_devices is not None
    runs, processes = expand_runs(config), jax.process_count()
    each = config.num_devices // processes
    spec = DQNSpec(
        config=config.dqn,
        num_envs=config.num_envs,
        num_env_steps=config.num_env_steps,
        devices=[x for k in range(processes) for x in jax.local_devices(process_index=k)[:each]],
        num_seeds=len(runs),
        symmetries=env.symmetries,
        action_factors=env.action_factors,
        continuous=env.continuous,
        first_reset=env.reset_staggered,
        sweep={name: [getattr(run.dqn, name) for run in runs] for name in sweep_grid(config)[0]},
    )
    if network is None:
        radial = config.dqn.head == "radial"
        network = QNetwork(config.dqn.hidden_sizes, network_factors(config), radial)
    else:
        check_network(network, config, env)
    return DQN(env, network, spec, loss)


def check_network(network: Network, config: Config, env: BalanceEnv) -> None:
    """Checks a network that is not ours before anything is written.

    Raises:
      ConfigError: if it cannot be called, or its values or methods are not what the config needs.
    """
    name, size, count = type(network).__name__, env.observation_size, config.task.num_actions
    if config.export == "best":
        raise ConfigError(
            f"export is 'best', but network {name} is your own, so that no policy file is written "
            "to choose from; export must be 'last'"
        )
    for field, on, method in (
        ("action", config.task.action == "continuous", "head"),
        ("zero_at_rest", config.dqn.zero_at_rest, "fold_rest"),
    ):
        if on and not hasattr(network, method):
            value = getattr(config.task if field == "action" else config.dqn, field)
            other = "'grid'" if field == "action" else "False"
            raise ConfigError(
                f"{field} is {quote(value)}, for which network {name} needs a method `{method}` "
                f"(dqn.Network); give it one, or set {field} to {other}"
            )
    obs = jax.ShapeDtypeStruct((size,), "float32")

    def values(obs: jax.Array) -> Any:
        params = network.init(jax.random.PRNGKey(0), obs)
        if hasattr(network, "head"):
            return network.apply(params, obs, method="head").q_values()
        return network.apply(params, obs)

    try:
        shape = jax.eval_shape(values, obs).shape
    except Exception as error:  # whatever the network makes of it
        reason = shorten(error, MESSAGE // 2)
        raise ConfigError(
            f"network {name} fails for an observation of shape ({size},): {reason}"
        ) from error
    if shape != (count,):
        raise ConfigError(
            f"network {name} gives values of shape {shape} for an observation of shape ({size},); "
            f"it must be ({count},), one per action"
        )


def check_memory(learner: DQN) -> None:
    """Raises `ConfigError` if a run would not fit into a device or into this machine."""
    spec, needed = learner.spec, device_bytes(learner)
    device = spec.devices[0]
    if device.platform == "cpu":
        mine = [x for x in spec.devices if x.process_index == jax.process_index()]
        where, needed = "this machine", len(mine) * needed
        available = available_memory()
    else:
        where, stats = "each device", device.memory_stats() or {}
        available = stats.get("bytes_limit", math.inf) - stats.get("bytes_in_use", 0)
    needed += PROGRAM_BYTES
    if needed > available:
        raise ConfigError(
            f"{spec.num_seeds} runs with num_envs {spec.num_envs} and replay_capacity "
            f"{spec.config.replay_capacity} take about {needed / 2**30:.1f} GiB of {where}, and "
            f"{available / 2**30:.1f} GiB are free; lower num_envs, replay_capacity or the number "
            "of runs"
        )


def device_bytes(learner: DQN) -> float:
    """Memory that a run takes on each of its devices, besides its program, bytes."""
    shapes = jax.eval_shape(lambda: learner.init(0))

    def own(spec: PartitionSpec, part: Any) -> float:
        whole = sum(x.size * x.dtype.itemsize for x in jax.tree.leaves(part))
        return whole if spec == REPLICATED else whole / len(learner.spec.devices)

    state = sum(jax.tree.leaves(jax.tree.map(own, learner.state_specs, shapes)))
    envs = learner.spec.num_seeds * learner.spec.per_device(learner.spec.num_envs)
    return STATE_COPIES * state + ENV_BYTES * envs


def explained(error: Exception) -> str | None:
    """What the user can do about an error of a running program, in a sentence; None if unknown."""
    text = str(error)
    if "RESOURCE_EXHAUSTED" in text:
        return "the device has no memory left; lower num_envs, num_seeds or replay_capacity"
    if "WarpOverflowError: " in text:
        return text.partition("WarpOverflowError: ")[2].splitlines()[0]
    return None
