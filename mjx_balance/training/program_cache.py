"""Keeps traced programs on disk, so that a second start need not trace MJX again.

XLA's own persistent cache saves the compilation but not the tracing, which takes longer with MJX.
A traced program is stored as serialized StableHLO (`jax.export`) under a digest of everything it
is traced from. Both caches are optional: what is damaged or cannot be written is logged.
"""

import contextlib
import dataclasses
import errno
import hashlib
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
from mjx_balance.errors import shorten
from mjx_balance.files.run_folder import write_atomically
from mjx_balance.files.sources import code
from mjx_balance.machine import cores
from mjx_balance.policy.manifest import installed_version
from mjx_balance.robots.catalogue import find_robot, robot_xml
from mjx_balance.sim.engines import ffi
from mjx_balance.sim.engines.table import ENGINES
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
TRACED, COMPILED = "traced", "compiled"
"""Folders of the cache. Version 0.3 had others, `programs` and `xla`, which a group could write."""
XLA_DAMAGED = "Error reading persistent compilation cache entry for '"

LogFn: TypeAlias = Callable[[str], None]  #: takes one line for the user


def cache_dir() -> Path:
    """Where programs are kept: $MJX_BALANCE_CACHE, or a folder in the user's cache folder.

    Raises:
      OSError: if the user has neither.
    """
    if own := os.environ.get("MJX_BALANCE_CACHE"):
        return Path(own)
    if caches := os.environ.get("XDG_CACHE_HOME"):
        return Path(caches) / "mjx_balance"
    try:
        return Path.home() / ".cache" / "mjx_balance"
    except RuntimeError as error:
        reason = "there is none; set MJX_BALANCE_CACHE"
        raise OSError(errno.EACCES, reason, "the user's home") from error


def private_folder(name: str) -> Path:
    """A folder of the cache that no other user can write: whoever plants a program runs code here.

    Raises:
      OSError: if it cannot be created, or what is in it may be another user's.
    """
    folder = cache_dir() / name
    folder.mkdir(mode=0o700, parents=True, exist_ok=True)
    if not hasattr(os, "geteuid"):
        return folder
    mode = folder.stat().st_mode
    is_shared = mode & 0o077
    for path in (folder, *folder.iterdir()):
        try:
            status = path.stat() if path == folder else path.lstat()
        except FileNotFoundError:  # another run has renamed what it wrote
            continue
        if status.st_uid != os.geteuid():
            raise OSError(errno.EACCES, "it is another user's", str(path))
        if is_shared and status.st_mode & 0o022 and not path.is_symlink():
            raise OSError(errno.EACCES, "other users may write to it; delete it", str(path))
    if is_shared:
        folder.chmod(0o700)
    return folder


def enable_compilation_cache(log_fn: LogFn) -> None:
    """Turns XLA's persistent cache on for every program; call before compiling."""
    try:
        private_folder(TRACED)
        folder = private_folder(COMPILED)
        with tempfile.TemporaryFile(dir=folder):
            pass
    except OSError as error:
        log_fn(f"programs are not cached, {error.filename} cannot be used: {error.strerror}")
        return
    jax.config.update("jax_compilation_cache_dir", str(folder))
    jax.config.update("jax_persistent_cache_min_compile_time_secs", 0.5)


@contextlib.contextmanager
def mending_xla_cache(log_fn: LogFn) -> Iterator[None]:
    """Compile in here: entries that XLA finds damaged, but would leave, are logged and removed."""
    with warnings.catch_warnings(record=True) as caught:
        warnings.filterwarnings("always", message=XLA_DAMAGED)
        yield
    for warning in caught:
        _, damaged, rest = str(warning.message).partition(XLA_DAMAGED)
        if not damaged:
            origin = warning.category, warning.filename, warning.lineno
            warnings.warn_explicit(warning.message, *origin)
            continue
        module = rest.partition("'")[0]
        folder = cache_dir() / COMPILED
        for entry in folder.glob(f"{module}-*-cache"):
            entry.unlink(missing_ok=True)
        log_fn(f"compiled again: the entry of {module} in {folder} was damaged")


def versions() -> dict[str, str | None]:
    """Installed versions of `LIBRARIES`."""
    return {name: installed_version(name) for name in LIBRARIES}


def traced_code(config: Config, root: str) -> list[tuple[str, str]]:
    """Modules and code of `root`, of the config's engine, and of all that they import."""
    module = ENGINES[config.engine].make.partition(":")[0]
    return sorted(code(root, f"mjx_balance.sim.engines.{module}").items())


