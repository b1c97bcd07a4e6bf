"""The observation of paper Eq. 2: four foot heights and lagged raw IMU samples.

On request the commanded foot heights follow the measured ones.
"""

import numpy as np

from mjx_balance.config import TaskConfig
from mjx_balance.robots.catalogue import Robot
from mjx_balance.task import Array

IMU_CHANNELS = 6
"""Gyro x, y, z in rad/s, then accelerometer x, y, z in m/s^2."""


def observation_names(task: TaskConfig, robot: Robot) -> tuple[str, ...]:
    """Name of every observation entry, in order, e.g. `H_LF`, `V_x,t-2`, `Acc_y,t-15`.

    Commanded heights are `C_LF,d-1`: LF's of the decision before the latest. With
    `task.imu_mean` = 5, `V_x,t-10` is the mean of the samples 10 to 14 steps back.
    """
    names = [f"H_{leg}" for leg in robot.names]
    names += [f"C_{leg},d-{lag}" for lag in task.command_lags for leg in robot.names]
    for symbol, lags in (("V", task.gyro_lags), ("Acc", task.accel_lags)):
        names += [f"{symbol}_{axis},t-{lag}" for axis in "xy" for lag in lags]
    return tuple(names)


def observation_scale(task: TaskConfig, robot: Robot) -> np.ndarray:
    """(obs_size,) physical size of a network input of 1: m, rad/s and m/s^2."""
    return np.asarray(
        [task.height_scale] * (1 + len(task.command_lags)) * len(robot.legs)
        + [task.gyro_scale] * 2 * len(task.gyro_lags)
        + [task.accel_scale] * 2 * len(task.accel_lags),
        np.float32,
    )


def observe(task: TaskConfig, robot: Robot, heights: Array, commanded: Array, imu: Array) -> Array:
    """Builds the scaled observation.

    Args:
      task: lags and scales.
      robot: leg order.
      heights: (..., legs) measured foot heights, m.
      commanded: (..., task.command_history, legs) commanded foot heights, the newest last, m.
      imu: (..., task.history, 6) latest IMU samples, the newest last.

    Returns:
      (..., obs_size) in the order of `observation_names`.
    """
    xp = imu.__array_namespace__()
    newest = imu.shape[-2] - 1
    block = np.arange(task.imu_mean)[:, None]
    gyro = imu[..., newest - block - np.asarray(task.gyro_lags), :].mean(axis=-3)
    accel = imu[..., newest - block - np.asarray(task.accel_lags), :].mean(axis=-3)
    latest = commanded.shape[-2] - 1
    parts = (
        heights - task.body_height,
        *(commanded[..., latest - lag, :] - task.body_height for lag in task.command_lags),
        gyro[..., 0],
        gyro[..., 1],
        accel[..., 3],
        accel[..., 4],
    )
    return xp.concatenate(parts, axis=-1) / observation_scale(task, robot).astype(imu.dtype)


def extend_history(history: Array, samples: Array) -> Array:
    """Appends (..., m, k) samples to a (..., h, k) history and keeps the last h."""
    xp = history.__array_namespace__()
    return xp.concatenate((history, samples), axis=-2)[..., -history.shape[-2] :, :]
