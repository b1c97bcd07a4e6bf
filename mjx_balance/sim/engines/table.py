"""The table of physics engines. Nothing else compares an engine's name.

To add one: a module with a function (scene, options) -> `JaxEngine`, a row in `ENGINES`, and its
name in `Config.engine`.
"""

import importlib.util
import pkgutil
from typing import TYPE_CHECKING, NamedTuple

from mjx_balance.config import Config, ConfigError
from mjx_balance.sim.scene import Scene

if TYPE_CHECKING:
    from mjx_balance.sim.engines.jax_engine import JaxEngine


class Options(NamedTuple):
    """Arguments of an engine, besides the scene."""

    solver_iterations: int  #: of MJX's constraint solver; MuJoCo's C engine stops by itself
    line_search_iterations: int
    num_devices: int | None  #: JAX devices that the envs are spread over; None: all


class EngineRow(NamedTuple):
    """One engine, and what the rest of the package needs to know about it."""

    name: str  #: as in `Config.engine`
    make: str  #: `MODULE:FUNCTION` of this folder, imported when called
    platforms: tuple[str, ...] = ()  #: JAX platforms that it runs on; none named: all
    hardware: str = "every device"  #: the same in words
    cacheable: bool = True  #: whether its traced programs work in another process
    module: str | None = None
    """Module that the extra of the engine's name installs, hidden while another engine runs; None:
    the extra `train` is enough."""
    distribution: str | None = None  #: the registry's name of that module


ENGINES = {
    row.name: row
    for row in (
        EngineRow("mjx", "mjx:mjx_engine"),
        EngineRow("mujoco", "mujoco_ffi:mujoco_engine", platforms=("cpu",), hardware="CPUs"),
        EngineRow(
            "warp",
            "warp:warp_engine",
            platforms=("cpu", "gpu", "cuda"),
            hardware="NVIDIA GPUs and CPUs",
            cacheable=False,  # its kernels live in the process that built them
            module="warp",
            distribution="warp-lang",
        ),
    )
}


def make_engine(config: Config, scene: Scene) -> "JaxEngine":
    """The config's engine; only that one is imported.

    Cheap: a run whose program is cached never asks for the physics of its own process.

    Raises:
      ConfigError: if the engine is not installed.
    """
    row = ENGINES[config.engine]
    if row.module is not None and importlib.util.find_spec(row.module) is None:
        raise ConfigError(
            f"engine is {row.name}, and {row.distribution} is not installed; install the extra "
            f"`{row.name}` (make train EXTRAS={row.name}), or choose engine mjx"
        )
    options = Options(config.solver_iterations, config.line_search_iterations, config.num_devices)
    return pkgutil.resolve_name(f"{__package__}.{row.make}")(scene, options)


def check_platform(engine: str, platform: str, device_kind: str) -> None:
    """Raises `ConfigError` if an engine does not run on a JAX platform."""
    row = ENGINES[engine]
    if row.platforms and platform not in row.platforms:
        on_cpu = "set JAX_PLATFORMS=cpu, or " if row.platforms == ("cpu",) else ""
        raise ConfigError(
            f"engine is {engine}, which runs on {row.hardware}, and JAX uses {device_kind}; "
            f"{on_cpu}choose engine mjx"
        )


def unused_modules(engine: str) -> list[str]:
    """Modules of the other engines, which a run need not import."""
    return [row.module for row in ENGINES.values() if row.module and row.name != engine]
