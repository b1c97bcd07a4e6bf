"""Means over what there was: envs of all devices, iterations, updates that were made."""

from typing import NamedTuple

import jax
import jax.numpy as jnp

from mjx_balance.dqn.devices import AXIS


class Mean(NamedTuple):
    """A mean in the making; those of parts add up to that of the whole."""

    total: jax.Array
    number: jax.Array
    """How many values the total is of."""

    def value(self) -> jax.Array:
        """NaN if there was nothing."""
        return self.total / self.number


def mean_where(values: jax.Array, which: jax.Array) -> Mean:
    """Of those values (n,), over all devices, that are numbers and that `which` (n,) picks."""
    which = which & jnp.isfinite(values)
    parts = jnp.where(which, values, 0.0).sum(), which.sum(dtype=jnp.float32)
    return Mean(*jax.lax.psum(parts, AXIS))
