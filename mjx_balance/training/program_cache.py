"""Keeps traced programs on disk, so that a second start need not trace MJX again.

XLA's own persistent cache saves the compilation but not the tracing, which for
MJX takes longer than loading the result. A traced program is stored as serialized
StableHLO (`jax.export`) under a digest of everything it depends on.
"""

import hashlib
import importlib.metadata
import os
from collections.abc import Callable
from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp
from jax import export

from mjx_balance.scene import scene_dir


def cache_dir() -> Path:
    """Where programs are kept: $MJX_BALANCE_CACHE, or the user's cache folder."""
    base = os.environ.get("XDG_CACHE_HOME") or Path.home() / ".cache"
    return Path(os.environ.get("MJX_BALANCE_CACHE") or Path(base) / "mjx_balance")


def enable_compilation_cache() -> None:
    """Turns XLA's persistent cache on for every program; call before compiling."""
    jax.config.update("jax_compilation_cache_dir", str(cache_dir() / "xla"))
    jax.config.update("jax_persistent_cache_min_compile_time_secs", 0.5)


def digest(*parts: object) -> str:
    """Fingerprint of `parts`, this package's code, its scenes, the libraries and devices."""
    state = hashlib.sha256(repr(parts).encode())
    package = Path(__file__).resolve().parents[1]
    for path in sorted([*package.rglob("*.py"), *scene_dir().glob("*.xml")]):
        state.update(path.read_bytes())
    for name in ("jax", "jaxlib", "mujoco", "mujoco-mjx", "brax", "flax", "optax"):
        state.update(importlib.metadata.version(name).encode())
    devices = jax.devices()
    state.update(f"{devices[0].device_kind}{len(devices)}".encode())
    return state.hexdigest()[:32]


def compile_cached(
    program: Callable[[Any], tuple[Any, Any]], state: Any, key: str
) -> Callable[[Any], tuple[Any, Any]]:
    """Compiles a jitted `state -> (state, output)`, from the cache where it can.

    Args:
      program: jitted; traced only if the cache does not know `key`. The state it
        returns has the structure of its argument, whose buffers are donated.
      state: an example, on its devices.
      key: from `digest`.

    Returns:
      The compiled program.
    """
    leaves, structure = jax.tree.flatten(state)
    folder = cache_dir() / "programs"
    path = folder / f"{key}.stablehlo"

    def flat(leaves: list[jax.Array]) -> tuple[list[jax.Array], dict[str, jax.Array]]:
        state, output = program(jax.tree.unflatten(structure, leaves))
        return jax.tree.leaves(state), output

    if path.is_file():
        _initialize_lapack()
        exported = export.deserialize(bytearray(path.read_bytes()))
    else:
        exported = export.export(jax.jit(flat, donate_argnums=0))(leaves)
        folder.mkdir(parents=True, exist_ok=True)
        part = path.with_suffix(f".{os.getpid()}")
        part.write_bytes(exported.serialize())
        part.replace(path)
    compiled = jax.jit(exported.call, donate_argnums=0).lower(leaves).compile()

    def run(state: Any) -> tuple[Any, Any]:
        leaves, output = compiled(jax.tree.leaves(state))
        return jax.tree.unflatten(structure, leaves), output

    return run


def _initialize_lapack() -> None:
    """Makes JAX look its LAPACK kernels up, as it does when it lowers a Cholesky itself.

    A program that was lowered in another process calls them through null pointers
    otherwise.
    """
    jax.jit(jnp.linalg.cholesky).lower(jnp.eye(2))
