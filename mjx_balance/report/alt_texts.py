"""What a page's figures show, in words, for readers who do not see them."""

from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np

from mjx_balance.config import TaskConfig
from mjx_balance.evaluation.envelope import Envelope
from mjx_balance.evaluation.rollout import Rollout

OFTEN = 0.01  #: share of the time that the distribution's alt text is about


def curves_alt(runs: Sequence[Sequence[Mapping[str, Any]]]) -> str:
    """Learning curves: first and last value of tilt and falls in the longest run."""
    longest = max(runs, key=lambda run: run[-1]["env_steps"])
    first, last = longest[0], longest[-1]
    changes = [
        f"the {what} goes from {first[name]:.3g} to {last[name]:.3g}"
        for name, what in (
            ("train/tilt_deg", "mean tilt in degrees"),
            ("train/falls_per_minute", "number of falls per robot-minute"),
        )
    ]
    return (
        f"Tilt, falls, reward, loss, epsilon and speed over {last['env_steps']:,} decisions. "
        f"While the policy explores, {' and '.join(changes)}."
    )


def reward_alt(task: TaskConfig) -> str:
    """The two terms of the reward."""
    return (
        f"The reward for the tilt falls from {task.reward_level:g} when level toward 0 at "
        f"{task.fail_tilt:g} degrees. The reward for a change rises from {-task.reward_toward:g} "
        f"to {task.reward_toward:g} as the tilt decreases in a decision."
    )


def rollout_alt(suite: str, rollouts: Mapping[str, Rollout]) -> str:
    """How much the bodies tilt in a recorded scenario."""
    tilts = [
        f"{name} {rollout.tilt.mean():.3f} on average and {rollout.tilt.max():.2f} at most"
        + (", and falls" if rollout.fell[0] else "")
        for name, rollout in rollouts.items()
    ]
    return (
        "Angles of the board, roll and pitch of the body, and its tilt on a log scale, over time "
        f"in a scenario of suite {suite}. Body tilt in degrees: {'; '.join(tilts)}."
    )


def tilt_alt(shares: Mapping[str, np.ndarray], edges: np.ndarray) -> str:
    """The tilt that each body exceeds in a hundredth of the time."""
    limits = []
    for name, share in shares.items():
        beyond = 1 - np.cumsum(share)
        limits.append(f"{name} {edges[1:][np.argmax(beyond <= OFTEN + 1e-12)]:.2f}")
    return (
        "Six curves that fall from left to right: the share of the time over the tilt that is "
        f"exceeded. {OFTEN:.0%} of the time the tilt is above, in degrees: {', '.join(limits)}."
    )


def envelope_alt(envelope: Envelope) -> str:
    """Where in the map of board angles and speeds robots fall."""
    beyond = np.add.outer(
        np.asarray(envelope.inclines) > envelope.reach,
        np.asarray(envelope.rates) > envelope.authority,
    )
    falls = np.asarray(envelope.fall_rate) > 0
    inside, outside = falls[~beyond], falls[beyond]
    return (
        f"Two maps over board speeds from {envelope.rates[0]:g} to {envelope.rates[-1]:g} degrees "
        f"per second and board angles from {envelope.inclines[0]:g} to {envelope.inclines[-1]:g} "
        f"degrees. Robots fall in {inside.sum()} of the {inside.size} cells that actions and legs "
        f"can follow, and in {outside.sum()} of the {outside.size} beyond."
    )
