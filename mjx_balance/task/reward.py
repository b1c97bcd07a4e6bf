"""Failure and the three rewards of paper 3.2."""

from mjx_balance.config import TaskConfig
from mjx_balance.task import Array

REWARDS = ("level", "toward", "fail")
"""Names of the rewards."""


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
      level: Eq. 4, w * exp(-1.5 * tilt); a tilt is never negative.
      toward: Fig. 5, w * clip((before - after) / scale, -1, 1).
      fail: -0.5 on a fall.
    """
    xp = after.__array_namespace__()
    gain = xp.clip((before - after) / task.reward_toward_scale, -1.0, 1.0)
    return {
        "level": task.reward_level * xp.exp(-task.reward_sharpness * after),
        "toward": task.reward_toward * gain,
        "fail": task.reward_fail * fell,
    }
