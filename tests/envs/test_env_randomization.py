"""Domain randomisation: what differs from env to env, and by how much."""

import dataclasses
import itertools
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import pytest
import scipy.stats
from fixtures.fleet import observation_names, with_state

from mjx_balance.config import RandomizationConfig, preset
from mjx_balance.envs.balance import BalanceEnv
from mjx_balance.task.randomization import DomainParams

MANY = 4_000
ENVS, STAND = 32, 220
PUSHED = (13, 25, 38)
"""Decisions of an episode that begin with a push: 2.5, 5 and 7.5 s, in decisions of 0.2 s."""


@pytest.fixture(scope="module")
def drawn(fleet: Any) -> tuple[DomainParams, Any, np.ndarray]:
    """Domain parameters, scenarios and pushes of many resets."""

    def draw(key: jax.Array) -> Any:
        state = fleet.env.reset(key).pipeline_state
        return state.params, state.scenario, state.pushes.velocity

    return jax.device_get(jax.jit(jax.vmap(draw))(jax.random.split(jax.random.PRNGKey(0), MANY)))


def test_domain_parameters_fill_their_ranges(drawn: tuple[DomainParams, Any, np.ndarray]) -> None:
    params, _, pushes = drawn
    ranges = {
        "payload": (params.payload, 0, 5),
        "x": (params.payload_at[:, 0], -0.05, 0.05),
        "y": (params.payload_at[:, 1], -0.05, 0.05),
        "friction": (params.friction[:, 1], 0.4, 1.0),
        "gain": (params.gain[:, 2, 1], 0.8, 1.2),
        "speed": (np.linalg.norm(pushes[:, 2], axis=-1), 0.05, 0.1),
        "direction": (np.arctan2(pushes[:, 0, 1], pushes[:, 0, 0]), -np.pi, np.pi),
    }
    assert pushes.shape == (MANY, 3, 2)
    for name, (values, low, high) in ranges.items():
        test = scipy.stats.kstest(values, "uniform", (low, high - low))
        assert test.pvalue > 1e-3, name
    np.testing.assert_allclose(params.payload_at[:, 2], 0.08, rtol=1e-6)
    assert set(params.delay) == {0, 1}
    assert params.delay.mean() == pytest.approx(0.5, abs=4 * 0.5 / np.sqrt(MANY))
    sigma = np.asarray([0.002] * 3 + [0.023] * 3, np.float32)
    np.testing.assert_allclose(params.imu_noise, np.tile(sigma, (MANY, 1)))


def test_no_two_draws_of_an_env_go_together(drawn: tuple[DomainParams, Any, np.ndarray]) -> None:
    """A key used twice would tie a payload to a target."""
    params, scenario, pushes = drawn
    columns = np.column_stack(
        (
            params.payload,
            params.payload_at[:, :2],
            params.friction[:, 0],
            params.gain[:, 0, 0],
            params.delay,
            scenario.targets[:, 1],
            np.linalg.norm(scenario.targets[:, 1], axis=-1),
            scenario.phase,
            pushes.reshape(MANY, -1),
        )
    )
    together = scipy.stats.spearmanr(columns).statistic - np.eye(columns.shape[1])
    assert np.abs(together).max() < 0.07


