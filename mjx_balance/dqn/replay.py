"""A uniform replay buffer as a frozen state and three pure functions.

Transitions arrive in batches of a fixed size, one per env. The capacity is a
whole number of batches, so a write is always one contiguous block and never
wraps in its middle.
"""

from typing import NamedTuple, TypeVar

import jax
import jax.numpy as jnp

T = TypeVar("T")


class Transition(NamedTuple):
    """One step of one env; in the buffer, every field has a leading capacity axis."""

    obs: jax.Array
    """(obs_size,)"""
    action: jax.Array
    """() index, int32"""
    reward: jax.Array
    """()"""
    terminated: jax.Array
    """() 1 after a true termination, 0 after a time-out: only the first stops bootstrapping."""
    next_obs: jax.Array
    """(obs_size,) the observation before any reset."""


class ReplayState(NamedTuple):
    """A ring of transitions."""

    data: Transition
    """(capacity, ...) per field."""
    position: jax.Array
    """() row that the next batch starts at."""
    size: jax.Array
    """() rows that hold transitions."""


def init(example: Transition, capacity: int, batch: int) -> ReplayState:
    """Allocates an empty buffer.

    Args:
      example: one transition, for shapes and dtypes.
      capacity: rows wanted; rounded down to a whole number of batches.
      batch: rows per `add`.

    Raises:
      ValueError: if not even one batch fits.
    """
    if capacity < batch:
        raise ValueError(f"capacity {capacity} does not hold one batch of {batch} transitions")
    rows = capacity // batch * batch
    data = jax.tree.map(lambda x: jnp.zeros((rows, *x.shape), x.dtype), example)
    return ReplayState(data, jnp.int32(0), jnp.int32(0))


def add(state: ReplayState, batch: Transition, wanted: jax.Array | bool = True) -> ReplayState:
    """Overwrites the oldest rows with a batch.

    Args:
      state: the buffer.
      batch: (batch, ...) per field.
      wanted: () if false, the buffer stays as it is.
    """
    capacity = state.data.action.shape[0]
    rows = batch.action.shape[0]
    if capacity % rows:
        raise ValueError(f"batch of {rows} rows does not divide the capacity, {capacity}")

    def write(ring: jax.Array, new: jax.Array) -> jax.Array:
        old = jax.lax.dynamic_slice_in_dim(ring, state.position, rows, 0)
        new = jnp.where(wanted, new, old)
        return jax.lax.dynamic_update_slice_in_dim(ring, new, state.position, 0)

    position = (state.position + rows) % capacity
    return ReplayState(
        jax.tree.map(write, state.data, batch),
        jnp.where(wanted, position, state.position),
        jnp.where(wanted, jnp.minimum(state.size + rows, capacity), state.size),
    )


def sample(state: ReplayState, key: jax.Array, batch_size: int) -> Transition:
    """Draws transitions uniformly, with replacement; the buffer must not be empty.

    Returns:
      (batch_size, ...) per field.
    """
    rows = jax.random.randint(key, (batch_size,), 0, state.size)
    return jax.tree.map(lambda ring: ring.at[rows].get(mode="promise_in_bounds"), state.data)
