"""The adapter of `examples/train_rejax.py`; rejax itself is not needed."""

import dataclasses
import runpy
from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from mjx_balance.config import preset
from mjx_balance.envs.balance import BalanceEnv

EXAMPLE = Path(__file__).parents[2] / "examples" / "train_rejax.py"
EPISODE, STEPS = 8, 20
ACTIONS = jnp.array([[1.0, 0.0], [0.0, 0.0]])  # the first robot falls after five or six, and again


def test_a_step_starts_the_next_episode_and_only_a_fall_is_done() -> None:
    default = preset("default")
    task = dataclasses.replace(default.task, episode_length=EPISODE)
    env = BalanceEnv(dataclasses.replace(default, engine="mujoco", task=task), "continuous")
    adapter = runpy.run_path(str(EXAMPLE))["GymnaxEnv"](env)
    first = jax.random.split(jax.random.PRNGKey(0), len(ACTIONS))
    keys = jax.random.split(jax.random.PRNGKey(1), (STEPS, len(ACTIONS)))

    @jax.jit
    def run() -> Any:
        def body(state: Any, keys: jax.Array) -> Any:
            obs, state, reward, done, _ = jax.vmap(adapter.step)(keys, state, ACTIONS)
            return state, (obs, reward, done)

        obs, state = jax.vmap(adapter.reset)(first)
        return obs, jax.lax.scan(body, state, keys)[1]

    started, (obs, rewards, done) = jax.device_get(run())
    step, reset = jax.jit(jax.vmap(env.step)), jax.jit(jax.vmap(env.reset))
    state = jax.jit(jax.vmap(env.reset_staggered))(first)
    np.testing.assert_array_equal(started, state.obs)
    falls, limits = 0, 0
    for k in range(STEPS):
        after, start = step(state, ACTIONS), reset(keys[k])
        over, late = after.done > 0, after.info["truncation"] > 0
        np.testing.assert_array_equal(rewards[k], after.reward)
        np.testing.assert_array_equal(done[k], over & ~late)

        def choose(new: jax.Array, old: jax.Array, over: jax.Array = over) -> jax.Array:
            return jnp.where(over.reshape(-1, *[1] * (old.ndim - 1)), new, old)

        state = jax.tree.map(choose, start, after)
        np.testing.assert_array_equal(obs[k], state.obs)
        falls, limits = falls + int((over & ~late).sum()), limits + int(late.sum())
    assert falls >= 2
    assert limits >= 2