def test_a_push_is_added_to_the_trunks_velocity_when_its_decision_begins(fleet: Any) -> None:
    """On level boards, robots given that velocity by hand move alike, whatever the decision."""
    start = fleet.level(fleet.under(fleet.reset(fleet.keys(5)), fleet.nominal()))
    pushes, physics = np.asarray(start.pipeline_state.pushes.velocity), start.pipeline_state.physics
    free = fleet.env.scene.model.jnt_dofadr[fleet.env.scene.model.joint("robot/root").id]

    def after(decision: int, velocity: np.ndarray) -> Any:
        env_steps = jnp.full(ENVS, decision, jnp.int32)
        given = physics._replace(qvel=physics.qvel.at[:, free : free + 2].add(velocity))
        state = fleet.step(
            with_state(start, env_steps=env_steps, physics=given), np.full(ENVS, STAND)
        )
        return jax.device_get(state)

    none, still = np.zeros((ENVS, 2)), after(1, np.zeros((ENVS, 2)))
    for decision in (0, 12, 14, 24, 26, 49):
        imu = after(decision, none).pipeline_state.memory.imu
        np.testing.assert_allclose(imu, still.pipeline_state.memory.imu, atol=1e-3)
    for k, decision in enumerate(PUSHED):
        pushed, by_hand = after(decision, none), after(1, pushes[:, k])
        for name in ("qpos", "qvel"):
            ours, theirs = (getattr(s.pipeline_state.physics, name) for s in (pushed, by_hand))
            np.testing.assert_allclose(ours, theirs, atol=1e-4)
        shaken = np.abs(pushed.pipeline_state.memory.imu - still.pipeline_state.memory.imu).max(
            axis=(1, 2)
        )
        assert shaken.min() > 0.5, "m/s^2"


def test_pushes_change_no_other_draw(fleet: Any) -> None:
    """Training without pushes takes the random numbers that it took before there were any."""
    config = fleet.env.config
    calm = dataclasses.replace(config.randomization, push_min=0.0, push_max=0.0)
    env = BalanceEnv(dataclasses.replace(config, randomization=calm))
    ours, theirs = (jax.jit(e.reset)(jax.random.PRNGKey(7)) for e in (fleet.env, env))
    ours = with_state(ours, pushes=None)
    jax.tree.map(np.testing.assert_array_equal, ours, theirs)


ERRORS = {
    "gyro_bias": 0.01,
    "sensor_delay": 0.03,
    "command_delay": 0.02,
    "encoder_offset": 0.02,
    "dropout": 0.2,
}


def test_sensor_errors_fill_their_ranges_and_change_no_other_draw(fleet: Any) -> None:
    """Of each env its own; the first observation shows them."""
    config = fleet.env.config
    ranges = dataclasses.replace(config.randomization, **ERRORS)
    env = BalanceEnv(dataclasses.replace(config, randomization=ranges))
    keys = jax.random.split(jax.random.PRNGKey(7), 1_000)
    ours, theirs = (jax.device_get(jax.jit(jax.vmap(e.reset))(keys)) for e in (env, fleet.env))
    errors = ours.pipeline_state.errors
    limits = {"bias": 0.01, "encoders": 0.02}
    for name, most in limits.items():
        values = getattr(errors, name)[..., :3].ravel()
        assert scipy.stats.kstest(values, "uniform", (-most, 2 * most)).pvalue > 1e-3, name
    for k, most in enumerate((0.03, 0.02)):
        assert scipy.stats.kstest(errors.delay[:, k], "uniform", (0, most)).pvalue > 1e-3
    for name in ("params", "scenario", "pushes"):
        parts = (getattr(x.pipeline_state, name) for x in (ours, theirs))
        jax.tree.map(np.testing.assert_array_equal, *parts)
    names = list(observation_names(config.task, env.scene.robot))
    shown = np.radians(ours.obs[:, names.index("V_x,t-0")])
    np.testing.assert_allclose(shown, errors.bias[:, 0], atol=1e-5)
    assert np.abs(ours.obs[:, 0] - theirs.obs[:, 0]).max() > 0.3, "mm"


def test_nobody_is_pushed_unless_asked_for() -> None:
    """Nor in an episode that ends, after 60 s, when the first push is due."""
    rare = RandomizationConfig(push_max=0.2, push_period=60.0)
    for random in (RandomizationConfig(), rare):
        env = BalanceEnv(dataclasses.replace(preset("default"), randomization=random))
        state = jax.eval_shape(env.reset, jax.random.PRNGKey(0)).pipeline_state
        assert state.pushes is None


SIGMA = np.linspace(0.5, 2, ENVS)[:, None] * np.asarray((0.001, 0.002, 0.003, 0.02, 0.04, 0.06))
"""(ENVS, 6) noise of every env and channel, no two alike."""


