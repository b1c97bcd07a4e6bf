"""Domain randomisation in MJX: the same circumstances as in plain MuJoCo."""

import dataclasses

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from mjx_balance.config import Config, RandomizationConfig, preset
from mjx_balance.env import BalanceEnv
from mjx_balance.evaluation import roll_out
from mjx_balance.task.actions import action_table, apply_action
from mjx_balance.task.randomization import Conditions
from mjx_balance.task.tilt import Scenario

ENVS, DECISIONS = 32, 4
RANDOM = RandomizationConfig(
    gyro_noise=0.002,
    accel_noise=0.023,
    payload=5.0,
    friction_min=0.6,
    friction_max=1.0,
    gain_spread=0.2,
    latency_share=0.5,
    rate_max=4.4,
    incline_max=9.0,
)


@pytest.fixture(scope="module")
def config() -> Config:
    default = preset("default")
    task = dataclasses.replace(default.task, command_lags=(0,))
    return dataclasses.replace(default, random=RANDOM, task=task)


@pytest.fixture(scope="module")
def episode(config: Config):
    """Start, actions and (state, tilt) of a few decisions of small random moves."""
    env = BalanceEnv(config)
    state = jax.jit(jax.vmap(env.reset))(jax.random.split(jax.random.PRNGKey(0), ENVS))
    levels = np.random.default_rng(0).integers(7, 14, (DECISIONS, ENVS, 2))
    actions = levels[..., 0] * 21 + levels[..., 1]

    def step(state, action):
        after = jax.vmap(env.step)(state, action)
        return after, after.metrics["tilt_deg"]

    end, tilt = jax.jit(lambda s, a: jax.lax.scan(step, s, a))(state, jnp.asarray(actions))
    return env, jax.device_get(state), actions, jax.device_get(end), np.asarray(tilt)


def test_every_env_has_its_own_circumstances(episode) -> None:
    _, start, *_ = episode
    conditions, scenario = start.info["conditions"], start.info["scenario"]
    for name, least, most in (("payload", 0, 5), ("friction", 0.6, 1.0), ("gain", 0.8, 1.2)):
        values = getattr(conditions, name)
        assert len(np.unique(values)) == ENVS
        assert values.min() >= least
        assert values.max() <= most
        assert np.ptp(values) > 0.8 * (most - least)
    assert 0.2 < conditions.latency.mean() < 0.8
    assert 3.5 <= scenario.rate.min() < 3.7 < 4.2 < scenario.rate.max() <= 4.4
    assert 7 < np.linalg.norm(scenario.targets, axis=-1).max() < 9 * 2**0.5


def test_mjx_moves_as_plain_mujoco_in_the_same_circumstances(config: Config, episode) -> None:
    """Payload, friction, gains, latency and board speed, all at once: equal tilts."""
    env, start, actions, _, tilt = episode
    double = {k: np.asarray(v, float) for k, v in start.info["conditions"]._asdict().items()}
    rollout = roll_out(
        env.scene,
        config,
        lambda view: actions[view.decision],
        Scenario(*(np.asarray(x, float) for x in start.info["scenario"])),
        DECISIONS * config.task.ctrl_dt,
        conditions=Conditions(**double),
    )
    plain = rollout.tilt.reshape(ENVS, DECISIONS, -1).mean(axis=-1).T
    difference = np.abs(plain - tilt)
    assert np.median(difference) < 0.01
    assert difference.max() < 0.15
    nominal = roll_out(
        env.scene,
        config,
        lambda view: actions[view.decision],
        Scenario(*(np.asarray(x, float) for x in start.info["scenario"])),
        DECISIONS * config.task.ctrl_dt,
    )
    other = nominal.tilt.reshape(ENVS, DECISIONS, -1).mean(axis=-1).T
    assert np.median(np.abs(other - tilt)) > 0.03, "the circumstances matter"


def test_noise_reaches_the_observation(episode) -> None:
    env, _, _, end, _ = episode
    imu = end.info["imu"]
    # Yaw rate at the decision's end, curvature only: the motion itself is smooth.
    jitter = np.diff(imu[:, -8:, 2], n=2, axis=1) / np.sqrt(6)
    assert jitter.std() == pytest.approx(0.002, rel=0.25)
    newest = imu[:, -1, 3] / env.config.task.accel_scale
    np.testing.assert_allclose(end.obs[:, 20], newest, rtol=1e-5)


def test_a_late_robot_is_told_its_command_at_once_and_obeys_one_decision_later(episode) -> None:
    env, start, actions, end, _ = episode
    task = env.config.task
    change = action_table(task)[actions]
    heights = late = np.asarray(start.info["heights"])
    for k in range(DECISIONS):
        late, heights = heights, apply_action(task, env.config.robot, heights, change[k])
    np.testing.assert_allclose(end.info["commanded"][:, -1], heights, atol=1e-6)
    is_late = start.info["conditions"].latency[:, None] > 0
    np.testing.assert_allclose(end.info["heights"], np.where(is_late, late, heights), atol=1e-6)
    told = (heights - task.body_height) / task.height_scale
    np.testing.assert_allclose(end.obs[:, 4:8], told, atol=1e-4)
    measured = task.body_height + end.obs[:, :4] * task.height_scale
    assert np.abs(measured - end.info["heights"]).max() < 0.002
