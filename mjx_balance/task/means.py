"""Inputs with a long memory that needs no recurrence: leaky means, and complementary filters.

Both are weighted means of the samples since the start; a weight falls by 1/e in a time constant
tau. A leaky mean of a sensor shows what stays the same, such as a bias. A complementary filter
integrates the gyro and leans toward gravity's angle (Mahony et al. 2008,
https://hal.science/hal-00488376, section III, with fixed gain and no bias): angle += dt * gyro,
then angle += dt / (tau + dt) * (gravity's angle - angle). That is the leaky mean of gravity's
angle + tau * gyro.
"""

from collections.abc import Sequence

import numpy as np
from jaxtyping import Float

from mjx_balance.task import Array
from mjx_balance.task.attitude import gravity_angles
from mjx_balance.task.observation import SENSORS, Row

STANDING = 1.0
"""Time, s, for which the first sample counts in a leaky mean (chosen: a sample alone is noisy, and
after a minute of it a mean would be slow to learn)."""

Means = Float[Array, "*batch 2 rows"]
"""Weighted sums of the samples, and sums of their weights, of rows with a time constant."""


def start_means(rows: Sequence[Row], dt: float, still: Float[Array, "*batch 6"]) -> Means:
    """The means of a robot that has been standing still.

    Args:
      rows: with a time constant.
      dt: time between samples, s.
      still: IMU sample, rad/s and m/s^2.
    """
    xp, samples = still.__array_namespace__(), _samples(rows, still)
    whole = [row.sensor == "angle" for row in rows]
    weights = 1 - (1 - _leaks(rows, dt)) ** round(STANDING / dt)
    weights = np.where(whole, 1.0, weights).astype(still.dtype)
    return xp.stack((weights * samples, weights + 0 * samples), axis=-2)


def update_means(
    rows: Sequence[Row], dt: float, means: Means, imu: Float[Array, "*batch samples 6"]
) -> Means:
    """The means after more samples, the newest last; otherwise as `start_means`."""
    xp, samples = imu.__array_namespace__(), _samples(rows, imu)
    leak, count = _leaks(rows, dt), imu.shape[-2]
    weights = (leak * (1 - leak) ** np.arange(count)[::-1, None]).astype(imu.dtype)
    both = xp.stack((samples, 1 + 0 * samples), axis=-3)
    return means * ((1 - leak) ** count).astype(imu.dtype) + (weights * both).sum(axis=-2)


def _leaks(rows: Sequence[Row], dt: float) -> Float[np.ndarray, " rows"]:
    """Weight of the newest sample."""
    times = np.asarray([row.time_constant for row in rows])
    return dt / (times + dt)


def _samples(rows: Sequence[Row], imu: Float[Array, "*batch 6"]) -> Float[Array, "*batch rows"]:
    """What is averaged."""
    xp, angles = imu.__array_namespace__(), gravity_angles(imu[..., 3:])
    samples = []
    for row in rows:
        if row.sensor == "angle":  # whose gyro has the same index
            samples.append(angles[..., row.index] + row.time_constant * imu[..., row.index])
        else:
            samples.append(imu[..., SENSORS[row.sensor].channel + row.index])
    return xp.stack(samples, axis=-1)
