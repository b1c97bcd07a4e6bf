"""Sensors and commands that err: sample by sample, in loops over single robots."""

import dataclasses
import types
from functools import partial
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from fixtures.arrays import put
from scipy.spatial.transform import Rotation

from mjx_balance.config import RandomizationConfig, TaskConfig
from mjx_balance.robots.catalogue import Robot
from mjx_balance.task import step
from mjx_balance.task.kinematics import foot_heights, joint_angles
from mjx_balance.task.randomization import DomainParams
from mjx_balance.task.sensors import (
    Draws,
    SensorErrors,
    count_draws,
    draw_decision,
    draw_errors,
    sense,
    start_sensors,
)
from mjx_balance.task.tilt import Scenario

TASK, N, STEPS, DECISIONS = TaskConfig(ctrl_dt=0.08), 3, 20, 4
STILL = np.asarray((0.0, 0.0, 0.0, 0.1, -0.2, 9.8))
RANGES = RandomizationConfig(
    gyro_bias=0.01,
    gyro_bias_drift=0.001,
    accel_bias=0.05,
    accel_bias_drift=0.002,
    imu_scale=0.02,
    imu_tilt=0.1,
    encoder_offset=0.02,
    reading_offset=0.01,
    sensor_delay=0.03,
    sensor_jitter=0.01,
    command_delay=0.024,
    command_jitter=0.008,
    dropout=0.3,
)


def errors_of(robot: Robot) -> SensorErrors:
    return draw_errors(RANGES, robot, np.random.default_rng(3).uniform(size=(N, 41)))


def draws_of(robot: Robot) -> list[Draws]:
    """Of every decision, for several robots."""
    rng, errors = np.random.default_rng(4), errors_of(robot)

    def normal(shape: tuple[int, ...]) -> np.ndarray:
        return rng.normal(size=(N, *shape))

    def uniform(shape: tuple[int, ...]) -> np.ndarray:
        return rng.uniform(size=(N, *shape))

    return [draw_decision(TASK, errors, normal, uniform) for _ in range(DECISIONS)]


def nominal() -> DomainParams:
    """With noise alone."""
    zero, friction, gain = np.zeros(N), np.full((N, 4), 0.8), np.ones((N, 4, 3))
    noise = np.tile((0.001, 0.002, 0.003, 0.01, 0.02, 0.03), (N, 1))
    return DomainParams(noise, zero, np.zeros((N, 3)), friction, gain, zero, zero)


def test_every_draw_lands_in_its_own_field(
    xp: types.ModuleType, robot: Robot, compiled: Any
) -> None:
    """Biases, scales, mounting, encoders: 0 is the least, 1/2 nothing, 1 the greatest; delays."""
    assert count_draws(robot) == 42
    draws = np.asarray([np.full(41, 0.5), np.linspace(0, 1, 41), np.zeros(41)])
    draws = np.column_stack((draws, np.zeros(3)))
    got = compiled(partial(draw_errors, RANGES, robot))(xp.asarray(draws, float))
    ramp = 2 * np.linspace(0, 1, 41) - 1
    np.testing.assert_allclose(got.bias[1, :3], 0.01 * ramp[:3], rtol=1e-5)
    np.testing.assert_allclose(got.bias[1, 3:], 0.05 * ramp[3:6], rtol=1e-5)
    np.testing.assert_allclose(got.scale[1], 0.02 * ramp[6:12], rtol=1e-5)
    np.testing.assert_allclose(got.mounting[1], 0.1 * ramp[12:15], rtol=1e-4, atol=1e-8)
    np.testing.assert_allclose(got.encoders[1].ravel(), 0.02 * ramp[15:27], rtol=1e-4)
    np.testing.assert_allclose(got.readings[1].ravel(), 0.01 * ramp[27:39], rtol=1e-4)
    np.testing.assert_allclose(got.delay, [(0.015, 0.012), (0.03 * 39 / 40, 0.024), (0, 0)], 1e-5)
    for name in ("bias", "scale", "mounting", "encoders", "readings"):
        assert not np.asarray(getattr(got, name))[0].any(), name
        assert (np.asarray(getattr(got, name))[2] < 0).all(), name
    np.testing.assert_allclose(got.drift, [[0.001] * 3 + [0.002] * 3] * 3, rtol=1e-6)
    np.testing.assert_allclose(got.jitter, [(0.01, 0.008)] * 3, rtol=1e-6)
    np.testing.assert_allclose(got.dropout, [0.3] * 3, rtol=1e-6)
    assert {value.dtype for value in got} == {xp.asarray(draws, float).dtype}


