"""How the body is tilted."""

import numpy as np
from jaxtyping import Float

from mjx_balance.task import Array


def body_tilt(quat: Float[Array, "*batch 4"]) -> Float[Array, "*batch"]:
    """Angle between the body's z axis and the world's, 0 to 180 deg; quaternions have w first.

    The half-angle form keeps its precision near the upright in float32, where
    the arccosine of the rotation matrix would be good to 0.02 deg only.
    """
    xp = quat.__array_namespace__()
    half_sine = xp.sqrt(quat[..., 1] ** 2 + quat[..., 2] ** 2)
    return 2 * (180 / np.pi) * xp.arcsin(xp.clip(half_sine, 0.0, 1.0))


def gravity_angles(accel: Float[Array, "*batch 3"]) -> Float[Array, "*batch 2"]:
    """Roll and pitch, rad, of a body at rest whose accelerometer reads `accel`, m/s^2."""
    xp = accel.__array_namespace__()
    x, y, z = accel[..., 0], accel[..., 1], accel[..., 2]
    return xp.stack((xp.arctan2(y, z), xp.arctan2(-x, xp.hypot(y, z))), axis=-1)


def roll_pitch(
    quat: Float[Array, "*batch 4"],
) -> tuple[Float[Array, "*batch"], Float[Array, "*batch"]]:
    """Roll and pitch of unit quaternions, deg, yaw first convention."""
    w, x, y, z = np.moveaxis(quat, -1, 0)
    roll = np.arctan2(2 * (w * x + y * z), 1 - 2 * (x * x + y * y))
    pitch = np.arcsin(np.clip(2 * (w * y - z * x), -1, 1))
    return np.degrees(roll), np.degrees(pitch)
