"""A uniform replay buffer as a frozen state and pure functions: `init`, `add`, `sample`."""

from typing import NamedTuple, TypeAlias

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float, Int, PRNGKeyArray

Symmetries: TypeAlias = tuple[
    Int[np.ndarray, "g obs"],
    Float[np.ndarray, "g obs"],
    Int[np.ndarray, "g actions"] | Float[np.ndarray, "g axes"],
]
"""The g reflections of an env, including the identity: `obs_index`, `obs_sign`, `action`.

Reflection k maps obs to obs[obs_index[k]] * obs_sign[k], an action index to action[k, index], and
an action that is a point to point * action[k].
"""


class Transition(NamedTuple):
    """One step of one env; in the buffer, every field has a leading capacity axis."""

    obs: Float[Array, "*rows obs"]
    action: Int[Array, "*rows"] | Float[Array, "*rows axes"]
    """Index, int32; or the numbers of a continuous action."""
    reward: Float[Array, "*rows"]
    terminated: Float[Array, "*rows"]
    """1 after a termination; 0 otherwise, also after a truncation, which ends no bootstrapping."""
    next_obs: Float[Array, "*rows obs"]  #: the observation before any reset


class ReplayState(NamedTuple):
    """A ring of transitions."""

    data: Transition  #: (capacity, ...) per field
    position: Int[Array, ""]  #: row at which the next batch starts
    size: Int[Array, ""]  #: number of rows with transitions


def init(example: Transition, capacity: int, batch: int) -> ReplayState:
    """Allocates an empty buffer.

    Args:
      example: one transition, for shapes and dtypes.
      capacity: rows; rounded down to a whole number of batches.
      batch: rows per `add`.

    Raises:
      ValueError: if not even one batch fits.
    """
    if capacity < batch:
        raise ValueError(f"capacity {capacity} does not hold one batch of {batch} transitions")
    rows = capacity // batch * batch
    data = jax.tree.map(lambda x: jnp.zeros((rows, *x.shape), x.dtype), example)
    return ReplayState(data, jnp.int32(0), jnp.int32(0))


def add(state: ReplayState, batch: Transition, valid: Bool[Array, ""] | bool = True) -> ReplayState:
    """Overwrites the oldest rows with a batch, (batch, ...) per field, if it is `valid`.

    Raises:
      ValueError: if the batch does not divide the capacity.
    """
    capacity, rows = len(state.data.action), len(batch.action)
    if capacity % rows:
        raise ValueError(f"batch of {rows} rows does not divide the capacity, {capacity}")

    def write(ring: jax.Array, new: jax.Array) -> jax.Array:
        old = jax.lax.dynamic_slice_in_dim(ring, state.position, rows, 0)
        new = jnp.where(valid, new, old)
        return jax.lax.dynamic_update_slice_in_dim(ring, new, state.position, 0)

    position = (state.position + rows) % capacity
    return ReplayState(
        jax.tree.map(write, state.data, batch),
        jnp.where(valid, position, state.position),
        jnp.where(valid, jnp.minimum(state.size + rows, capacity), state.size),
    )


def sample(state: ReplayState, key: PRNGKeyArray, batch_size: int) -> Transition:
    """Draws (batch_size, ...) transitions uniformly with replacement; the buffer is not empty."""
    rows = jax.random.randint(key, (batch_size,), 0, state.size)
    return jax.tree.map(lambda ring: ring.at[rows].get(mode="promise_in_bounds"), state.data)


def reflect(batch: Transition, symmetries: Symmetries, key: PRNGKeyArray) -> Transition:
    """Replaces each transition of a batch by one of its reflections, chosen at random."""
    obs_index, obs_sign, actions = map(jnp.asarray, symmetries)
    which = jax.random.randint(key, batch.reward.shape, 0, len(obs_index))
    points = jnp.issubdtype(batch.action.dtype, jnp.floating)

    def reflected(obs: jax.Array) -> jax.Array:
        return jnp.take_along_axis(obs, obs_index[which], axis=-1) * obs_sign[which]

    return batch._replace(
        obs=reflected(batch.obs),
        next_obs=reflected(batch.next_obs),
        action=batch.action * actions[which] if points else actions[which, batch.action],
    )
