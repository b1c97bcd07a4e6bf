"""Domain randomisation: noise, payload, friction, gains and delay differ from env to env."""

from typing import NamedTuple

import numpy as np
from jaxtyping import Float

from mjx_balance.config import RandomizationConfig
from mjx_balance.robots.catalogue import Robot
from mjx_balance.task import Array

DRAWS = 6  #: uniform random numbers that the parameters of one env take, but for softness


class DomainParams(NamedTuple):
    """What differs from env to env, of one env or of a batch of them."""

    imu_noise: Float[Array, "*batch 6"]  #: standard deviation of every IMU sample, rad/s and m/s^2
    payload: Float[Array, "*batch"]  #: mass carried on the trunk, kg
    payload_at: Float[Array, "*batch 3"]  #: where, in the trunk's frame, m
    friction: Float[Array, "*batch legs"]  #: sliding friction of every foot
    gain: Float[Array, "*batch legs 3"]  #: factor on the position gain of every leg servo
    delay: Float[Array, "*batch"]  #: decisions between choosing an action and taking it, 0 or 1
    softness: Float[Array, "*batch"]  #: of the servos, 0: the robot's, 1: `sim.scene.soft_factors`


def param_draws(ranges: RandomizationConfig) -> int:
    """Uniform random numbers that `draw_params` takes for one env."""
    return DRAWS + (ranges.soft_share > 0)


def load_place(
    ranges: RandomizationConfig, x: Float[Array, "*batch"], y: Float[Array, "*batch"]
) -> Float[Array, "*batch 3"]:
    """Where a load lies, in the trunk's frame, m, for two random numbers in [0, 1)."""
    xp, offset = x.__array_namespace__(), ranges.payload_offset
    at = offset * (2 * x - 1), offset * (2 * y - 1), 0 * x + ranges.payload_height
    return xp.stack(at, axis=-1)


def draw_params(
    ranges: RandomizationConfig, robot: Robot, uniform: Float[Array, "*batch draws"]
) -> DomainParams:
    """Turns `param_draws` random numbers in [0, 1) into domain parameters of a robot."""
    xp = uniform.__array_namespace__()
    u = xp.moveaxis(uniform, -1, 0)
    sigma = np.asarray([ranges.gyro_noise] * 3 + [ranges.accel_noise] * 3, uniform.dtype)
    friction_min = robot.foot_friction if ranges.friction_min is None else ranges.friction_min
    friction_max = robot.foot_friction if ranges.friction_max is None else ranges.friction_max
    legs, share = np.ones(len(robot.legs), uniform.dtype), ranges.soft_share
    return DomainParams(
        imu_noise=xp.zeros_like(u[0])[..., None] + sigma,
        payload=ranges.payload * u[0],
        payload_at=load_place(ranges, u[1], u[2]),
        friction=(friction_min + (friction_max - friction_min) * u[3])[..., None] * legs,
        gain=(1 + ranges.gain_spread * (2 * u[4] - 1))[..., None, None]
        * legs[:, None]
        * np.ones(3, uniform.dtype),
        delay=(u[5] < ranges.latency_share).astype(uniform.dtype),
        softness=xp.where(u[-1] < share, u[-1] / share, 0.0) if share else 0 * u[0],
    )
