"""The env where somebody else's code has changed JAX's default types: its own stay 32 bits wide."""

import dataclasses
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from brax.envs.wrappers.training import EvalWrapper

from mjx_balance.config import Config, preset
from mjx_balance.envs.balance import BalanceEnv
from mjx_balance.envs.brax import wrap

TYPES = {"float32", "int32", "uint32"}


@pytest.fixture(scope="module")
def config() -> Config:
    """All that is drawn at random: scenarios, domain parameters, noise, pushes."""
    return dataclasses.replace(preset("best"), engine="mujoco")


def types(tree: Any) -> list[str]:
    return [str(x.dtype) for x in jax.tree.leaves(tree)]


@pytest.mark.parametrize(
    ("engine", "kind", "action"),
    [
        ("mujoco", "discrete", np.int64(220)),
        ("mujoco", "discrete", np.uint8(220)),
        ("mujoco", "continuous", np.zeros(2)),
        ("mujoco", "continuous", np.zeros(2, np.float16)),
        pytest.param("mjx", "discrete", np.int64(220), marks=pytest.mark.slow),
    ],
)
def test_a_step_keeps_all_types(engine: str, kind: str, action: Any, config: Config) -> None:
    """64 bits on, and actions of any width: the state can be carried through a scan.

    JAX traced with 32 bits before, in the same process: the two may be mixed.
    """
    env = BalanceEnv(dataclasses.replace(config, engine=engine), kind)
    for wide, reset in ((False, env.reset), (True, env.reset), (True, env.reset_staggered)):
        with jax.enable_x64(wide):
            state = jax.eval_shape(reset, jax.random.PRNGKey(0))
            assert set(types(state)) == TYPES
            after = jax.eval_shape(env.step, state, jnp.asarray(action))
            assert types(after) == types(state)


def test_braxs_evaluation_wrapper_scans(config: Config) -> None:
    with jax.enable_x64(True):
        env = EvalWrapper(wrap(BalanceEnv(config, "continuous"), 20))
        keys = jax.random.split(jax.random.PRNGKey(0), 3)

        def step(state: Any, _: Any) -> Any:
            after = env.step(state, jnp.zeros((3, 2)))
            return after, after.reward

        _, rewards = jax.eval_shape(lambda: jax.lax.scan(step, env.reset(keys), length=2))
        assert (rewards.shape, str(rewards.dtype)) == ((2, 3), "float32")


@pytest.mark.slow  # two compilations
def test_64_bits_change_no_number(config: Config) -> None:
    env = BalanceEnv(config, "discrete")

    def roll(key: jax.Array) -> Any:
        state = env.reset(key)
        for action in (220, 3, 440):
            state = env.step(state, jnp.asarray(action))
        return state

    narrow = jax.jit(roll)(jax.random.PRNGKey(7))
    with jax.enable_x64(True):
        wide = jax.jit(roll)(jax.random.PRNGKey(7))
    jax.tree.map(np.testing.assert_array_equal, wide, narrow)
