"""Failure, and the reward as a table of terms: the three of paper 3.2."""

from collections.abc import Callable
from typing import NamedTuple

from jaxtyping import Bool, Float

from mjx_balance.config import TaskConfig
from mjx_balance.task import Array


class RewardInputs(NamedTuple):
    """What the reward looks at of one decision.

    With `reward_tilt` "mean" both tilts are means: over the decision before and over this one.
    """

    tilt_before: Float[Array, "*batch"]  #: body tilt when the decision was taken, deg
    tilt_after: Float[Array, "*batch"]  #: body tilt at its end, deg
    fell: Float[Array, "*batch"]  #: 1 where the body failed on the way, else 0


class RewardRow(NamedTuple):
    """One term of the reward: `weight * function(task, inputs)`."""

    name: str  #: its metric is `reward_NAME`
    function: Callable[[TaskConfig, RewardInputs], Array]
    weight: float


def level(task: TaskConfig, inputs: RewardInputs) -> Float[Array, "..."]:
    """Eq. 4: exp(-sharpness * tilt); a tilt is never negative."""
    xp = inputs.tilt_after.__array_namespace__()
    return xp.exp(-task.reward_sharpness * inputs.tilt_after)


def toward(task: TaskConfig, inputs: RewardInputs) -> Float[Array, "..."]:
    """Fig. 5: tilt lost, over a scale, from -1 to 1."""
    xp = inputs.tilt_after.__array_namespace__()
    gain = inputs.tilt_before - inputs.tilt_after
    return xp.clip(gain / task.reward_toward_scale, -1.0, 1.0)


def fail(task: TaskConfig, inputs: RewardInputs) -> Float[Array, "..."]:
    """1 on a fall."""
    return inputs.fell


def reward_rows(task: TaskConfig) -> tuple[RewardRow, ...]:
    """The terms of the reward, in the order in which they are added."""
    return (
        RewardRow("level", level, task.reward_level),
        RewardRow("toward", toward, task.reward_toward),
        RewardRow("fail", fail, task.reward_fail),
    )


def reward_terms(task: TaskConfig, inputs: RewardInputs) -> dict[str, Float[Array, "..."]]:
    """The weighted terms of one decision by name; the reward is their sum."""
    return {row.name: row.weight * row.function(task, inputs) for row in reward_rows(task)}


def failed(task: TaskConfig, tilt: Float[Array, "*batch"]) -> Bool[Array, "*batch"]:
    """True where the body's tilt, in deg, is above `fail_tilt`, or is not a number."""
    return ~(tilt <= task.fail_tilt)
