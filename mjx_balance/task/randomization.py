"""Domain randomisation: noise, payload, friction, gains and delay differ from env to env."""

from typing import NamedTuple

import numpy as np

from mjx_balance.config import RandomizationConfig
from mjx_balance.robots.catalogue import Robot
from mjx_balance.task import Array

DRAWS = 6
"""Uniform random numbers that the parameters of one env take."""


class DomainParams(NamedTuple):
    """What differs from env to env, of one env or of a batch of them."""

    imu_noise: Array
    """(..., 6) standard deviation of every IMU sample, rad/s and m/s^2."""
    payload: Array
    """(...) mass carried on the trunk, kg."""
    payload_at: Array
    """(..., 3) where, in the trunk's frame, m."""
    friction: Array
    """(...) sliding friction of the feet."""
    gain: Array
    """(...) factor on the leg servos' position gain."""
    delay: Array
    """(...) decisions between choosing an action and taking it, 0 or 1."""


def draw_params(ranges: RandomizationConfig, robot: Robot, uniform: Array) -> DomainParams:
    """Turns random numbers into domain parameters.

    Args:
      ranges: how far things may differ; those of the preset `paper` leave everything as it is.
      robot: the nominal friction.
      uniform: (..., DRAWS) in [0, 1).

    Returns:
      Parameters with the leading dimensions of `uniform`.
    """
    xp = uniform.__array_namespace__()
    u = xp.moveaxis(uniform, -1, 0)
    sigma = np.asarray([ranges.gyro_noise] * 3 + [ranges.accel_noise] * 3, uniform.dtype)
    offset = ranges.payload_offset
    at = xp.stack(
        (offset * (2 * u[1] - 1), offset * (2 * u[2] - 1), 0 * u[0] + ranges.payload_height),
        axis=-1,
    )
    friction_min = robot.foot_friction if ranges.friction_min is None else ranges.friction_min
    friction_max = robot.foot_friction if ranges.friction_max is None else ranges.friction_max
    return DomainParams(
        imu_noise=xp.zeros_like(u[0])[..., None] + sigma,
        payload=ranges.payload * u[0],
        payload_at=at,
        friction=friction_min + (friction_max - friction_min) * u[3],
        gain=1 + ranges.gain_spread * (2 * u[4] - 1),
        delay=(u[5] < ranges.latency_share).astype(uniform.dtype),
    )
