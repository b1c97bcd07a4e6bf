"""The observation, row by row: paper Eq. 2 and other layouts."""

import dataclasses
import types
from functools import partial
from typing import Any

import numpy as np
import pytest
from fixtures.fleet import observation_names
from hypothesis import given, settings
from hypothesis import strategies as st

from mjx_balance.config import TaskConfig
from mjx_balance.robots.catalogue import Robot
from mjx_balance.task.observation import (
    Mirror,
    Row,
    Signals,
    extend_history,
    input_rows,
    lookback,
    observe,
)

UNSCALED = TaskConfig(height_scale=1.0, gyro_scale=1.0, accel_scale=1.0)
HEIGHTS = np.asarray([[0.351, 0.352, 0.353, 0.354]])
COMMANDS = np.asarray([[0.341, 0.342, 0.343, 0.344], [0.345, 0.346, 0.347, 0.348]])


def readable_history(samples: int = 16) -> np.ndarray:
    """(samples, 6) whose sample k of channel c reads 100 c + k."""
    return (np.arange(samples)[:, None] + 100 * np.arange(6)[None, :]).astype(float)


def observed(task: TaskConfig, robot: Robot, *signals: Any) -> Any:
    return observe(input_rows(task, robot), Signals(*signals))


def test_commands_and_means_by_hand(xp: types.ModuleType, robot: Robot, compiled: Any) -> None:
    """Samples k read k: the mean of 15, 14 and 13 is 14, that of 11, 10 and 9 is 10.

    0.345 m is 5 mm below the standing height, and 0.341 m 9 mm.
    """
    task = dataclasses.replace(
        UNSCALED, gyro_lags=(0, 4), accel_lags=(0,), imu_mean=3, command_lags=(0, 1)
    )
    signals = map(xp.asarray, (HEIGHTS, COMMANDS, readable_history()[-7:]))
    got = compiled(partial(observed, task, robot))(*signals)
    commanded = (-0.005, -0.004, -0.003, -0.002, -0.009, -0.008, -0.007, -0.006)
    np.testing.assert_allclose(got[4:12], commanded, atol=1e-6)
    np.testing.assert_allclose(got[12:], (14, 10, 114, 110, 314, 414), rtol=1e-6)


def test_one_is_a_centimetre_a_degree_per_second_and_a_degree_of_gravity(robot: Robot) -> None:
    """sin(1 deg) * 9.81 = 0.17121 m/s^2; pi / 180 = 0.0174533 rad/s."""
    imu = np.tile([0.0174533, 2 * 0.0174533, 0, 0.171209, -0.171209, 9.81], (16, 1))
    got = observed(TaskConfig(), robot, np.asarray([[0.36, 0.34, 0.35, 0.37]]), COMMANDS, imu)
    expected = [1, -1, 0, 2] + [1] * 6 + [2] * 6 + [1] * 9 + [-1] * 9
    np.testing.assert_allclose(got, expected, atol=1e-4)


def test_order_of_the_names(robot: Robot) -> None:
    """Heights, commands lag by lag, gyro x, gyro y, accelerometer x and y, means, angles."""
    task = TaskConfig(
        command_lags=(0, 2),
        gyro_lags=(3, 1),
        accel_lags=(5,),
        mean_times=(9.0,),
        filter_times=(0.5,),
    )
    expected = (
        "H_LF H_RF H_LH H_RH C_LF,d-0 C_RF,d-0 C_LH,d-0 C_RH,d-0 C_LF,d-2 C_RF,d-2 C_LH,d-2 "
        "C_RH,d-2 V_x,t-3 V_x,t-1 V_y,t-3 V_y,t-1 Acc_x,t-5 Acc_y,t-5 "
        "V_x,mean-9 V_y,mean-9 Acc_x,mean-9 Acc_y,mean-9 Angle_x,filter-0.5 Angle_y,filter-0.5"
    )
    assert observation_names(task, robot) == tuple(expected.split())


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
    rng, rows = np.random.default_rng(seed), input_rows(task, robot)
    memory = max(*task.gyro_lags, *task.accel_lags) + task.imu_mean
    decisions = max(task.command_lags, default=0) + 1
    assert [lookback(rows, x) for x in Signals._fields[:3]] == [1, decisions, memory]
    heights, commands = rng.normal(size=(2, 1, 4)), rng.normal(size=(2, decisions, 4))
    imu = rng.normal(size=(2, memory, 6))
    got = observe(rows, Signals(heights, commands, imu))
    names = [row.name for row in rows]
    assert got.shape == (2, len(names))
    assert len(set(names)) == len(names)
    legs = ("LF", "RF", "LH", "RH")
    for k, name in enumerate(names):
        symbol, of = name.split(",")[0].split("_")
        lag = int(name.split("-")[1]) if "-" in name else 0
        if symbol in "HC":
            source = heights if symbol == "H" else commands
            value, unit = source[:, -1 - lag, legs.index(of)] - task.body_height, task.height_scale
        else:
            channel = "xyz".index(of) + {"V": 0, "Acc": 3}[symbol]
            back = [memory - 1 - lag - older for older in range(task.imu_mean)]
            value = sum(imu[:, step, channel] for step in back) / task.imu_mean
            unit = task.gyro_scale if symbol == "V" else task.accel_scale
        assert rows[k].scale == np.float32(unit), name
        np.testing.assert_allclose(got[:, k] * unit, value, rtol=1e-5, atol=1e-6, err_msg=name)


CHANNELS = {"height": (0, 4), "command": (1, 4), "gyro": (2, 3), "accelerometer": (2, 3)}


@st.composite
def any_row(draw: st.DrawFn) -> Row:
    """A row of any sensor."""
    sensor = draw(st.sampled_from(sorted(CHANNELS)))
    index, size = draw(st.integers(0, CHANNELS[sensor][1] - 1)), st.floats(0.1, 10.0)
    lag, window = (0, 1) if sensor == "height" else draw(st.tuples(*[st.integers(1, 6)] * 2))
    mirror = Mirror("", 1)
    return Row("", sensor, index, lag, window, draw(size), float(np.float32(draw(size))), mirror)


@settings(deadline=None, max_examples=60)
@given(rows=st.lists(any_row(), min_size=1, max_size=12).map(tuple), seed=st.integers(0, 2**32))
def test_rows_of_any_order_one_by_one(rows: tuple[Row, ...], seed: int) -> None:
    rng = np.random.default_rng(seed)
    signals = Signals(*(rng.normal(size=shape) for shape in ((1, 4), (12, 4), (12, 6))))
    got = observe(rows, signals)
    for value, row in zip(got, rows, strict=True):
        samples = signals[CHANNELS[row.sensor][0]][::-1]  # the newest first
        samples = samples[row.lag : row.lag + row.window]
        channel = row.index + 3 * (row.sensor == "accelerometer")
        expected = (sum(samples[:, channel]) / row.window - row.offset) / row.scale
        np.testing.assert_allclose(value, expected, rtol=1e-9, atol=1e-9)


@pytest.mark.parametrize("count", [1, 3, 16, 50])
def test_history_keeps_the_newest_samples_in_order(xp: types.ModuleType, count: int) -> None:
    """(envs, time, channels): a batch of two."""
    stream = np.stack((readable_history(16 + count), -readable_history(16 + count)))
    got = extend_history(xp.asarray(stream[:, :16]), xp.asarray(stream[:, 16:]))
    np.testing.assert_array_equal(got, stream[:, -16:])