def test_a_share_of_the_envs_is_ideal(robot: Robot) -> None:
    """The last draw says which: of share 0.25, those below it, where nothing is wrong at all."""
    draws = np.random.default_rng(0).uniform(size=(3, 42))
    draws[:, -1] = (0.0, 0.24, 0.25)
    got = draw_errors(dataclasses.replace(RANGES, ideal_share=0.25), robot, draws)
    every = draw_errors(RANGES, robot, draws)
    for name, values in got._asdict().items():
        assert not values[:2].any(), name
        np.testing.assert_array_equal(values[2], getattr(every, name)[2])


@pytest.mark.parametrize("name", [x.name for x in dataclasses.fields(RandomizationConfig)])
def test_errors_are_drawn_if_any_is_asked_for(name: str) -> None:
    """And `varies` says whether parameters are."""
    sensors = {field for field in vars(RANGES) if getattr(RANGES, field) != 0}
    sensors -= {"friction_min", "friction_max", "push_period", "payload_offset", "payload_height"}
    sensors -= {"event_grip", "event_strength"}
    ranges = RandomizationConfig(**{name: 0.01})
    assert ranges.sensors_err == (name in sensors)
    if name in sensors:
        assert ranges.varies


def test_samples_one_by_one(robot: Robot) -> None:
    """Turned, scaled, biased, noisy; then old; then lost, so that the last one comes again."""
    errors, draws, params = errors_of(robot), draws_of(robot), nominal()
    true = STILL + np.random.default_rng(5).normal(size=(N, DECISIONS * STEPS, 6))

    memory, still = start_sensors(TASK, errors, np.tile(STILL, (N, 1)))
    last, got, ages = still, [], []
    for number in range(DECISIONS):
        samples = true[:, number * STEPS : (number + 1) * STEPS]
        memory, seen = sense(TASK, params, errors, memory, last, samples, draws[number])
        got.append(seen)
        last = seen[:, -1]
    assert memory is not None
    agree = partial(np.testing.assert_allclose, rtol=0, atol=1e-9)
    for n in range(N):
        back = Rotation.from_rotvec(errors.mounting[n]).inv()
        drift, last, measured, expected = np.zeros(6), None, [], []

        def measure(sample: np.ndarray, bias: np.ndarray, n: int = n, back: Any = back) -> Any:
            seen = np.concatenate((back.apply(sample[:3]), back.apply(sample[3:])))
            return seen * (1 + errors.scale[n]) + bias

        first = last = measure(STILL, errors.bias[n])
        for number, own in enumerate(draws):
            age = round((errors.delay[n, 0] + errors.jitter[n, 0] * own.jitter[n, 0]) / 0.004)
            ages.append(age)
            for k in range(STEPS):
                t = number * STEPS + k
                noise = params.imu_noise[n] * own.noise[n, k]
                measured.append(measure(true[n, t], errors.bias[n] + drift) + noise)
                if own.lost[n, k] >= 0.3:
                    last = measured[t - age] if t >= age else first
                expected.append(last)
            drift = drift + errors.drift[n] * np.sqrt(0.08) * own.drift[n]
        agree(np.concatenate(got, axis=1)[n], expected)
        agree(memory.drift[n], drift)
        agree(still[n], first)
    assert len(set(ages)) > 4, "jitter"


def test_without_errors_there_is_noise_alone(xp: types.ModuleType, robot: Robot) -> None:
    draws, params = draws_of(robot)[0], nominal()
    imu = np.random.default_rng(5).normal(size=(N, STEPS, 6))
    memory, seen = sense(TASK, *put(xp, (params, None, None, imu[:, 0], imu, Draws(draws.noise))))
    assert memory is None
    np.testing.assert_allclose(seen, imu + params.imu_noise[:, None] * draws.noise, rtol=1e-5)


def test_what_diverges_leaves_finite_numbers(robot: Robot) -> None:
    errors, draws = errors_of(robot), draws_of(robot)[0]
    memory, still = start_sensors(TASK, errors, np.tile(STILL, (N, 1)))
    imu = np.full((N, STEPS, 6), np.nan)
    memory, _ = sense(TASK, nominal(), errors, memory, still, imu, draws)
    assert memory is not None
    assert np.isfinite(memory.trail).all()


