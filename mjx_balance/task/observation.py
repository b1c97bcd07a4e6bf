"""The observation as a table of rows: paper Eq. 2, and what else a network may be given.

`input_rows` alone knows the layout. Names, scales, the mirror, the policy's manifest and the
runtime on a robot follow from its rows.
"""

import functools
import itertools
from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
from jaxtyping import Float, Float32, Int

from mjx_balance.config import DEGREE, TaskConfig
from mjx_balance.robots.catalogue import Robot
from mjx_balance.task import Array


class Mirror(NamedTuple):
    """What an input is in the left-right mirror: `sign`, +-1, times the input named `row`."""

    row: str
    sign: int


class Row(NamedTuple):
    """One input of the network: the mean of `window` samples, each less `offset`, over `scale`.

    With a time constant it is a mean over all samples since the start instead (`task/means.py`).
    """

    name: str  #: unique, e.g. `H_LF`, `C_LF,d-1`, `V_x,t-2`, `Acc_y,t-15`
    sensor: str  #: one of `SENSORS`
    index: int  # pyright: ignore[reportIncompatibleMethodOverride]
    """Leg in the robot's order, or axis: 0, 1, 2 for x, y, z; an angle is about x or y."""
    lag: int  #: age of the newest sample averaged, in samples of the sensor; 0 is the latest
    window: int  #: samples averaged, from there back
    offset: float  #: in the sensor's unit
    scale: float  #: size that enters the network as 1, in the sensor's unit; a float32
    mirror: Mirror
    time_constant: float | None = None  #: s; lag is 0 then, and window 1


class Signals(NamedTuple):
    """Samples of all sensors up to a decision, the newest last."""

    heights: Float[Array, "*batch 1 legs"]  #: measured foot heights, m
    commands: Float[Array, "*batch decisions legs"]  #: commanded, a sample per decision, m
    imu: Float[Array, "*batch samples 6"]  #: gyro, accelerometer, rad/s and m/s^2
    means: Float[Array, "*batch 1 means"] | None = None
    """Of the rows with a time constant, in their order and the sensor's unit."""


class Sensor(NamedTuple):
    """Where samples of a sensor are."""

    signal: str  #: a field of `Signals`
    channel: int  #: its entry there that has index 0


SENSORS = {
    "height": Sensor("heights", 0),
    "command": Sensor("commands", 0),
    "gyro": Sensor("imu", 0),
    "accelerometer": Sensor("imu", 3),
    "angle": Sensor("means", 0),  # of a complementary filter, so it needs a time constant
}
TURN_SIGNS, MOTION_SIGNS = (-1, 1, -1), (1, -1, 1)
"""Signs of x, y and z in the left-right mirror: of turns about them, of motion along them."""


@functools.lru_cache(maxsize=16)
def input_rows(task: TaskConfig, robot: Robot) -> tuple[Row, ...]:
    """The network's inputs, in order.

    Measured heights, commanded heights lag by lag, then gyro x and y and accelerometer x and y at
    every lag (paper Eq. 2). With `task.imu_mean` = 5, `V_x,t-10` is the mean of the samples that
    are 10 to 14 steps old. Last are leaky means of gyro and accelerometer, then filtered angles.
    """
    height, scale, mean = task.body_height, task.height_scale, task.imu_mean
    rows = _leg_rows(robot, "H_{leg}", "height", height, scale)
    for lag in task.command_lags:
        rows += _leg_rows(robot, "C_{leg},d-{lag}", "command", height, scale, lag)
    gyro = task.gyro_lags, mean, task.gyro_scale
    accelerometer = task.accel_lags, mean, task.accel_scale
    rows += _axis_rows("V_{axis},t-{lag}", "gyro", *gyro, TURN_SIGNS)
    rows += _axis_rows("Acc_{axis},t-{lag}", "accelerometer", *accelerometer, MOTION_SIGNS)
    means, filters = task.mean_times, task.filter_times
    rows += _mean_rows("V_{axis},mean", "gyro", means, task.gyro_scale, TURN_SIGNS)
    scale = task.accel_scale
    rows += _mean_rows("Acc_{axis},mean", "accelerometer", means, scale, MOTION_SIGNS)
    rows += _mean_rows("Angle_{axis},filter", "angle", filters, DEGREE, TURN_SIGNS)
    return tuple(rows)


