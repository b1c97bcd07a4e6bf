"""From the best action to the one taken: epsilon-greedy, and noise around what it picks."""

import math
from collections.abc import Sequence

import jax
import jax.numpy as jnp

from mjx_balance.config import DQNConfig


def epsilon(config: DQNConfig, env_steps: jax.Array) -> jax.Array:
    """Share of random actions: linear from epsilon_start to epsilon_end, then flat.

    epsilon = start + (end - start) * min(env_steps / epsilon_decay_steps, 1)
    """
    share = jnp.minimum(env_steps / config.epsilon_decay_steps, 1.0)
    return config.epsilon_start + (config.epsilon_end - config.epsilon_start) * share


def epsilon_greedy(
    key: jax.Array, greedy: jax.Array, rate: jax.Array, num_actions: int
) -> jax.Array:
    """The action index `greedy` (), or with probability `rate` any, all equally likely."""
    key_which, key_random = jax.random.split(key)
    random = jax.random.randint(key_random, (), 0, num_actions)
    return jnp.where(jax.random.bernoulli(key_which, rate), random, greedy.astype(random.dtype))


def exploration_noise(
    key: jax.Array, action: jax.Array, factors: Sequence[int], levels: int
) -> jax.Array:
    """Moves an action by up to `levels` on each factor of its index, uniformly.

    A greedy action alone shows a reward near its peak, which says how far off it was but
    not to which side; its neighbours do.

    Args:
      key: PRNG key.
      action: () index, a mixed-radix number.
      factors: sizes of its digits.
      levels: greatest move; digits stop at their ends.
    """
    move = jax.random.randint(key, (len(factors),), -levels, levels + 1)
    digits = jnp.stack(jnp.unravel_index(action, tuple(factors))) + move
    digits = jnp.clip(digits, 0, jnp.asarray(factors) - 1)
    return jnp.ravel_multi_index(tuple(digits), tuple(factors), mode="clip").astype(action.dtype)


def explore(
    key: jax.Array, greedy: jax.Array, rate: jax.Array, factors: Sequence[int], levels: int
) -> jax.Array:
    """The action () of one env in training.

    Args:
      key: PRNG key.
      greedy: () index of the best action.
      rate: () share of random actions.
      factors: sizes of the action index' digits.
      levels: of noise; 0 for none.
    """
    key, key_noise = jax.random.split(key)
    action = epsilon_greedy(key, greedy, rate, math.prod(factors))
    return exploration_noise(key_noise, action, factors, levels) if levels else action
