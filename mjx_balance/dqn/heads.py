"""The last step of a Q-network, from its outputs to one value per action.

Written once for NumPy (the exported policy) and JAX (training): the array library is that of
the arguments. An action index is a mixed-radix number with one digit per factor.
"""

import math
from collections.abc import Sequence
from typing import Any

import numpy as np


def added_up(branches: Any, factors: Sequence[int]) -> Any:
    """The value of an action as the sum of the values of its digits.

    Args:
      branches: (..., sum(factors)) a value for every digit of every factor.
      factors: numbers of digits.

    Returns:
      (..., prod(factors))
    """
    values = branches[..., : factors[0]]
    start = factors[0]
    for levels in factors[1:]:
        branch = branches[..., start : start + levels]
        start += levels
        values = values[..., :, None] + branch[..., None, :]
        values = values.reshape(*values.shape[:-2], math.prod(values.shape[-2:]))
    return values


def points(factors: Sequence[int]) -> np.ndarray:
    """Where the radial head places the actions: (prod(factors), len(factors)), -1 to 1."""
    axes = [np.linspace(-1, 1, levels) for levels in factors]
    grid = np.stack(np.meshgrid(*axes, indexing="ij"), axis=-1)
    return grid.reshape(-1, len(factors)).astype(np.float32)


def radial(out: Any, profile: Any, stretch: Any, points: Any) -> Any:
    """The value of an action by its distance from the best point.

        Q(s, a) = V(s) + alpha * exp(-beta * z) - kappa * z
        z = sqrt(delta^2 + |exp(stretch) * (x(a) - mu(s))|^2)

    Args:
      out: (..., 1 + factors) V and mu.
      profile: (4,) alpha, beta, kappa and delta before softplus makes them positive.
      stretch: (factors,) logarithm of each axis' scale.
      points: (num_actions, factors) x of every action.

    Returns:
      (..., num_actions)
    """
    xp = out.__array_namespace__()
    value, best = out[..., :1], out[..., 1:]
    alpha, beta, kappa, delta = xp.logaddexp(profile, xp.zeros_like(profile))
    away = (points - best[..., None, :]) * xp.exp(stretch)
    z = xp.sqrt(delta**2 + xp.sum(away**2, axis=-1))
    return value + alpha * xp.exp(-beta * z) - kappa * z