def _leg_rows(
    robot: Robot, name: str, sensor: str, offset: float, scale: float, lag: int = 0, sign: int = 1
) -> list[Row]:
    """A row per leg; `sign` is that of the partner leg in the mirror."""
    names = [name.format(leg=leg.name, lag=lag) for leg in robot.legs]
    sides = [(leg.left, leg.front) for leg in robot.legs]
    mirrors = [Mirror(names[sides.index((not left, front))], sign) for left, front in sides]
    scale = float(np.float32(scale))
    return [
        Row(name, sensor, k, lag, 1, offset, scale, mirror)
        for k, (name, mirror) in enumerate(zip(names, mirrors, strict=True))
    ]


def _axis_rows(
    name: str,
    sensor: str,
    lags: Sequence[int],
    window: int,
    scale: float,
    signs: Sequence[int],
    axes: str = "xy",
) -> list[Row]:
    """A row per axis and lag; `signs` are those of x, y and z in the mirror."""
    rows, scale = [], float(np.float32(scale))
    for axis, lag in itertools.product(axes, lags):
        own, index = name.format(axis=axis, lag=lag), "xyz".index(axis)
        rows.append(Row(own, sensor, index, lag, window, 0.0, scale, Mirror(own, signs[index])))
    return rows


def _mean_rows(
    name: str, sensor: str, times: Sequence[float], scale: float, signs: Sequence[int]
) -> list[Row]:
    """A row per time constant and axis."""
    return [
        row._replace(time_constant=time)
        for time in times
        for row in _axis_rows(f"{name}-{time:g}", sensor, (0,), 1, scale, signs)
    ]


def lookback(rows: Sequence[Row], signal: str) -> int:
    """Samples of a signal that the rows look back on, the newest included; at least one."""
    ages = [row.lag + row.window for row in rows if _signal(row) == signal]
    return max(ages, default=1)


def mean_rows(rows: Sequence[Row]) -> tuple[Row, ...]:
    """The rows with a time constant."""
    return tuple(row for row in rows if row.time_constant is not None)


def _signal(row: Row) -> str:
    return SENSORS[row.sensor].signal if row.time_constant is None else "means"


def observe(rows: tuple[Row, ...], signals: Signals) -> Float[Array, "... obs_size"]:
    """Builds the scaled observation from at least `lookback` samples of each signal."""
    xp = signals.imu.__array_namespace__()
    runs, scale = _compiled(rows)
    inputs = []
    for run in runs:
        # Offsets come first: XLA then adds them to the kinematics' constants.
        samples = getattr(signals, run.signal) - run.offset
        newest = samples.shape[-2] - 1
        inputs.append(samples[..., newest - run.ages, run.channels].mean(axis=-2))
    return xp.concatenate(inputs, axis=-1) / scale.astype(signals.imu.dtype)


class _Run(NamedTuple):
    """Consecutive rows of one signal, offset and window."""

    signal: str
    offset: float
    ages: Int[np.ndarray, "window rows"]  #: of the samples averaged
    channels: Int[np.ndarray, " rows"]


@functools.lru_cache(maxsize=16)
def _compiled(rows: tuple[Row, ...]) -> tuple[list[_Run], Float32[np.ndarray, " obs_size"]]:
    """The rows as runs, and their scales."""
    runs, means = [], mean_rows(rows)
    for (signal, offset, window), group in itertools.groupby(
        rows, key=lambda row: (_signal(row), row.offset, row.window)
    ):
        run = list(group)
        ages = np.arange(window)[:, None] + [row.lag for row in run]
        channels = [
            SENSORS[row.sensor].channel + row.index if signal != "means" else means.index(row)
            for row in run
        ]
        # JAX mixes traces of 32 and of 64 bits up where they index by the default type.
        runs.append(_Run(signal, offset, ages.astype(np.int32), np.asarray(channels, np.int32)))
    return runs, np.asarray([row.scale for row in rows], np.float32)


def extend_history(
    history: Float[Array, "*batch kept k"], samples: Float[Array, "*batch new k"]
) -> Float[Array, "*batch kept k"]:
    """Appends samples to a history and keeps the last ones."""
    xp = history.__array_namespace__()
    return xp.concatenate((history, samples), axis=-2)[..., -history.shape[-2] :, :]
