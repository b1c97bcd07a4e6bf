"""The observation of paper Eq. 2, entry by entry."""

import dataclasses
import types

import jax.numpy as jnp
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from mjx_balance.config import TaskConfig
from mjx_balance.robots.catalogue import Robot
from mjx_balance.task.observation import (
    extend_history,
    observation_names,
    observation_scale,
    observe,
)

UNSCALED = TaskConfig(height_scale=1.0, gyro_scale=1.0, accel_scale=1.0)
HEIGHTS = np.asarray([0.351, 0.352, 0.353, 0.354])
COMMANDED = np.asarray([[0.341, 0.342, 0.343, 0.344], [0.345, 0.346, 0.347, 0.348]])


def readable_history(samples: int = 16) -> np.ndarray:
    """(samples, 6) whose sample k of channel c reads 100 c + k."""
    return (np.arange(samples)[:, None] + 100 * np.arange(6)[None, :]).astype(float)


def test_every_entry_by_hand(xp: types.ModuleType, robot: Robot) -> None:
    """Channels 0 and 1 are the gyro's x and y, 3 and 4 the accelerometer's; 15 is now."""
    got = observe(UNSCALED, robot, *map(xp.asarray, (HEIGHTS, COMMANDED, readable_history())))
    gyro_lagged = np.asarray([15, 14, 13, 12, 11, 10])
    accel_lagged = np.asarray([15, 13, 11, 9, 7, 5, 3, 1, 0])
    expected = [[0.001, 0.002, 0.003, 0.004], gyro_lagged, 100 + gyro_lagged]
    expected += [300 + accel_lagged, 400 + accel_lagged]
    np.testing.assert_allclose(got, np.concatenate(expected), atol=1e-6)


def test_commanded_heights_follow_the_measured_ones_on_request(robot: Robot) -> None:
    """0.345 m is 5 mm below the standing height: -0.5 of the scale of 1 cm."""
    task = dataclasses.replace(TaskConfig(), command_lags=(0,))
    names = observation_names(task, robot)
    got = observe(task, robot, HEIGHTS, COMMANDED, readable_history())
    assert names[4:8] == ("C_LF,d-0", "C_RF,d-0", "C_LH,d-0", "C_RH,d-0")
    np.testing.assert_allclose(got[4:8], (-0.5, -0.4, -0.3, -0.2))
    without = observe(TaskConfig(), robot, HEIGHTS, COMMANDED, readable_history())
    np.testing.assert_array_equal(np.delete(got, np.s_[4:8]), without)
    np.testing.assert_array_equal(observation_scale(task, robot)[:8], np.float32(0.01))


def test_inputs_can_be_means_of_neighbouring_samples(xp: types.ModuleType, robot: Robot) -> None:
    """Samples k read k: the mean of 15, 14 and 13 is 14, that of 11, 10 and 9 is 10."""
    task = dataclasses.replace(UNSCALED, imu_mean=3, gyro_lags=(0, 4), accel_lags=(0,))
    assert task.history == 4 + 3
    imu = readable_history()[-task.history :]
    got = observe(task, robot, *map(xp.asarray, (HEIGHTS, COMMANDED, imu)))
    np.testing.assert_allclose(got[4:], (14, 10, 114, 110, 314, 414), rtol=1e-6)


@pytest.mark.parametrize(
    ("gyro_lags", "accel_lags", "size", "history"),
    [
        ((0, 1, 2, 3, 4, 5), (0, 2, 4, 6, 8, 10, 12, 14, 15), 34, 16),
        ((1, 2, 3, 4, 5), (0, 2, 4, 6, 8, 10, 12, 14, 15), 32, 16),
        ((0,), (0,), 8, 1),
        ((0, 30), (0, 1), 12, 31),
    ],
)
def test_lags_set_the_size_and_the_memory(
    robot: Robot, gyro_lags: tuple[int, ...], accel_lags: tuple[int, ...], size: int, history: int
) -> None:
    task = TaskConfig(gyro_lags=gyro_lags, accel_lags=accel_lags)
    assert task.history == history
    obs = observe(task, robot, HEIGHTS, COMMANDED, readable_history(history))
    assert len(obs) == len(observation_names(task, robot)) == size
    assert observation_scale(task, robot).shape == (size,)


def test_one_is_a_centimetre_a_degree_per_second_and_a_degree_of_gravity(robot: Robot) -> None:
    """sin(1 deg) * 9.81 = 0.17121 m/s^2; pi / 180 = 0.0174533 rad/s."""
    imu = np.tile([0.0174533, 2 * 0.0174533, 0, 0.171209, -0.171209, 9.81], (16, 1))
    got = observe(TaskConfig(), robot, np.asarray([0.36, 0.34, 0.35, 0.37]), COMMANDED, imu)
    expected = [1, -1, 0, 2] + [1] * 6 + [2] * 6 + [1] * 9 + [-1] * 9
    np.testing.assert_allclose(got, expected, atol=1e-4)


