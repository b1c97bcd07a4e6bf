"""Body tilt, failure and the three rewards of paper 3.2."""

import numpy as np

from mjx_balance.config import TaskConfig
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


def failed(task: TaskConfig, tilt: Array) -> Array:
    """True where the body tilts past `fail_tilt`, or is no number at all.

    Args:
      task: the limit.
      tilt: (...) deg.
    """
    return ~(tilt <= task.fail_tilt)


def reward_terms(task: TaskConfig, before: Array, after: Array, fell: Array) -> dict[str, Array]:
    """The paper's three rewards for one decision.

    Args:
      task: weights.
      before: (...) body tilt when the decision was taken, deg.
      after: (...) body tilt at its end, deg.
      fell: (...) 1 where the body failed on the way, else 0.

    Returns:
      level: Eq. 4, w * exp(-1.5 * abs(tilt)).
      toward: Fig. 5, w * clip((before - after) / scale, -1, 1).
      fail: -0.5 on a fall.
    """
    xp = after.__array_namespace__()
    gain = xp.clip((before - after) / task.reward_toward_scale, -1.0, 1.0)
    return {
        "level": task.reward_level * xp.exp(-task.reward_sharpness * xp.abs(after)),
        "toward": task.reward_toward * gain,
        "fail": task.reward_fail * fell,
    }
