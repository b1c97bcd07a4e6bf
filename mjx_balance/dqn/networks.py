"""Q-networks."""

import math
from collections.abc import Sequence

import flax.linen as nn
import jax


class QNetwork(nn.Module):
    """A multilayer perceptron from an observation to one value per action.

    With `factors` = (num_actions,) the last layer has one output per action (the
    paper's network). With more factors, as in (21, 21), it has one output per level
    of each, and an action's value is the sum over its factors: a linear
    decomposition of the joint action value (Tavakoli et al. 2021,
    https://arxiv.org/abs/2010.14680, section 3, hyperedges of rank one).
    """

    hidden_sizes: Sequence[int]
    factors: Sequence[int]

    @nn.compact
    def __call__(self, obs: jax.Array) -> jax.Array:
        """Maps obs (..., obs_size) to action values (..., prod(factors))."""
        x = obs
        for i, width in enumerate(self.hidden_sizes):
            x = nn.relu(nn.Dense(width, name=f"hidden_{i}")(x))
        branches = nn.Dense(sum(self.factors), name="head")(x)
        values = branches[..., : self.factors[0]]
        start = self.factors[0]
        for levels in self.factors[1:]:
            branch = branches[..., start : start + levels]
            start += levels
            values = values[..., :, None] + branch[..., None, :]
            values = values.reshape(*values.shape[:-2], math.prod(values.shape[-2:]))
        return values
