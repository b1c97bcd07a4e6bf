"""Figures of a rollout, as JSON values."""

from typing import TYPE_CHECKING, Any

import numpy as np

if TYPE_CHECKING:
    from mjx_balance.evaluation.rollout import Rollout

SETTLED_SECONDS = 3.0
"""End of every target's period in which the board has long been at rest, s."""


def summarize(rollout: "Rollout", suite: str, duration: float, seed: int) -> dict[str, Any]:
    """The evaluation as JSON values, tilt statistics over every physics step."""
    tilts = rollout.tilt
    p50, p95, p99 = np.percentile(tilts, (50, 95, 99))
    falls = int(rollout.fell.sum())
    return {
        "suite": suite,
        "scenarios": len(tilts),
        "duration_s": float(duration),
        "seed": seed,
        "falls": falls,
        "fall_rate": falls / len(tilts),
        "tilt_deg": {
            "mean": float(tilts.mean()),
            "rms": float(np.sqrt(np.mean(tilts**2))),
            "p50": float(p50),
            "p95": float(p95),
            "p99": float(p99),
            "max": float(tilts.max()),
        },
        "action_mm_mean": float(np.nanmean(rollout.action_mm)),
        "action_mm_settled": settled_action(rollout),
        "physics_steps_per_second": float(rollout.fell_at.sum() / rollout.seconds),
    }


def settled_action(rollout: "Rollout") -> float | None:
    """Mean commanded height change, mm per decision and axis, while the board rests.

    Taken over the last `SETTLED_SECONDS` of every period of a standing robot; none if
    there is no such decision.
    """
    task = rollout.task
    until = task.target_period - np.arange(rollout.action_mm.shape[1]) * task.ctrl_dt
    until = until % task.target_period
    values = rollout.action_mm[:, (until > 1e-9) & (until <= SETTLED_SECONDS + 1e-9)]
    return None if np.isnan(values).all() else float(np.nanmean(values))