class Obedient:
    """An engine whose joints are where their targets are; the IMU shows the number of the step."""

    def push(self, physics: Any, velocity: Any) -> Any:
        return physics

    def advance(self, physics: Any, targets: step.Targets, params: Any) -> Any:
        joints = targets.joints
        xp = joints.__array_namespace__()
        zero = xp.zeros(joints.shape[:-2])
        imu = xp.stack([zero + np.arange(1.0, STEPS + 1)] * 6, axis=-1)
        return physics, step.Motion(imu, zero, joints)


def state_of(robot: Robot, number: int) -> step.EnvState:
    errors = errors_of(robot)
    memory = step.initial_memory(TASK, robot, np.tile(STILL, (N, 1)), errors=errors)
    level = Scenario(np.zeros((N, 1, 2)), np.zeros(N), np.full(N, 3.5))
    env_steps = np.full(N, number)
    return step.EnvState(np.zeros(N), memory, level, env_steps, nominal(), None, errors)


CHANGE = np.asarray([(0.003, -0.001), (0.002, 0.001), (-0.001, 0.003)])


def test_no_random_number_serves_two_purposes(robot: Robot) -> None:
    for draws in draws_of(robot):
        assert len(np.unique(np.concatenate([x.ravel() for x in draws]))) == N * (STEPS * 7 + 8)


def test_legs_obey_later_by_the_delay_and_its_jitter(robot: Robot) -> None:
    """In whole physics steps; before that they stay where they were."""
    state, draws = state_of(robot, 5), draws_of(robot)[0]
    _, late = step.pre_step(TASK, robot, state, CHANGE, draws)
    _, prompt = step.pre_step(TASK, robot, state._replace(errors=None), CHANGE)
    standing = joint_angles(robot, np.full(4, 0.35))
    counts = []
    for n in range(N):
        later = (state.errors.delay[n, 1] + 0.008 * draws.jitter[n, 1]) / 0.004
        counts.append(round(later))
        for k in range(STEPS):
            expected = prompt.joints[n, k - counts[n]] if k >= counts[n] else standing
            np.testing.assert_allclose(late.joints[n, k], expected, atol=1e-12)
    assert len(set(counts)) > 1


def test_servos_go_by_encoders_that_are_off(robot: Robot) -> None:
    """Its feet are elsewhere than it commanded; readings that err by themselves show that alone."""
    draws = draws_of(robot)
    for number in (0, 3):
        state = state_of(robot, number)
        moved = {}

        class Watched(Obedient):
            def advance(self, physics: Any, targets: step.Targets, params: Any) -> Any:
                moved["joints"] = targets.joints  # noqa: B023
                return super().advance(physics, targets, params)

        _, outcome = step.step(TASK, robot, Watched(), state, CHANGE, draws[0])
        assert state.errors is not None
        heights = 0.35 + 0.01 * outcome.obs[:, :4]
        commanded = joint_angles(robot, 0.35 + changes(robot))
        read = foot_heights(robot, commanded + state.errors.readings)
        np.testing.assert_allclose(heights, read, atol=1e-7)
        assert np.abs(read - 0.35 - changes(robot)).max() > 0.001
        true = moved["joints"]
        wanted = commanded - state.errors.encoders
        np.testing.assert_allclose(true[:, -1], wanted, atol=1e-9)
        assert np.abs(foot_heights(robot, true[:, -1]) - heights).max() > 0.002
        # It starts where it stands, and is there at the end of the first decision.
        standing = joint_angles(robot, np.full(4, 0.35))
        share = 1 / STEPS if number == 0 else 1.0
        np.testing.assert_allclose(true[:, 0], standing - share * state.errors.encoders, atol=1e-4)


def changes(robot: Robot) -> np.ndarray:
    """(N, legs) m."""
    left, front = (np.where(robot.each(x), 1, -1) for x in ("left", "front"))
    return CHANGE[:, :1] * left + CHANGE[:, 1:] * front


def test_one_robot_is_a_row_of_a_batch(robot: Robot) -> None:
    """What training does, one robot vmapped in JAX, and evaluation, all at once in NumPy."""
    state, draws = state_of(robot, 0), draws_of(robot)

    def decide(state: Any, change: Any, draws: Draws) -> Any:
        return step.step(TASK, robot, Obedient(), state, change, draws)

    single = jax.jit(jax.vmap(decide))
    ours, theirs = put(jnp, state), state
    for own in draws:
        ours, one = single(ours, *put(jnp, (CHANGE, own)))
        theirs, other = decide(theirs, CHANGE, own)
        close = partial(np.testing.assert_allclose, rtol=1e-4, atol=2e-4)
        jax.tree.map(close, (ours, one), (theirs, other))
