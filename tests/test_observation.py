"""The observation of paper Eq. 2, entry by entry."""

import dataclasses
import types

import jax.numpy as jnp
import numpy as np
import pytest

from mjx_balance.config import RobotConfig, TaskConfig
from mjx_balance.task.observation import (
    extend_history,
    observation_names,
    observation_scale,
    observe,
)

ROBOT = RobotConfig()
UNSCALED = TaskConfig(height_scale=1.0, gyro_scale=1.0, accel_scale=1.0)
HEIGHTS = np.asarray([0.351, 0.352, 0.353, 0.354])
COMMANDED = np.asarray([[0.341, 0.342, 0.343, 0.344], [0.345, 0.346, 0.347, 0.348]])


def readable_history(samples: int = 16) -> np.ndarray:
    """(samples, 6) whose sample k of channel c reads 100 c + k."""
    return (np.arange(samples)[:, None] + 100 * np.arange(6)[None, :]).astype(float)


def test_every_entry_by_hand(xp: types.ModuleType) -> None:
    """Channels 0 and 1 are the gyro's x and y, 3 and 4 the accelerometer's; 15 is now."""
    got = observe(UNSCALED, ROBOT, *map(xp.asarray, (HEIGHTS, COMMANDED, readable_history())))
    gyro_lagged = np.asarray([15, 14, 13, 12, 11, 10])
    accel_lagged = np.asarray([15, 13, 11, 9, 7, 5, 3, 1, 0])
    expected = [[0.001, 0.002, 0.003, 0.004], gyro_lagged, 100 + gyro_lagged]
    expected += [300 + accel_lagged, 400 + accel_lagged]
    np.testing.assert_allclose(got, np.concatenate(expected), atol=1e-6)


def test_names_say_what_the_entries_hold() -> None:
    names = observation_names(UNSCALED, ROBOT)
    values = observe(UNSCALED, ROBOT, HEIGHTS, COMMANDED, readable_history())
    assert len(names) == len(set(names)) == len(values) == 34
    assert names[:4] == ("H_LF", "H_RF", "H_LH", "H_RH")
    channels = {"V_x": 0, "V_y": 1, "Acc_x": 3, "Acc_y": 4}
    for name, value in zip(names[4:], values[4:], strict=True):
        channel, lag = name.split(",t-")
        assert value == 100 * channels[channel] + 15 - int(lag), name


def test_commanded_heights_follow_the_measured_ones_on_request() -> None:
    """0.345 m is 5 mm below the standing height: -0.5 of the scale of 1 cm."""
    task = dataclasses.replace(TaskConfig(), command_lags=(0,))
    names = observation_names(task, ROBOT)
    got = observe(task, ROBOT, HEIGHTS, COMMANDED, readable_history())
    assert names[4:8] == ("C_LF,d-0", "C_RF,d-0", "C_LH,d-0", "C_RH,d-0")
    np.testing.assert_allclose(got[4:8], (-0.5, -0.4, -0.3, -0.2))
    without = observe(TaskConfig(), ROBOT, HEIGHTS, COMMANDED, readable_history())
    np.testing.assert_array_equal(np.delete(got, np.s_[4:8]), without)
    np.testing.assert_array_equal(observation_scale(task, ROBOT)[:8], np.float32(0.01))


def test_inputs_can_be_means_of_neighbouring_samples(xp: types.ModuleType) -> None:
    """Samples k read k: the mean of 15, 14 and 13 is 14, that of 11, 10 and 9 is 10."""
    task = dataclasses.replace(UNSCALED, imu_mean=3, gyro_lags=(0, 4), accel_lags=(0,))
    assert task.history == 4 + 3
    imu = readable_history()[-task.history :]
    got = observe(task, ROBOT, *map(xp.asarray, (HEIGHTS, COMMANDED, imu)))
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
    gyro_lags: tuple[int, ...], accel_lags: tuple[int, ...], size: int, history: int
) -> None:
    task = TaskConfig(gyro_lags=gyro_lags, accel_lags=accel_lags)
    assert task.history == history
    obs = observe(task, ROBOT, HEIGHTS, COMMANDED, readable_history(history))
    assert len(obs) == len(observation_names(task, ROBOT)) == size
    assert observation_scale(task, ROBOT).shape == (size,)


def test_one_is_a_centimetre_a_degree_per_second_and_a_degree_of_gravity() -> None:
    """sin(1 deg) * 9.81 = 0.17121 m/s^2; pi / 180 = 0.0174533 rad/s."""
    imu = np.tile([0.0174533, 2 * 0.0174533, 0, 0.171209, -0.171209, 9.81], (16, 1))
    got = observe(TaskConfig(), ROBOT, np.asarray([0.36, 0.34, 0.35, 0.37]), COMMANDED, imu)
    expected = [1, -1, 0, 2] + [1] * 6 + [2] * 6 + [1] * 9 + [-1] * 9
    np.testing.assert_allclose(got, expected, atol=1e-4)


@pytest.mark.parametrize("count", [1, 3, 16, 50])
def test_history_keeps_the_newest_samples_in_order(xp: types.ModuleType, count: int) -> None:
    stream = readable_history(16 + count)
    got = extend_history(xp.asarray(stream[:16]), xp.asarray(stream[16:]))
    np.testing.assert_array_equal(got, stream[-16:])


def test_batch_equals_a_loop(xp: types.ModuleType) -> None:
    rng = np.random.default_rng(0)
    heights, imu = xp.asarray(rng.normal(size=(3, 4))), xp.asarray(rng.normal(size=(3, 16, 6)))
    loop = [observe(TaskConfig(), ROBOT, heights[k], heights[:1], imu[k]) for k in range(3)]
    np.testing.assert_allclose(
        observe(TaskConfig(), ROBOT, heights, heights[:, None], imu), np.stack(loop)
    )


def test_numpy_and_jax_agree() -> None:
    imu = np.random.default_rng(0).normal(size=(16, 6))
    jaxed = observe(TaskConfig(), ROBOT, *map(jnp.asarray, (HEIGHTS, COMMANDED, imu)))
    np.testing.assert_allclose(
        jaxed, observe(TaskConfig(), ROBOT, HEIGHTS, COMMANDED, imu), rtol=1e-4
    )
