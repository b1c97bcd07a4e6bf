"""Device mesh of one axis: runs functions on every device, and computes means over all devices."""

from collections.abc import Callable
from typing import Any, NamedTuple, TypeVar

import jax
import jax.numpy as jnp
from jax.flatten_util import ravel_pytree
from jax.sharding import Mesh, PartitionSpec
from jaxtyping import Array, Bool, Float, PRNGKeyArray

AXIS = "devices"
REPLICATED = PartitionSpec()
T = TypeVar("T")


def on_each_device(
    function: Callable[..., Any], mesh: Mesh, in_specs: Any, out_specs: Any
) -> Callable[..., Any]:
    """Returns a function that runs `function` on every device of the mesh (`jax.shard_map`)."""
    # The inner jit keeps constants from becoming operands: with an empty one (the indices of
    # `x.at[:].set`), Shardy of JAX 0.11 crashes on two CPU devices.
    inner = jax.jit(function, inline=True)
    return jax.shard_map(inner, mesh=mesh, in_specs=in_specs, out_specs=out_specs, check_vma=False)


def device_key(key: PRNGKeyArray) -> PRNGKeyArray:
    """A different key on every device."""
    return jax.random.fold_in(key, jax.lax.axis_index(AXIS))


def mean_over_devices(tree: T) -> T:
    """Mean of every array over the devices, in one collective.

    On CPUs, an all-gather has half the steps of a ring reduction, and sums in the order of devices.
    """
    flat, unflatten = ravel_pytree(tree)
    mean = jax.lax.platform_dependent(
        flat,
        cpu=lambda x: jax.lax.all_gather(x, AXIS).mean(axis=0),
        default=lambda x: jax.lax.pmean(x, AXIS),
    )
    return unflatten(mean)


class Mean(NamedTuple):
    """A mean as total and number of values, so that means of parts can be summed."""

    total: Float[Array, ""]
    number: Float[Array, ""]

    def value(self) -> Float[Array, ""]:
        """NaN if there were no values."""
        return self.total / self.number


def mean_where(values: Float[Array, " n"], mask: Bool[Array, " n"]) -> Mean:
    """Mean over all devices of the finite values that `mask` selects."""
    mask = mask & jnp.isfinite(values)
    sums = jnp.where(mask, values, 0.0).sum(), mask.sum(dtype=jnp.float32)
    return Mean(*jax.lax.psum(sums, AXIS))


def all_finite(tree: object) -> Bool[Array, ""]:
    """Whether every number of a pytree is finite."""
    return jnp.stack([jnp.isfinite(x).all() for x in jax.tree.leaves(tree)]).all()
