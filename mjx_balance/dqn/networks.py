"""Our Q-network, and the protocol for any other."""

from collections.abc import Sequence
from typing import Any, NamedTuple, Protocol

import flax.linen as nn
import jax
import jax.numpy as jnp

from mjx_balance.policy import heads


class Network(Protocol):
    """Methods that a network must have. A flax module whose call returns action values has them.

    A network may have three more methods, as `QNetwork` has:

    - `head(obs)`, a head (`policy.heads`) instead of action values. With actions off the grid it
      must be a radial one.
    - `fold_whitening(params, mean, matrix)`. Without it, observations are whitened before the call.
    - `fold_rest(params)`, for `DQNConfig.zero_at_rest`.
    """

    def init(self, key: Any, obs: Any, /) -> Any:
        """Returns parameters, a pytree, from a PRNG key and an observation (obs_size,)."""
        ...

    def apply(self, params: Any, obs: Any, /, **method: Any) -> Any:
        """Returns action values (..., num_actions) of observations (..., obs_size)."""
        ...


class Whitened(NamedTuple):
    """Parameters of a network that sees whitened observations, with the whitening."""

    params: Any
    mean: jax.Array  #: (obs_size,)
    matrix: jax.Array  #: (obs_size, obs_size)


class QNetwork(nn.Module):
    """A multilayer perceptron from an observation to one value per action.

    With `factors` = (num_actions,) the last layer has one output per action (the paper's network).
    With more factors, as in (21, 21), it has one output per level of each, and the value of an
    action is their sum: a linear decomposition of the joint action value (Tavakoli et al. 2021,
    https://arxiv.org/abs/2010.14680, section 3, hyperedges of rank one).

    With `radial`, the levels are points from -1 to 1 on one axis per factor, and the network
    outputs the best point mu and its value V (`heads.Radial`), as in normalized advantage functions
    (Gu et al. 2016, https://arxiv.org/abs/1603.00748, section 4), but on a grid and with a learned
    profile instead of a parabola. A skip connection from the observation to mu and V makes linear
    control laws easy. Profile and scales of the axes do not depend on the state.
    """

    hidden_sizes: Sequence[int]
    factors: Sequence[int]
    radial: bool = False

    def __call__(self, obs: jax.Array) -> jax.Array:
        """Maps obs (..., obs_size) to action values (..., prod(factors))."""
        return self.head(obs).q_values()

    @nn.compact
    def head(self, obs: jax.Array) -> heads.Head:
        """Maps obs (..., obs_size) to a head."""
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

    def fold_rest(self, params: Any) -> Any:
        """Returns parameters of a radial network whose mu is 0 for an observation of zeros."""
        layers = dict(params["params"])
        obs_size = layers["hidden_0"]["kernel"].shape[0]
        rest: Any = self.apply(params, jnp.zeros(obs_size), method="head")
        kernel, bias = layers["head"]["kernel"], layers["head"]["bias"]
        layers["head"] = {"kernel": kernel, "bias": bias.at[1:].add(-rest.out[1:])}
        return {"params": layers}

    def fold_whitening(self, params: Any, mean: jax.Array, matrix: jax.Array) -> Any:
        """Returns parameters for obs that equal `params` for (obs - mean) @ matrix.

        Args:
          params: this network's variables.
          mean: (obs_size,)
          matrix: (obs_size, obs_size)
        """
        layers = dict(params["params"])
        input_kernels = [("hidden_0", 0)]  # layer, first row that multiplies the observation
        if self.radial:
            input_kernels.append(("head", self.hidden_sizes[-1]))
        for name, first in input_kernels:
            kernel, bias = layers[name]["kernel"], layers[name]["bias"]
            rows = matrix @ kernel[first : first + len(mean)]
            kernel = kernel.at[first : first + len(mean)].set(rows)
            layers[name] = {"kernel": kernel, "bias": bias - mean @ rows}
        return {"params": layers}