@pytest.fixture(scope="module")
def noise(fleet: Any) -> tuple[np.ndarray, list[Any], list[Any]]:
    """Noise (2, ENVS, 50, 6) of two decisions in units of its size, with and without it."""
    loud = fleet.nominal()._replace(imu_noise=SIGMA.astype(np.float32))
    runs = []
    for params in (fleet.nominal(), loud):
        state, states = fleet.under(fleet.reset(fleet.keys(4)), params), []
        for _ in range(2):
            state = fleet.step(state, np.full(ENVS, STAND))
            states.append(jax.device_get(state))
        runs.append(states)
    clean, noisy = runs
    imu = [np.asarray([s.pipeline_state.memory.imu for s in states], float) for states in runs]
    return (imu[1] - imu[0]) / SIGMA[:, None], clean, noisy


def test_noise_is_normal_and_of_the_size_asked_for(noise: Any) -> None:
    """Per channel 3,200 numbers: standard errors are 0.018 of the mean, 0.0125 of the size."""
    z = noise[0]
    assert z.shape == (2, ENVS, 50, 6)
    for channel in range(6):
        values = z[..., channel].ravel()
        assert abs(values.mean()) < 0.07
        assert values.std() == pytest.approx(1, abs=0.05)
        assert abs(scipy.stats.kurtosis(values)) < 0.4
    # And of every env, 600 numbers.
    np.testing.assert_allclose(z.std(axis=(0, 2, 3)), 1, atol=0.12)


def test_noise_is_white_and_new_for_every_env_decision_and_channel(noise: Any) -> None:
    z = noise[0]

    def together(a: np.ndarray, b: np.ndarray) -> float:
        return abs(np.corrcoef(a.ravel(), b.ravel())[0, 1])

    assert together(z[0], z[1]) < 0.05
    for lag in (1, 2, 5, 25):
        assert together(z[:, :, lag:], z[:, :, :-lag]) < 0.05
    for a, b in itertools.combinations(range(6), 2):
        assert together(z[..., a], z[..., b]) < 0.08
    for env in range(ENVS - 1):
        assert together(z[:, env], z[:, env + 1]) < 0.2


def test_noise_is_seen_and_moves_nobody(fleet: Any, noise: Any) -> None:
    _, clean, noisy = noise
    names = np.asarray(observation_names(fleet.env.config.task, fleet.env.scene.robot))
    for a, b in zip(clean, noisy, strict=True):
        jax.tree.map(
            np.testing.assert_array_equal, a.pipeline_state.physics, b.pipeline_state.physics
        )
        np.testing.assert_array_equal(a.reward, b.reward)
        difference = b.obs - a.obs
        heights = np.char.startswith(names, "H_") | np.char.startswith(names, "C_")
        np.testing.assert_array_equal(difference[:, heights], 0 * difference[:, heights])
        # The newest five samples of the roll rate, in deg/s.
        rate = (b.pipeline_state.memory.imu - a.pipeline_state.memory.imu)[:, -5:, 0].mean(axis=1)
        entry = list(names).index("V_x,t-0")
        np.testing.assert_allclose(difference[:, entry], np.degrees(rate), atol=1e-4)


def test_envs_of_a_batch_move_under_their_own_parameters(fleet: Any) -> None:
    """Two payloads, gains and soles under one scenario: each is where it is alone."""
    state = fleet.reset(fleet.keys(9))
    drawn = jax.device_get(state.pipeline_state.params)
    turned = [np.roll(x, 1, axis=0) for x in drawn]
    scenario = jax.tree.map(
        lambda x: np.repeat(np.asarray(x)[:1], ENVS, 0), state.pipeline_state.scenario
    )
    state = with_state(state, scenario=scenario)
    actions = np.full(ENVS, STAND + 42)
    first, second = (
        jax.device_get(fleet.step(fleet.under(state, params), actions)).pipeline_state.physics.qpos
        for params in (drawn, DomainParams(*turned))
    )
    np.testing.assert_allclose(np.roll(first, 1, axis=0), second, atol=1e-6)
    height = first[:, fleet.env.scene.trunk_quat[0] - 1]
    assert len(np.unique(height)) == ENVS
    assert np.ptp(height) > 1e-4