def program_key(config: Config, iterations: int, root: str) -> str:
    """Fingerprint of a training program: equal for equal programs, whatever is around them.

    Args:
      config: of the run.
      iterations: decisions of every env per call.
      root: module that builds the program; it and its imports are traced.
    """
    values = {k: v for k, v in to_dict(config).items() if k not in NOT_TRACED}
    robot = to_dict(find_robot(config.robot))  # not all of its numbers are in its model
    devices = [(device.platform, device.device_kind) for device in jax.devices()]
    flags = [str(getattr(jax.config, name)) for name in FLAGS]
    code_of = traced_code(config, root)
    traced = (values, robot, iterations, devices, cores(), flags, versions(), code_of)
    key = hashlib.sha256(repr(traced).encode())
    for path in sorted(scene_dir().glob("*.xml")):
        key.update(path.name.encode() + b"\0" + path.read_bytes())
    key.update(robot_xml(config.robot).encode())
    return key.hexdigest()[:32]


def compiler_options() -> dict[str, str | bool]:
    """XLA's options for programs that run on all of this machine's devices."""
    # Every core is a device: products that spread over all cores would wait for other devices'.
    return {"xla_cpu_multi_thread_eigen": False} if jax.devices()[0].platform == "cpu" else {}


@dataclasses.dataclass(frozen=True)
class CompiledProgram:
    """A program state -> (state, output) that is never traced again."""

    compiled: jax.stages.Compiled  #: takes and returns the state's leaves
    structure: Any  #: of the state's tree

    def __call__(self, state: Any) -> tuple[Any, Any]:
        leaves, output = self.compiled(jax.tree.leaves(state))
        return jax.tree.unflatten(self.structure, leaves), output


def compile_program(
    program: Callable[[Any], tuple[Any, Any]], state: Any, key: str | None, log_fn: LogFn
) -> CompiledProgram:
    """Compiles a jitted `state -> (state, output)`, from the cache where it can.

    Args:
      program: jitted; traced only if the cache does not know `key`. The state it returns has the
        structure of its argument, whose buffers are donated.
      state: an example, on its devices.
      key: from `program_key`; None for a program that works in this process alone.
      log_fn: takes what is wrong with the cache.
    """
    leaves, structure = jax.tree.flatten(state)

    def flat(leaves: list[jax.Array]) -> tuple[list[jax.Array], dict[str, jax.Array]]:
        state, output = program(jax.tree.unflatten(structure, leaves))
        return jax.tree.leaves(state), output

    traced = jax.jit(flat, donate_argnums=0)
    path = None
    if key is not None:
        with contextlib.suppress(OSError):  # no cache, as `enable_compilation_cache` has said
            path = private_folder(TRACED) / f"{key}.stablehlo"
    if path is not None:
        exported = _load(path, log_fn)
        if exported is None:
            ours = [export.DisabledSafetyCheck.custom_call(name) for name in ffi.registered()]
            exported = export.export(traced, disabled_checks=ours)(leaves)
            _store(path, exported, log_fn)
        traced = jax.jit(exported.call, donate_argnums=0)
    return CompiledProgram(traced.lower(leaves).compile(compiler_options()), structure)


def _load(path: Path, log_fn: LogFn) -> export.Exported | None:
    """A traced program from its file, 32 bytes of digest before it; None if it is not there."""
    try:
        content = path.read_bytes()
        program = content[32:]
        if hashlib.sha256(program).digest() != content[:32]:
            raise ValueError("it is damaged")
        # Makes JAX look its LAPACK kernels up, as it does when it lowers a Cholesky itself. A
        # program that was lowered in another process calls them through null pointers otherwise.
        jax.jit(jnp.linalg.cholesky).lower(jnp.eye(2))
        return export.deserialize(bytearray(program))
    except FileNotFoundError:
        return None
    except Exception as error:  # whatever JAX raises for bytes that are no program
        log_fn(f"the cached program {path} is replaced: {shorten(error)}")
        return None


def _store(path: Path, exported: export.Exported, log_fn: LogFn) -> None:
    program = bytes(exported.serialize())
    try:
        write_atomically(path, hashlib.sha256(program).digest() + program)
    except OSError as error:
        log_fn(f"the program is not cached, {path} cannot be written: {error.strerror}")
