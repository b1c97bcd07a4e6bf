"""The one mesh axis of the program, seen from inside: one device among the others."""

from collections.abc import Callable
from typing import Any, TypeVar

import jax
from jax.flatten_util import ravel_pytree
from jax.sharding import Mesh

AXIS = "devices"
T = TypeVar("T")


def on_each_device(
    function: Callable[..., Any], mesh: Mesh, in_specs: Any, out_specs: Any
) -> Callable[..., Any]:
    """What runs `function` on every device of the mesh; see `jax.shard_map`."""
    # Jitted, its constants stay inside it: over an empty one (the indices of `x.at[:].set`) among
    # the operands, Shardy of JAX 0.11 crashes on two CPU devices.
    inner = jax.jit(function, inline=True)
    return jax.shard_map(inner, mesh=mesh, in_specs=in_specs, out_specs=out_specs, check_vma=False)


def device_key(key: jax.Array) -> jax.Array:
    """A different key on every device."""
    return jax.random.fold_in(key, jax.lax.axis_index(AXIS))


def mean_over_devices(tree: T) -> T:
    """Of arrays that every device has. One exchange for all: each makes devices wait.

    CPUs give all to all, which takes half the steps of a sum in a ring, and add up in the devices'
    order, however many processes they belong to; for accelerators, their library knows better.
    """
    flat, unflatten = ravel_pytree(tree)
    mean = jax.lax.platform_dependent(
        flat,
        cpu=lambda x: jax.lax.all_gather(x, AXIS).mean(axis=0),
        default=lambda x: jax.lax.pmean(x, AXIS),
    )
    return unflatten(mean)
