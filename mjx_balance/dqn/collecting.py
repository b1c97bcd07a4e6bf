"""Batched envs: fresh ones, one step of all of them, and a reset of those that are done."""

from collections.abc import Callable
from typing import TypeAlias

import jax
import jax.numpy as jnp
from brax.envs.base import Env, State

from mjx_balance.dqn.devices import AXIS
from mjx_balance.dqn.replay import Transition

Reset: TypeAlias = Callable[[jax.Array], State]
"""PRNG key -> a fresh env."""
Metrics: TypeAlias = dict[str, jax.Array]


def fresh(reset: Reset, key: jax.Array, count: int) -> State:
    """`count` fresh envs, (count, ...) per leaf."""
    return jax.vmap(reset)(jax.random.split(key, count))


def reset_done(reset: Reset, state: State, key: jax.Array) -> State:
    """Replaces those of the batched env states that are done by fresh ones."""
    new = fresh(reset, key, state.reward.shape[0])
    done = state.done.astype(bool)

    def choose(new: jax.Array, old: jax.Array) -> jax.Array:
        return jnp.where(done.reshape(-1, *[1] * (old.ndim - 1)), new, old)

    return jax.tree.map(choose, new, state)


def collect(
    env: Env, before: State, action: jax.Array, key: jax.Array
) -> tuple[State, Transition, Metrics]:
    """Steps this device's envs once and resets those that are done.

    Args:
      env: of one robot, or whatever it is.
      before: (envs, ...) per leaf.
      action: (envs,)
      key: for the resets.

    Returns:
      The envs, resets done; what happened, before any reset; means over all devices' envs.
    """
    after = jax.vmap(env.step)(before, action)
    truncation = after.info.get("truncation", jnp.zeros_like(after.done))
    transition = Transition(
        obs=array(before.obs),
        action=action,
        reward=after.reward,
        terminated=after.done * (1 - truncation),
        next_obs=array(after.obs),
    )
    metrics = jax.tree.map(jnp.mean, after.metrics | {"reward": after.reward})
    return reset_done(env.reset, after, key), transition, jax.lax.pmean(metrics, AXIS)


def array(obs: object) -> jax.Array:
    """The observation of an env; brax allows dictionaries, this learner takes arrays.

    Raises:
      TypeError: for anything else.
    """
    if not isinstance(obs, jax.Array):
        raise TypeError(f"the env observes {type(obs).__name__}; this learner takes arrays")
    return obs