@pytest.mark.parametrize("count", [1, 3, 16, 50])
def test_history_keeps_the_newest_samples_in_order(xp: types.ModuleType, count: int) -> None:
    stream = readable_history(16 + count)
    got = extend_history(xp.asarray(stream[:16]), xp.asarray(stream[16:]))
    np.testing.assert_array_equal(got, stream[-16:])


LAGS = st.lists(st.integers(0, 20), min_size=1, max_size=5, unique=True).map(tuple)
SIZES = st.floats(1e-3, 10.0)


@settings(deadline=None, max_examples=60)
@given(
    task=st.builds(
        TaskConfig,
        gyro_lags=LAGS,
        accel_lags=LAGS,
        imu_mean=st.integers(1, 5),
        command_lags=st.one_of(st.just(()), LAGS),
        body_height=st.floats(0.2, 0.4),
        height_scale=SIZES,
        gyro_scale=SIZES,
        accel_scale=SIZES,
    ),
    seed=st.integers(0, 2**32),
)
def test_every_entry_is_what_its_name_says(robot: Robot, task: TaskConfig, seed: int) -> None:
    """Read by an interpreter of the names, from noise in which no two samples are alike."""
    rng = np.random.default_rng(seed)
    memory = max(*task.gyro_lags, *task.accel_lags) + task.imu_mean
    commands = max(task.command_lags, default=0) + 1
    assert (task.history, task.command_history) == (memory, commands)
    heights, commanded = rng.normal(size=(2, 4)), rng.normal(size=(2, commands, 4))
    imu = rng.normal(size=(2, memory, 6))
    got, scale = observe(task, robot, heights, commanded, imu), observation_scale(task, robot)
    names = observation_names(task, robot)
    assert got.shape == (2, len(names))
    assert len(set(names)) == len(names)
    legs = ("LF", "RF", "LH", "RH")
    for k, name in enumerate(names):
        symbol, of = name.split(",")[0].split("_")
        lag = int(name.split("-")[1]) if "-" in name else 0
        if symbol in "HC":
            source = heights if symbol == "H" else commanded[:, commands - 1 - lag]
            value, unit = source[:, legs.index(of)] - task.body_height, task.height_scale
        else:
            channel = "xyz".index(of) + {"V": 0, "Acc": 3}[symbol]
            back = [memory - 1 - lag - older for older in range(task.imu_mean)]
            value = sum(imu[:, step, channel] for step in back) / task.imu_mean
            unit = task.gyro_scale if symbol == "V" else task.accel_scale
        assert scale[k] == np.float32(unit), name
        np.testing.assert_allclose(got[:, k] * unit, value, rtol=1e-5, atol=1e-6, err_msg=name)


def test_order_of_the_names(robot: Robot) -> None:
    """Heights, commands lag by lag, then gyro x, gyro y, accelerometer x, accelerometer y."""
    task = TaskConfig(command_lags=(0, 2), gyro_lags=(3, 1), accel_lags=(5,))
    expected = (
        "H_LF H_RF H_LH H_RH C_LF,d-0 C_RF,d-0 C_LH,d-0 C_RH,d-0 C_LF,d-2 C_RF,d-2 C_LH,d-2 "
        "C_RH,d-2 V_x,t-3 V_x,t-1 V_y,t-3 V_y,t-1 Acc_x,t-5 Acc_y,t-5"
    )
    assert observation_names(task, robot) == tuple(expected.split())


def test_history_grows_along_time_and_nothing_else(xp: types.ModuleType) -> None:
    """(worlds, time, channels): a batch of two."""
    rng = np.random.default_rng(0)
    stream = rng.normal(size=(2, 7, 6))
    got = extend_history(xp.asarray(stream[:, :4]), xp.asarray(stream[:, 4:]))
    np.testing.assert_allclose(got, stream[:, -4:], rtol=1e-6)


def test_batch_equals_a_loop(xp: types.ModuleType, robot: Robot) -> None:
    rng = np.random.default_rng(0)
    heights, imu = xp.asarray(rng.normal(size=(3, 4))), xp.asarray(rng.normal(size=(3, 16, 6)))
    loop = [observe(TaskConfig(), robot, heights[k], heights[:1], imu[k]) for k in range(3)]
    np.testing.assert_allclose(
        observe(TaskConfig(), robot, heights, heights[:, None], imu), np.stack(loop)
    )


def test_numpy_and_jax_agree(robot: Robot) -> None:
    imu = np.random.default_rng(0).normal(size=(16, 6))
    jaxed = observe(TaskConfig(), robot, *map(jnp.asarray, (HEIGHTS, COMMANDED, imu)))
    np.testing.assert_allclose(
        jaxed, observe(TaskConfig(), robot, HEIGHTS, COMMANDED, imu), rtol=1e-4
    )
