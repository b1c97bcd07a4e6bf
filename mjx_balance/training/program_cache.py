"""Keeps traced programs on disk, so that a second start need not trace MJX again.

XLA's own persistent cache saves the compilation but not the tracing, which for
MJX takes longer than loading the result. A traced program is stored as serialized
StableHLO (`jax.export`) under a digest of everything it is traced from. Both caches are
an optional help: what is damaged or cannot be written is said and made anew.
"""

import contextlib
import hashlib
import importlib.metadata
import os
import tempfile
import warnings
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any, TypeAlias

import jax
import jax.numpy as jnp
from jax import export

from mjx_balance.config import Config, to_dict
from mjx_balance.files.run_folder import write_atomically
from mjx_balance.files.sources import code
from mjx_balance.machine import cores
from mjx_balance.robots.catalogue import robot_xml
from mjx_balance.sim.engines import ffi
from mjx_balance.sim.scene import scene_dir

LIBRARIES = ("mjx_balance", "jax", "jaxlib", "mujoco", "mujoco-mjx", "brax", "flax", "optax")
"""What a run's bits depend on besides this package's code."""
NOT_TRACED = (
    *("preset", "seed", "log_every", "checkpoint_seconds"),
    *("eval_every", "validation_scenarios", "validation_duration", "export"),
    *("eval_scenarios", "eval_duration"),
)
"""Fields of the config that the program is the same for; any other may change it."""
FLAGS = (
    *("jax_enable_x64", "jax_default_matmul_precision", "jax_numpy_dtype_promotion"),
    *("jax_default_prng_impl", "jax_threefry_partitionable", "jax_enable_custom_prng"),
)
"""Settings of JAX that change what a trace gives."""
XLA_DAMAGED = "Error reading persistent compilation cache entry for '"

CPU_OPTIONS: dict[str, str | bool] = {"xla_cpu_multi_thread_eigen": False}
"""Of XLA. Every core is a device: products that spread over all cores would only wait for those
of the other devices."""

LogFn: TypeAlias = Callable[[str], None]
"""Takes one line for the user."""


def cache_dir() -> Path:
    """Where programs are kept: $MJX_BALANCE_CACHE, or the user's cache folder."""
    base = os.environ.get("XDG_CACHE_HOME") or Path.home() / ".cache"
    return Path(os.environ.get("MJX_BALANCE_CACHE") or Path(base) / "mjx_balance")


def enable_compilation_cache(log_fn: LogFn) -> None:
    """Turns XLA's persistent cache on for every program; call before compiling."""
    folder = cache_dir() / "xla"
    try:
        folder.mkdir(parents=True, exist_ok=True)
        with tempfile.TemporaryFile(dir=folder):
            pass
    except OSError as error:
        log_fn(f"nothing is cached, {folder} cannot be written: {error.strerror}")
        return
    jax.config.update("jax_compilation_cache_dir", str(folder))
    jax.config.update("jax_persistent_cache_min_compile_time_secs", 0.5)


@contextlib.contextmanager
def mending_xla_cache(log_fn: LogFn) -> Iterator[None]:
    """Compile in here: what XLA finds damaged in its cache is said, and taken away.

    XLA compiles anew then, but would neither use nor replace the file.
    """
    with warnings.catch_warnings(record=True) as caught:
        warnings.filterwarnings("always", message=XLA_DAMAGED)
        yield
    for warning in caught:
        said = str(warning.message)
        if not said.startswith(XLA_DAMAGED):
            warnings.warn_explicit(
                warning.message, warning.category, warning.filename, warning.lineno
            )
            continue
        module = said.removeprefix(XLA_DAMAGED).partition("'")[0]
        for entry in (cache_dir() / "xla").glob(f"{module}-*-cache"):
            entry.unlink(missing_ok=True)
        log_fn(f"compiled anew: what {cache_dir() / 'xla'} had of {module} was damaged")


def versions() -> dict[str, str | None]:
    """Installed versions of `LIBRARIES`."""
    found: dict[str, str | None] = {}
    for name in LIBRARIES:
        try:
            found[name] = importlib.metadata.version(name)
        except importlib.metadata.PackageNotFoundError:
            found[name] = None
    return found


