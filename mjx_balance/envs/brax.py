"""A wrapper of `BalanceEnv` for brax's trainers: `ppo.train(env, wrap_env_fn=wrap, ...)`.

brax's own wrapper resets an env to its first `pipeline_state` and observation and keeps `info`: all
episodes of an env would have the same scenario and domain parameters, and its sensor noise would
continue with the old key.
"""

from collections.abc import Sequence
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from brax.envs.base import Env, State, Wrapper
from brax.envs.wrappers.training import AutoResetWrapper, EpisodeWrapper, VmapWrapper
from jax.sharding import Mesh, NamedSharding, PartitionSpec

from mjx_balance.envs.balance import BalanceEnv


def _device_put_replicated(tree: Any, devices: Sequence[Any]) -> Any:
    """Copies every leaf (...) to (devices, ...), one copy per device."""
    sharding = NamedSharding(Mesh(np.asarray(devices), ("device",)), PartitionSpec("device"))
    return jax.tree.map(
        lambda leaf: jax.device_put(jnp.stack([leaf] * len(devices)), sharding), tree
    )


# JAX 0.10 removed this function, which PPO and SAC of brax 0.14.2 call (google/brax issue 671).
# To be deleted with the first release of brax that no longer does.
if not hasattr(jax, "device_put_replicated"):
    jax.device_put_replicated = _device_put_replicated


def wrap(
    env: BalanceEnv, episode_length: int, action_repeat: int = 1, randomization_fn: Any = None
) -> Wrapper:
    """As `brax.envs.training.wrap`, but every episode is a new scenario.

    Raises:
      ValueError: if `episode_length` is above the env's own, or there is a randomization_fn: the
        env's config says how domain parameters are drawn.
    """
    longest = env.config.task.episode_length
    if episode_length > longest:
        raise ValueError(f"episode_length is {episode_length}; scenarios end after {longest}")
    if randomization_fn is not None:
        raise ValueError("randomization_fn is given; BalanceEnv randomises by its config instead")
    return _NewScenarios(EpisodeWrapper(VmapWrapper(_Endless(env)), episode_length, action_repeat))


class _Endless(Wrapper):
    """Leaves the time limit to brax, which takes any other end for a failure."""

    def step(self, state: State, action: jax.Array) -> State:
        after = self.env.step(state, action)
        return after.replace(  # pyright: ignore[reportAttributeAccessIssue]
            done=after.done * (1 - after.info["truncation"])
        )


class _NewScenarios(AutoResetWrapper):
    """brax's automatic reset, but to a new episode: all of its state from a fresh key."""

    def __init__(self, env: Env):
        super().__init__(env)
        key = jax.eval_shape(lambda: jax.random.PRNGKey(0))
        start = jax.eval_shape(env.unwrapped.reset, key)
        self._own = sorted({*start.info.keys(), "next_key"} - {"truncation"})

    def reset(self, rng: jax.Array) -> State:
        """Starts episodes from keys (n, 2)."""
        rng, following = jnp.moveaxis(jax.vmap(jax.random.split)(rng), 1, 0)
        state = super().reset(rng)
        # brax makes its own of JAX's default type, which may have 64 bits.
        info = jax.tree.map(lambda x: x.astype(jnp.float32) if x.dtype == float else x, state.info)
        info["next_key"] = following
        return state.replace(info=info)  # pyright: ignore[reportAttributeAccessIssue]

    def step(self, state: State, action: jax.Array) -> State:
        """Takes one decision of every env; `obs` of one that is over is the next episode's."""
        after = super().step(state, action)
        start = self.reset(after.info["next_key"])

        def choose(new: jax.Array, old: jax.Array) -> jax.Array:
            return jnp.where(after.done.reshape(-1, *[1] * (old.ndim - 1)) > 0, new, old)

        info = {name: choose(start.info[name], after.info[name]) for name in self._own}
        return after.replace(  # pyright: ignore[reportAttributeAccessIssue]
            pipeline_state=jax.tree.map(choose, start.pipeline_state, after.pipeline_state),
            obs=jax.tree.map(choose, start.obs, after.obs),
            info=after.info | info,
        )
