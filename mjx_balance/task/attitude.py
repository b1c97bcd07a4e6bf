"""How the body is tilted."""

import numpy as np

from mjx_balance.task import Array


def body_tilt(quat: Array) -> Array:
    """Angle between the body's z axis and the world's.

    The half-angle form keeps its precision near the upright in float32, where
    the arccosine of the rotation matrix would be good to 0.02 deg only.

    Args:
      quat: (..., 4) unit quaternion, w first.

    Returns:
      (...) deg, 0 to 180.
    """
    xp = quat.__array_namespace__()
    half_sine = xp.sqrt(quat[..., 1] ** 2 + quat[..., 2] ** 2)
    return 2 * (180 / np.pi) * xp.arcsin(xp.clip(half_sine, 0.0, 1.0))


def roll_pitch(quat: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Roll and pitch (...) in deg of unit quaternions (..., 4), yaw first convention."""
    w, x, y, z = np.moveaxis(quat, -1, 0)
    roll = np.arctan2(2 * (w * x + y * z), 1 - 2 * (x * x + y * y))
    pitch = np.arcsin(np.clip(2 * (w * y - z * x), -1, 1))
    return np.degrees(roll), np.degrees(pitch)
