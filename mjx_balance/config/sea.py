"""The sea: a wave spectrum, and how large and fast its motions are at most.

Bretschneider's spectrum of significant height H and peak frequency w_p (ITTC 2017, Recommended
Procedure 7.5-02-07-01.1, section 3.1) is

  S(w) = 5/16 H^2 w_p^4 / w^5 exp(-5/4 (w_p / w)^4),

with variance H^2 / 16. Its integral is elementary, so that a share of the energy gives a frequency.
Frequencies above `HIGHEST` w_p are left out; their energy, 7.5%, goes to the others.
"""

import functools
import math
from typing import Any

from mjx_balance.config.schema import GRAVITY, ConfigError, TaskConfig

WAVES = 8
"""Waves of a sea, of equal energy. The sum of so many amplitudes, sqrt(2 * WAVES) / 4 of the
significant height, is the height itself."""
HIGHEST = 2.0  #: greatest frequency, in peak frequencies
TOP = math.exp(-1.25 / HIGHEST**4)  #: share of the spectrum's energy below it


def frequency(share: Any) -> Any:
    """Frequency below which a share of a sea's energy lies, as a multiple of the peak frequency.

    `share` is an array of (0, 1].
    """
    xp = share.__array_namespace__()
    return (1.25 / -xp.log(TOP * share)) ** 0.25


def fade(time: Any, period: float) -> Any:
    """Factor on a sea's motion: in the first peak period it rises smoothly, as boards start level.

    `time` is an array, s.
    """
    part = time.__array_namespace__().clip(time / period, 0.0, 1.0)
    return part * part * (3.0 - 2.0 * part)


@functools.cache
def bounds() -> tuple[float, float]:
    """Greatest speed and acceleration of a sea of significant height 1 and peak period 1 s.

    The derivatives of `fade` times a sine of each wave, in the fastest case, at the worst time.
    """
    import numpy as np  # here, so that a command line is read before it is imported

    time = np.linspace(0.0, 1.0, 1001)
    omega = 2 * np.pi * frequency(np.arange(1, WAVES + 1)[:, None] / WAVES)
    size, slope, bend = fade(time, 1.0), 6 * time * (1 - time), 6 - 12 * time
    rate = np.hypot(omega * size, slope)
    acceleration = np.hypot(bend - omega**2 * size, 2 * omega * slope)
    return float(rate.mean(axis=0).max()), float(acceleration.mean(axis=0).max())


def significant_angle(task: TaskConfig) -> float:
    """Significant height of the board's angle, deg, which the waves never exceed.

    Raises:
      ConfigError: if it exceeds max_incline, or waves may turn the board faster than board_rate.
    """
    fastest = task.board_rate * task.sea_period / bounds()[0]
    if task.sea_angle is None:
        return min(task.max_incline, fastest)
    if task.sea_angle > task.max_incline:
        raise ConfigError(
            f"sea_angle is {task.sea_angle} deg; it must not exceed max_incline, "
            f"{task.max_incline} deg"
        )
    if task.sea_angle > fastest:
        raise ConfigError(
            f"sea_angle is {task.sea_angle} deg; with sea_period {task.sea_period} s the board "
            f"would exceed board_rate, {task.board_rate} deg/s: at most {fastest:.3g} deg, or a "
            "longer period"
        )
    return task.sea_angle


def check_platform(task: TaskConfig) -> None:
    """Raises `ConfigError` if the platform may fall away faster than the robot."""
    highest = GRAVITY * task.sea_period**2 / bounds()[1]
    if task.sea_height > highest:
        raise ConfigError(
            f"sea_height is {task.sea_height} m; with sea_period {task.sea_period} s the platform "
            f"would fall faster than the robot: at most {highest:.3g} m, or a longer period"
        )