def program_key(config: Config, iterations: int, root: str) -> str:
    """Fingerprint of a training program: equal for equal programs, whatever is around them.

    Args:
      config: of the run; `NOT_TRACED` does not count.
      iterations: decisions of every env per call.
      root: module that builds the program; it and what it imports are what is traced.
    """
    values = {k: v for k, v in to_dict(config).items() if k not in NOT_TRACED}
    devices = [(device.platform, device.device_kind) for device in jax.devices()]
    flags = [str(getattr(jax.config, name)) for name in FLAGS]
    traced = (values, iterations, devices, cores(), flags, versions())
    key = hashlib.sha256(repr(traced).encode())
    key.update(repr(sorted(code(root).items())).encode())
    for path in sorted(scene_dir().glob("*.xml")):
        key.update(path.name.encode() + b"\0" + path.read_bytes())
    key.update(robot_xml(config.robot).encode())
    return key.hexdigest()[:32]


def compiler_options() -> dict[str, str | bool]:
    """XLA's options for programs that run on all of this machine's devices."""
    return CPU_OPTIONS if jax.devices()[0].platform == "cpu" else {}


def compile_program(
    program: Callable[[Any], tuple[Any, Any]], state: Any, key: str | None, log_fn: LogFn
) -> "CompiledProgram":
    """Compiles a jitted `state -> (state, output)`, from the cache where it can.

    Args:
      program: jitted; traced only if the cache does not know `key`. The state it
        returns has the structure of its argument, whose buffers are donated.
      state: an example, on its devices.
      key: from `program_key`; none for a program that calls what only this process knows, and
        that can therefore not be kept.
      log_fn: told what is wrong with the cache.

    Returns:
      The compiled program.
    """
    leaves, structure = jax.tree.flatten(state)

    def flat(leaves: list[jax.Array]) -> tuple[list[jax.Array], dict[str, jax.Array]]:
        state, output = program(jax.tree.unflatten(structure, leaves))
        return jax.tree.leaves(state), output

    traced = flat if key is None else _kept(flat, leaves, key, log_fn)
    lowered = jax.jit(traced, donate_argnums=0).lower(leaves)
    compiled = lowered.compile(compiler_options())

    return CompiledProgram(compiled, structure)


class CompiledProgram:
    """`state -> (state, output)`; it is not traced again, whatever it is given."""

    def __init__(self, compiled: Any, structure: Any):
        """Of a compiled function of the state's leaves."""
        self._compiled, self._structure = compiled, structure

    def __call__(self, state: Any) -> tuple[Any, Any]:
        leaves, output = self._compiled(jax.tree.leaves(state))
        return jax.tree.unflatten(self._structure, leaves), output

    def as_text(self) -> str:
        """The program as XLA writes it."""
        return self._compiled.as_text()


def _kept(
    flat: Callable[..., Any], leaves: list[jax.Array], key: str, log_fn: LogFn
) -> Callable[..., Any]:
    """The traced program of that key, from its file or made and stored now."""
    path = cache_dir() / "programs" / f"{key}.stablehlo"
    exported = _load(path, log_fn)
    if exported is None:
        ours = [export.DisabledSafetyCheck.custom_call(name) for name in ffi.registered()]
        exported = export.export(jax.jit(flat, donate_argnums=0), disabled_checks=ours)(leaves)
        _store(path, exported, log_fn)
    return exported.call


def _load(path: Path, log_fn: LogFn) -> export.Exported | None:
    """A traced program from its file, a digest and the program; none if it is not there."""
    try:
        content = path.read_bytes()
        digest, program = content[:32], content[32:]
        if hashlib.sha256(program).digest() != digest:
            raise ValueError("it is damaged")
        _initialize_lapack()
        return export.deserialize(bytearray(program))
    except FileNotFoundError:
        return None
    except (OSError, ValueError) as error:
        log_fn(f"the cached program {path} is made anew: {error}")
        return None


def _store(path: Path, exported: export.Exported, log_fn: LogFn) -> None:
    program = bytes(exported.serialize())
    try:
        path.parent.mkdir(parents=True, exist_ok=True)
        write_atomically(path, hashlib.sha256(program).digest() + program)
    except OSError as error:
        log_fn(f"the program is not cached, {path} cannot be written: {error.strerror}")


def _initialize_lapack() -> None:
    """Makes JAX look its LAPACK kernels up, as it does when it lowers a Cholesky itself.

    A program that was lowered in another process calls them through null pointers
    otherwise.
    """
    jax.jit(jnp.linalg.cholesky).lower(jnp.eye(2))
