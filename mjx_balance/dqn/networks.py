"""Q-networks."""

import math
from collections.abc import Sequence
from typing import Any

import flax.linen as nn
import jax
import jax.numpy as jnp
import numpy as np


def fold_inputs(params: Any, mean: jax.Array, matrix: jax.Array) -> Any:
    """Parameters that give for obs what `params` give for (obs - mean) @ matrix.

    Args:
      params: variables of a `QNetwork` with at least one hidden layer.
      mean: (obs_size,)
      matrix: (obs_size, obs_size)
    """
    layers = dict(params["params"])

    def folded(layer: Any, first: int) -> dict[str, jax.Array]:
        kernel = layer["kernel"]
        rows = matrix @ kernel[first : first + len(mean)]
        bias = layer["bias"] - mean @ rows
        return {"kernel": kernel.at[first : first + len(mean)].set(rows), "bias": bias}

    layers["hidden_0"] = folded(layers["hidden_0"], 0)
    hidden = max(int(name[7:]) for name in layers if name.startswith("hidden_"))
    width = len(layers[f"hidden_{hidden}"]["bias"])
    if len(layers["head"]["kernel"]) > width:  # it also sees the observation itself
        layers["head"] = folded(layers["head"], width)
    return {"params": layers}


class QNetwork(nn.Module):
    """A multilayer perceptron from an observation to one value per action.

    With `factors` = (num_actions,) the last layer has one output per action (the
    paper's network). With more factors, as in (21, 21), it has one output per level
    of each, and an action's value is the sum over its factors: a linear
    decomposition of the joint action value (Tavakoli et al. 2021,
    https://arxiv.org/abs/2010.14680, section 3, hyperedges of rank one).

    With `radial`, the levels are points x from -1 to 1 on one axis per factor, and the
    network says where the best point mu is and what it is worth:

        Q(s, a) = V(s) + alpha * exp(-beta * z) - kappa * z
        z = sqrt(delta^2 + |k * (x(a) - mu(s))|^2)

    alpha, beta, kappa, delta > 0 and k (factors,) are parameters that no state changes.
    It is the idea of normalized advantage functions (Gu et al. 2016,
    https://arxiv.org/abs/1603.00748, section 4), a value that falls off around a best
    action, with a learned profile instead of a parabola, on a grid of actions. mu and V
    also see the observation past the hidden layers, so that a linear law is easy.
    """

    hidden_sizes: Sequence[int]
    factors: Sequence[int]
    radial: bool = False

    @nn.compact
    def __call__(self, obs: jax.Array) -> jax.Array:
        """Maps obs (..., obs_size) to action values (..., prod(factors))."""
        x = obs
        for i, width in enumerate(self.hidden_sizes):
            x = nn.relu(nn.Dense(width, name=f"hidden_{i}")(x))
        if self.radial:
            return self._radial(jnp.concatenate((x, obs), axis=-1))
        branches = nn.Dense(sum(self.factors), name="head")(x)
        values = branches[..., : self.factors[0]]
        start = self.factors[0]
        for levels in self.factors[1:]:
            branch = branches[..., start : start + levels]
            start += levels
            values = values[..., :, None] + branch[..., None, :]
            values = values.reshape(*values.shape[:-2], math.prod(values.shape[-2:]))
        return values

    def _radial(self, features: jax.Array) -> jax.Array:
        out = nn.Dense(1 + len(self.factors), name="head")(features)
        value, best = out[..., :1], out[..., 1:]
        shape = self.param("profile", nn.initializers.zeros, (4,))
        stretch = self.param("stretch", nn.initializers.zeros, (len(self.factors),))
        alpha, beta, kappa, delta = nn.softplus(shape)
        axes = [np.linspace(-1, 1, levels) for levels in self.factors]
        points = np.stack(np.meshgrid(*axes, indexing="ij"), axis=-1)
        points = points.reshape(-1, len(self.factors)).astype(np.float32)
        away = (points - best[..., None, :]) * jnp.exp(stretch)
        z = jnp.sqrt(delta**2 + jnp.sum(away**2, axis=-1))
        return value + alpha * jnp.exp(-beta * z) - kappa * z
