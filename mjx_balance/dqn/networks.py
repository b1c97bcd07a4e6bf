"""Q-networks."""

from collections.abc import Sequence
from typing import Any

import flax.linen as nn
import jax
import jax.numpy as jnp

from mjx_balance.policy import heads


class QNetwork(nn.Module):
    """A multilayer perceptron from an observation to one value per action.

    With `factors` = (num_actions,) the last layer has one output per action (the
    paper's network). With more factors, as in (21, 21), it has one output per level
    of each, and an action's value is the sum over its factors: a linear
    decomposition of the joint action value (Tavakoli et al. 2021,
    https://arxiv.org/abs/2010.14680, section 3, hyperedges of rank one).

    With `radial`, the levels are points x from -1 to 1 on one axis per factor, and the
    network says where the best point mu is and what it is worth (`heads.Radial`).
    It is the idea of normalized advantage functions (Gu et al. 2016,
    https://arxiv.org/abs/1603.00748, section 4), a value that falls off around a best
    action, with a learned profile instead of a parabola, on a grid of actions. mu and V
    also see the observation past the hidden layers, so that a linear law is easy; the
    profile and the axes' scales are parameters that no state changes.
    """

    hidden_sizes: Sequence[int]
    factors: Sequence[int]
    radial: bool = False

    def __call__(self, obs: jax.Array) -> jax.Array:
        """Maps obs (..., obs_size) to action values (..., prod(factors))."""
        return self.head(obs).q_values()

    @nn.compact
    def head(self, obs: jax.Array) -> heads.Head:
        """The action values of obs (..., obs_size), as a head that can be asked for some."""
        x = obs
        for i, width in enumerate(self.hidden_sizes):
            x = nn.relu(nn.Dense(width, name=f"hidden_{i}")(x))
        factors = tuple(self.factors)
        if not self.radial:
            return heads.Additive(nn.Dense(sum(factors), name="head")(x), factors)
        out = nn.Dense(1 + len(factors), name="head")(jnp.concatenate((x, obs), axis=-1))
        profile = self.param("profile", nn.initializers.zeros, (4,))
        stretch = self.param("stretch", nn.initializers.zeros, (len(factors),))
        return heads.Radial(out, profile, stretch, factors)

    def fold_whitening(self, params: Any, mean: jax.Array, matrix: jax.Array) -> Any:
        """Parameters that give for obs what `params` give for (obs - mean) @ matrix.

        Args:
          params: this network's variables.
          mean: (obs_size,)
          matrix: (obs_size, obs_size)
        """
        layers = dict(params["params"])
        entrances = [("hidden_0" if self.hidden_sizes else "head", 0)]
        if self.radial:  # the head also sees the observation itself, behind the last layer
            entrances.append(("head", self.hidden_sizes[-1] if self.hidden_sizes else len(mean)))
        for name, first in entrances:
            kernel, bias = layers[name]["kernel"], layers[name]["bias"]
            rows = matrix @ kernel[first : first + len(mean)]
            bias = bias - mean @ rows
            layers[name] = {
                "kernel": kernel.at[first : first + len(mean)].set(rows),
                "bias": bias,
            }
        return {"params": layers}
