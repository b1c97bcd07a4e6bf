"""Running statistics of the observations, and their whitening.

Neighbouring sensor samples are nearly equal, and their small difference distinguishes a tilt from a
sway. Without whitening, a network learns directions of small variance orders of magnitude more
slowly (LeCun et al. 1998, "Efficient BackProp", section 4.3).
"""

from typing import NamedTuple

import jax
import jax.numpy as jnp
from jaxtyping import Array, Float

from mjx_balance.dqn.mesh import AXIS, all_finite

RECENCY = 4.0
"""The weight of batch k grows as k^(RECENCY - 1): the first batches, of random actions, hardly
count."""


class RunningStatistics(NamedTuple):
    """Weighted moments of the observations, and their whitening matrix."""

    mean: Float[Array, " obs"]
    covariance: Float[Array, "obs obs"]
    batches: Float[Array, ""]  #: number of batches
    matrix: Float[Array, "obs obs"]  #: (obs - mean) @ matrix is white


def init(obs_size: int, floor: float) -> RunningStatistics:
    """Statistics of white observations; see `whitening_matrix` for `floor`."""
    covariance = jnp.eye(obs_size)
    matrix = whitening_matrix(covariance, floor)
    return RunningStatistics(jnp.zeros(obs_size), covariance, jnp.float32(0.0), matrix)


def observe(
    statistics: RunningStatistics, obs: Float[Array, "envs obs"], floor: float
) -> RunningStatistics:
    """Adds the finite observations of all devices as one batch.

    Args:
      statistics: so far.
      obs: this device's observations.
      floor: see `whitening_matrix`.
    """
    mask = jax.vmap(all_finite)(obs)[:, None]
    count = jax.lax.psum(mask.sum(), AXIS)
    mean: jax.Array = jax.lax.psum(jnp.where(mask, obs, 0.0).sum(axis=0), AXIS) / count
    centered = jnp.where(mask, obs - mean, 0.0)
    # Whitening divides by small differences between neighbouring samples.
    with jax.default_matmul_precision("highest"):
        within = jax.lax.psum(centered.T @ centered, AXIS) / count
        weight = RECENCY / (statistics.batches + RECENCY)
        step = mean - statistics.mean
        between = (1 - weight) * weight * jnp.outer(step, step)
        covariance = (1 - weight) * statistics.covariance + weight * within + between
        new = RunningStatistics(
            statistics.mean + weight * step,
            covariance,
            statistics.batches + 1,
            whitening_matrix(covariance, floor),
        )
    usable = all_finite(new)  # false without finite observations, or if their squares overflow
    return jax.tree.map(lambda new, old: jnp.where(usable, new, old), new, statistics)


def whitening_matrix(covariance: Float[Array, "obs obs"], floor: float) -> Float[Array, "obs obs"]:
    """The symmetric whitening matrix (covariance + floor * identity)^(-1/2).

    Of all whitening matrices it changes the inputs least, and it is a smooth function of the
    covariance (Kessy et al. 2018, https://arxiv.org/abs/1512.00809, section 3.1).
    """
    values, vectors = jnp.linalg.eigh(covariance)
    return (vectors / jnp.sqrt(jnp.maximum(values, 0.0) + floor)) @ vectors.T
