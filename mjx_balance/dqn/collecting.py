"""Batched envs: fresh ones, one step of all of them, and a reset of those that are done.

An env that shows anything but finite numbers has diverged: it counts as done, and its
transition is not stored.
"""

from collections.abc import Callable
from typing import NamedTuple, TypeAlias

import jax
import jax.numpy as jnp
from brax.envs.base import Env, State

from mjx_balance.dqn.devices import AXIS
from mjx_balance.dqn.means import Mean, mean_where
from mjx_balance.dqn.replay import Transition

Reset: TypeAlias = Callable[[jax.Array], State]
"""PRNG key -> a fresh env."""


class Collected(NamedTuple):
    """What one step of this device's envs gave."""

    env_state: State
    """(envs, ...) per leaf, those that were done reset."""
    transition: Transition
    """(envs, ...) per field, before any reset; in place of a diverged env's stands another's."""
    storable: jax.Array
    """() whether every device has an env that did not diverge."""
    metrics: dict[str, Mean]
    """Over all devices: the env's own, `reward`, and `diverged`, the share of the envs."""


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


def collect(env: Env, before: State, action: jax.Array, key: jax.Array) -> Collected:
    """Steps this device's envs once and resets those that are done.

    Args:
      env: of one robot, or whatever it is.
      before: (envs, ...) per leaf.
      action: (envs,)
      key: for the resets.
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
    sound = jax.vmap(finite)(transition)
    after = after.replace(done=jnp.where(sound, after.done, 1.0))  # pyright: ignore
    row = jnp.where(sound, jnp.arange(len(sound)), jnp.argmax(sound))
    everywhere = jax.lax.pmin(sound.any().astype(jnp.int32), AXIS) > 0
    return Collected(
        env_state=reset_done(env.reset, after, key),
        transition=jax.tree.map(lambda x: x[row], transition),
        storable=everywhere,
        metrics=_measured(after, sound),
    )


def finite(tree: object) -> jax.Array:
    """() whether every number of a pytree is finite."""
    return jnp.stack([jnp.isfinite(x).all() for x in jax.tree.leaves(tree)]).all()


def _measured(after: State, sound: jax.Array) -> dict[str, Mean]:
    own = dict(after.metrics)
    diverged = jnp.where(sound, own.pop("diverged", jnp.zeros_like(after.done)), 1.0)
    metrics = {name: mean_where(x, sound) for name, x in (own | {"reward": after.reward}).items()}
    return metrics | {"diverged": mean_where(diverged, jnp.ones_like(sound))}


def array(obs: object) -> jax.Array:
    """The observation of an env; brax allows dictionaries, this learner takes arrays.

    Raises:
      TypeError: for anything else.
    """
    if not isinstance(obs, jax.Array):
        raise TypeError(f"the env observes {type(obs).__name__}; this learner takes arrays")
    return obs
