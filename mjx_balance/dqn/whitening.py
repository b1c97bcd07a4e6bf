"""Inputs without correlation and of equal size: gradient descent then learns all directions.

Neighbouring sensor samples are nearly equal, and what they differ in is what tells a
tilt from a sway. Left as they are, the directions of a small variance take orders of
magnitude longer to learn (LeCun et al. 1998, "Efficient BackProp", section 4.3).
"""

from typing import NamedTuple

import jax
import jax.numpy as jnp

RECENCY = 4.0
"""Observations count by the (RECENCY - 1)th power of when they came: the last quarter of
what was seen weighs most, the first random actions hardly at all."""


class InputStatistics(NamedTuple):
    """Weighted moments of the observations, and what follows from them."""

    mean: jax.Array
    """(obs_size,)"""
    covariance: jax.Array
    """(obs_size, obs_size)"""
    batches: jax.Array
    """() batches seen."""
    matrix: jax.Array
    """(obs_size, obs_size) whitens: (obs - mean) @ matrix."""


def init(obs_size: int, floor: float) -> InputStatistics:
    """Statistics of observations that are white already; see `matrix` for `floor`."""
    covariance = jnp.eye(obs_size)
    return InputStatistics(
        jnp.zeros(obs_size), covariance, jnp.float32(0.0), matrix(covariance, floor)
    )


def update(
    seen: InputStatistics, mean: jax.Array, covariance: jax.Array, floor: float
) -> InputStatistics:
    """Adds a batch by its mean (obs_size,) and covariance (obs_size, obs_size)."""
    weight = RECENCY / (seen.batches + RECENCY)
    step = mean - seen.mean
    between = (1 - weight) * weight * jnp.outer(step, step)
    covariance = (1 - weight) * seen.covariance + weight * covariance + between
    return InputStatistics(
        seen.mean + weight * step, covariance, seen.batches + 1, matrix(covariance, floor)
    )


def matrix(covariance: jax.Array, floor: float) -> jax.Array:
    """The symmetric whitening matrix (covariance + floor)^(-1/2), (obs_size, obs_size).

    Of all whitening matrices it changes the inputs least, and it changes smoothly with
    the covariance (Kessy et al. 2018, https://arxiv.org/abs/1512.00809, section 3.1).
    """
    values, vectors = jnp.linalg.eigh(covariance)
    return (vectors / jnp.sqrt(jnp.maximum(values, 0.0) + floor)) @ vectors.T
