"""Inputs with a time constant, by loops over single samples in double precision."""

import math
import types
from functools import partial
from typing import Any

import numpy as np
import pytest

from mjx_balance.config import TaskConfig
from mjx_balance.robots.catalogue import Robot
from mjx_balance.task.means import start_means, update_means
from mjx_balance.task.observation import input_rows, mean_rows

TASK = TaskConfig(mean_times=(0.05, 30.0), filter_times=(4.0, 0.1))
DT, COUNT = 0.004, 20
PLACES = (0, 1, 0, 1, 3, 4, 3, 4)
"""Channels of the means: gyro x and y with both times, then accelerometer x and y."""


def sway(decisions: int = 12) -> np.ndarray:
    """(2, decisions, COUNT, 6) samples of two robots that sway, with noise and a bias."""
    rng, time = np.random.default_rng(0), DT * np.arange(decisions * COUNT)
    roll = 0.1 * np.sin(3 * time)
    level = np.stack((0.3 * np.cos(3 * time), 0 * time, 0.01 + 0 * time), axis=-1)
    gravity = 9.81 * np.stack((0.05 + 0 * time, np.sin(roll), np.cos(roll)), axis=-1)
    both = np.stack([np.concatenate((level, gravity), axis=-1)] * 2)
    noise = rng.normal(0, (0.02, 0.03, 0.04, 0.1, 0.2, 0.3), both.shape)
    return (both + noise).reshape(2, decisions, COUNT, 6)


@pytest.fixture(scope="module")
def rows(robot: Robot) -> tuple[Any, ...]:
    return mean_rows(input_rows(TASK, robot))


def values(means: Any) -> np.ndarray:
    """What the observation shows."""
    sums, weights = np.moveaxis(np.asarray(means, float), -2, 0)
    return sums / weights


def filtered(still: np.ndarray, samples: np.ndarray, tau: float) -> tuple[float, float]:
    """Roll and pitch of a complementary filter, rad, that a robot at rest has run for long.

    There the gyro's bias b turns it as fast as gravity pulls it back: it rests tau * b beside.
    """

    def gravity(sample: np.ndarray) -> tuple[float, float]:
        x, y, z = sample[3:]
        return math.atan2(y, z), math.atan2(-x, math.sqrt(y * y + z * z))

    angles = [g + tau * b for g, b in zip(gravity(still), still[:2], strict=True)]
    for sample in samples:
        for axis in range(2):
            turned = angles[axis] + DT * sample[axis]
            angles[axis] = turned + DT / (tau + DT) * (gravity(sample)[axis] - turned)
    return angles[0], angles[1]


def test_means_and_filters_sample_by_sample(
    xp: types.ModuleType, compiled: Any, rows: tuple[Any, ...]
) -> None:
    """The standing robot's sample counts for a second, 250 times, in a mean."""
    imu = sway()
    still = imu[:, 0, 0]
    update = compiled(partial(update_means, rows, DT))
    means = start_means(rows, DT, xp.asarray(still, float))
    rtol = 1e-9 if xp is np else 1e-3
    for number in range(imu.shape[1]):
        means = update(means, xp.asarray(imu[:, number], float))
        for n in range(2):
            seen = imu[n, : number + 1].reshape(-1, 6)
            stream = np.concatenate((np.tile(still[n], (250, 1)), seen))[::-1]  # the newest first
            expected = []
            for k, channel in enumerate(PLACES):
                leak = DT / ((0.05, 30.0)[k // 2 % 2] + DT)
                weights = [(1 - leak) ** age for age in range(len(stream))]
                expected.append(np.average(stream[:, channel], weights=weights))
            for tau in (4.0, 0.1):
                expected += filtered(still[n], seen, tau)
            np.testing.assert_allclose(values(means)[n], expected, rtol=rtol, atol=1e-3 * rtol)


def test_one_robot_is_a_row_of_a_batch(
    xp: types.ModuleType, compiled: Any, rows: tuple[Any, ...]
) -> None:
    imu = xp.asarray(sway(2), float)
    start = partial(start_means, rows, DT)
    update = compiled(partial(update_means, rows, DT))
    whole = update(start(imu[:, 0, 0]), imu[:, 1])
    alone = update(start(imu[1, 0, 0]), imu[1, 1])
    assert whole.shape == (2, 2, 12)
    np.testing.assert_allclose(whole[1], alone, rtol=1e-6, atol=1e-9)


def test_a_mean_knows_a_bias_and_the_filter_shows_tau_times_as_much(
    rows: tuple[Any, ...],
) -> None:
    """After a minute at rest, with 0.01 rad/s that the robot did not show while it stood before."""
    sample = np.asarray((0.01, 0, 0, 0, 0, 9.81))
    means = start_means(rows, DT, sample * (0, 0, 0, 0, 0, 1))
    means = update_means(rows, DT, means, np.tile(sample, (15_000, 1)))
    shown = values(means)
    half = (1 - math.exp(-2)) / (1 - math.exp(-61 / 30))  # of a mean whose memory is 30 s
    np.testing.assert_allclose(shown[[0, 2, 8, 10]], (0.01, 0.01 * half, 0.04, 0.001), rtol=2e-4)
