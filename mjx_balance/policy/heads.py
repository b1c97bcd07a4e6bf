"""Heads of a Q-network: action values from the outputs of the last layer.

They work on NumPy arrays (the exported policy) and JAX arrays (training). An action index is a
mixed-radix number with one digit per factor. `q_value` and `argmax` do not compute the values of
all actions. `RadialPoints` has the same values for actions that are points, on the grid or off it.
"""

import dataclasses
import functools
import math
from collections.abc import Sequence
from typing import Any

import numpy as np


@dataclasses.dataclass(frozen=True)
class Additive:
    """The value of an action is the sum of the values of its digits."""

    branches: Any  #: (..., sum(factors)) a value for every digit of every factor
    factors: tuple[int, ...]  #: number of levels of each digit

    def q_values(self) -> Any:
        """Values of all actions, (..., prod(factors))."""
        values, *others = self._split()
        for branch in others:
            values = values[..., :, None] + branch[..., None, :]
            values = values.reshape(*values.shape[:-2], math.prod(values.shape[-2:]))
        return values

    def q_value(self, action: Any) -> Any:
        """Values (...) of action indices (...)."""
        xp = self.branches.__array_namespace__()
        digits = xp.unravel_index(action, self.factors)
        pairs = zip(self._split(), digits, strict=True)
        return sum(xp.take_along_axis(x, digit[..., None], axis=-1)[..., 0] for x, digit in pairs)

    def argmax(self) -> Any:
        """Indices (...) of the best actions: the best digit of every factor."""
        xp = self.branches.__array_namespace__()
        return _index([xp.argmax(branch, axis=-1) for branch in self._split()], self.factors)

    def _split(self) -> list[Any]:
        ends = np.cumsum(self.factors)
        pairs = zip(ends - self.factors, ends, strict=True)
        return [self.branches[..., start:end] for start, end in pairs]


@dataclasses.dataclass(frozen=True)
class Radial:
    """The value of an action falls with its distance from the best point mu.

    Q(s, a) = V(s) + alpha * exp(-beta * z) - kappa * z
    z = sqrt(delta^2 + |exp(stretch) * (x(a) - mu(s))|^2)
    """

    out: Any  #: (..., 1 + len(factors)) V and mu
    profile: Any  #: (4,) alpha, beta, kappa and delta, before softplus
    stretch: Any  #: (len(factors),) logarithm of each axis' scale
    factors: tuple[int, ...]  #: number of points on each axis

    def q_values(self) -> Any:
        """Values of all actions, (..., prod(factors))."""
        return Radial(self.out[..., None, :], self.profile, self.stretch, self.factors).q_value(
            np.arange(math.prod(self.factors))
        )

    def q_value(self, action: Any) -> Any:
        """Values (...) of action indices (...)."""
        xp = self.out.__array_namespace__()
        return self.value_at(xp.asarray(points(self.factors))[action])

    def value_at(self, point: Any) -> Any:
        """Values (...) of points x(a), (..., len(factors))."""
        xp = self.out.__array_namespace__()
        alpha, beta, kappa, delta = xp.logaddexp(self.profile, xp.zeros_like(self.profile))
        away = point - self.out[..., 1:]
        z = xp.sqrt(delta**2 + xp.sum((away * xp.exp(self.stretch)) ** 2, axis=-1))
        return self.out[..., 0] + alpha * xp.exp(-beta * z) - kappa * z

    def argmax(self) -> Any:
        """Indices (...) of the best actions: the point nearest to mu on every axis."""
        xp = self.out.__array_namespace__()
        last = np.asarray(self.factors, np.float32) - 1
        nearest = xp.clip(xp.rint((self.out[..., 1:] + 1) * last / 2), 0, last)
        digits = xp.nan_to_num(nearest).astype(np.int32)
        return _index([digits[..., k] for k in range(len(self.factors))], self.factors)

    def peak(self) -> Any:
        """The best point within the grid's range, (..., len(factors)), -1 to 1.

        `argmax` is the grid's point nearest to it, also where mu is NaN: there it is -1.
        """
        xp = self.out.__array_namespace__()
        return xp.clip(xp.nan_to_num(self.out[..., 1:], nan=-1.0), -1, 1)

    def off_grid(self) -> "RadialPoints":
        """The same head for actions that are points."""
        return RadialPoints(self.out, self.profile, self.stretch, self.factors)


class RadialPoints(Radial):
    """A radial head whose actions are points (..., len(factors)), -1 to 1, instead of indices.

    The value falls with the distance on every axis, so of all points in the square the nearest to
    mu is the best.
    """

    def q_value(self, action: Any) -> Any:
        """Values (...) of points (..., len(factors))."""
        return self.value_at(action)

    def argmax(self) -> Any:
        """The best points (..., len(factors))."""
        return self.peak()


Head = Additive | Radial


@functools.cache
def points(factors: tuple[int, ...]) -> np.ndarray:
    """The radial head's points x(a) of all actions, (prod(factors), len(factors)), -1 to 1."""
    axes = [np.linspace(-1, 1, levels) for levels in factors]
    grid = np.stack(np.meshgrid(*axes, indexing="ij"), axis=-1)
    return grid.reshape(-1, len(factors)).astype(np.float32)


def _index(digits: Sequence[Any], factors: Sequence[int]) -> Any:
    """Action indices (...) from their digits (...)."""
    index = digits[0]
    for digit, levels in zip(digits[1:], factors[1:], strict=True):
        index = index * levels + digit
    return index
