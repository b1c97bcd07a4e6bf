"""BalanceEnv in MJX: one compiled program serves all tests of this module."""

import dataclasses
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from mjx_balance.config import Config, preset
from mjx_balance.env import BalanceEnv
from mjx_balance.evaluation import roll_out
from mjx_balance.task.tilt import Scenario

ENVS, DECISIONS, EPISODE = 64, 160, 60
CHUNK = 5
"""Decisions of one call of the compiled program."""


class Episode(NamedTuple):
    """What every decision of every env gave, (decisions, ENVS, ...)."""

    obs: Any
    reward: Any
    done: Any
    truncation: Any
    tilt: Any
    fall: Any
    next_start: Any


@pytest.fixture(scope="module")
def config() -> Config:
    base = preset("default")
    return dataclasses.replace(base, task=dataclasses.replace(base.task, episode_length=EPISODE))


@pytest.fixture(scope="module")
def env(config: Config) -> BalanceEnv:
    return BalanceEnv(config)


@pytest.fixture(scope="module")
def reset(env: BalanceEnv):
    return jax.jit(jax.vmap(env.reset))


@pytest.fixture(scope="module")
def run(env: BalanceEnv):
    """Steps all envs through CHUNK given actions, resetting those that are done."""

    def one(state, inputs):
        actions, key = inputs
        after = jax.vmap(env.step)(state, actions)
        fresh = jax.vmap(env.reset)(jax.random.split(key, ENVS))
        done = after.done.astype(bool)
        state = jax.tree.map(
            lambda new, old: jnp.where(done.reshape(-1, *[1] * (old.ndim - 1)), new, old),
            fresh,
            after,
        )
        seen = Episode(
            after.obs,
            after.reward,
            after.done,
            after.info["truncation"],
            after.metrics["tilt_deg"],
            after.metrics["fall"],
            state.info["memory"].imu,
        )
        return state, seen

    return jax.jit(lambda state, inputs: jax.lax.scan(one, state, inputs))


@pytest.fixture(scope="module")
def random_episode(env: BalanceEnv, reset, run) -> Episode:
    """10,240 random decisions."""
    state = reset(jax.random.split(jax.random.PRNGKey(0), ENVS))
    shape = (DECISIONS // CHUNK, CHUNK, ENVS)
    chunks = []
    for actions, key in zip(
        jax.random.randint(jax.random.PRNGKey(1), shape, 0, env.action_size),
        jax.random.split(jax.random.PRNGKey(2), shape[0]),
        strict=True,
    ):
        state, seen = run(state, (actions, jax.random.split(key, CHUNK)))
        chunks.append(jax.device_get(seen))
    return jax.tree.map(lambda *parts: np.concatenate(parts), *chunks)


def test_starts_settled_and_level(env: BalanceEnv) -> None:
    state = env.reset(jax.random.PRNGKey(0))
    obs = np.asarray(state.obs)
    assert obs.shape == (env.observation_size,) == (34,)
    # In units of 1 cm, 1 deg/s and 1 deg: nothing moves, nothing tilts.
    np.testing.assert_allclose(obs, 0, atol=0.03)
    assert env.action_size == 441


def test_every_reset_draws_another_scenario(reset) -> None:
    state = reset(jax.random.split(jax.random.PRNGKey(3), ENVS))
    targets = np.asarray(state.info["scenario"].targets)
    assert len(np.unique(targets[:, 1, 0])) == ENVS
    assert len(np.unique(np.asarray(state.info["scenario"].phase))) == ENVS


def test_nothing_is_nan_over_ten_thousand_random_decisions(random_episode: Episode) -> None:
    for name, values in random_episode._asdict().items():
        assert np.isfinite(values).all(), name


def test_random_actions_fall_and_falls_are_not_time_outs(random_episode: Episode) -> None:
    seen = random_episode
    fell, truncated = seen.fall.astype(bool), seen.truncation.astype(bool)
    assert fell.any()
    assert truncated.any()
    assert not (fell & truncated).any()
    np.testing.assert_array_equal(seen.done.astype(bool), fell | truncated)
    assert (seen.reward[fell] < 0).all()


def test_episodes_end_by_the_time_limit(random_episode: Episode) -> None:
    for env in range(ENVS):
        ends = np.flatnonzero(random_episode.done[:, env])
        lengths = np.diff(np.concatenate(([-1], ends)))
        assert lengths.max(initial=0) <= EPISODE
        truncated = random_episode.truncation[ends, env] == 1
        fell = random_episode.fall[ends, env] == 1
        np.testing.assert_array_equal(truncated, (lengths == EPISODE) & ~fell)


def test_reset_clears_the_imu_history_but_not_the_observation_before_it(
    env: BalanceEnv, random_episode: Episode
) -> None:
    fell = random_episode.fall.astype(bool)
    still = np.asarray(env.scene.stance.imu, np.float32)
    starts = random_episode.next_start[fell]
    np.testing.assert_array_equal(starts, np.broadcast_to(still, starts.shape))
    # The last observation of a fallen robot shows the fall: degrees of tilt on the accelerometer.
    assert np.abs(random_episode.obs[fell][:, 16:]).max(axis=1).min() > 1


def test_mjx_moves_as_plain_mujoco_does(config: Config, env: BalanceEnv, reset, run) -> None:
    """The same board and the same actions: the tilts agree to hundredths of a degree."""
    decisions = CHUNK  # at most 1 s of board motion: uncontrolled robots still stand
    state = reset(jax.random.split(jax.random.PRNGKey(4), ENVS))
    scenario = jax.device_get(state.info["scenario"])
    rng = np.random.default_rng(0)
    levels = rng.integers(7, 14, (decisions, ENVS, 2))  # small moves: nobody falls
    actions = levels[..., 0] * 21 + levels[..., 1]
    _, seen = run(state, (jnp.asarray(actions), jax.random.split(jax.random.PRNGKey(5), decisions)))
    step = iter(range(decisions))
    rollout = roll_out(
        env.scene,
        config,
        lambda view: actions[next(step)],
        Scenario(*(np.asarray(x, float) for x in scenario)),
        decisions * config.task.ctrl_dt,
    )
    assert not rollout.fell.any()
    plain = rollout.tilt.reshape(ENVS, decisions, -1).mean(axis=-1).T
    difference = np.abs(plain - np.asarray(seen.tilt))
    assert np.median(difference) < 0.01
    assert difference.max() < 0.1
