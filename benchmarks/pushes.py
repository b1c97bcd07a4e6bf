"""What a kick does to the robot, and how long until it stands as before. Plain MuJoCo.

Every scenario of suite `push` is run twice, with its kicks and without. A kick is overcome once the
tilt stays within `SETTLED` of its twin's until the next kick.

    python benchmarks/pushes.py POLICY ... [--scenarios 16] [--duration 60] [--write PAGE]
"""

import argparse
from collections.abc import Mapping
from pathlib import Path

import numpy as np
from markers import publish, table

from mjx_balance.config import TaskConfig, preset
from mjx_balance.evaluation.controllers import Controller, make_controller
from mjx_balance.evaluation.rollout import observing, policy_scene, roll_out
from mjx_balance.evaluation.suites import SEEDS, SUITES, make_pushes, make_scenarios
from mjx_balance.policy.file import load_policy
from mjx_balance.sim.scene import Scene, load_scene

BASELINES = ("pd-imu", "pd-attitude", "rate-oracle", "clairvoyant")
SETTLED = 0.2
"""Tilt that is no consequence of a kick any more, deg."""


def settling(task: TaskConfig, pushed: np.ndarray, calm: np.ndarray, at: np.ndarray) -> np.ndarray:
    """Time from every kick to the last difference above `SETTLED` before the next.

    Args:
      task: length of a decision.
      pushed: (scenarios, steps) tilt with kicks, deg.
      calm: (scenarios, steps) without, deg.
      at: (n,) numbers of the kicked decisions.

    Returns:
      (scenarios, n) s.
    """
    apart = np.abs(pushed - calm) > SETTLED
    ends = [*at[1:] * task.sim_steps, apart.shape[1]]
    times = []
    for begin, end in zip(at * task.sim_steps, ends, strict=True):
        span = apart[:, begin:end]
        times.append(span.any(axis=1) * (span.shape[1] - span[:, ::-1].argmax(axis=1)))
    return np.stack(times, axis=-1) * task.sim_dt


def measured(scene: Scene, controller: Controller, scenarios: int, duration: float) -> list[str]:
    """The cells of one controller."""
    config, seed = scene.config, SEEDS.held_out
    drawn, conditions = make_scenarios(config, "push", scenarios, duration, seed)
    pushes = make_pushes(config, "push", scenarios, duration, seed)
    calm, pushed = (
        roll_out(scene, controller, drawn, duration, conditions=conditions, pushes=kicks)
        for kicks in (None, pushes)
    )
    times = settling(config.task, pushed.tilt, calm.tilt, pushes.at)
    p95, most = np.percentile(pushed.tilt, (95, 100))
    tilts = (pushed.tilt.mean(), p95, most, np.percentile(calm.tilt, 95))
    seconds = np.percentile(times, (50, 95))
    return [
        f"{pushed.fell.sum()} of {scenarios}",
        *(f"{tilt:.3f}" for tilt in tilts),
        *(f"{time:.2f} s" for time in seconds),
    ]


def main() -> None:
    """Measures policies and baselines, and prints a table."""
    parser = argparse.ArgumentParser()
    parser.add_argument("policies", nargs="+", type=Path)
    parser.add_argument("--scenarios", type=int, default=16)
    parser.add_argument("--duration", type=float, default=60.0)
    parser.add_argument("--write", type=Path, help="Markdown file with markers")
    args = parser.parse_args()
    if args.duration <= SUITES["push"].randomization.push_period:
        parser.error(f"duration is {args.duration:g} s; the first kick must come before the end")
    who: Mapping[str, tuple[Scene, Controller]] = {}
    for path in args.policies:
        policy = load_policy(path)
        who[str(path)] = policy_scene(policy), observing(policy)
    scene = load_scene(preset("default"))
    who |= {name: (scene, make_controller(name, scene)) for name in BASELINES}
    rows = [
        [f"`{name}`", *measured(*acts, args.scenarios, args.duration)] for name, acts in who.items()
    ]
    columns = ("controller", "falls", "mean", "p95", "max", "p95 without kicks")
    columns += ("half overcome in", "95% in")
    note = (
        f"{args.scenarios} held-out scenarios of {args.duration:g} s of suite `push`, tilt in deg; "
        f"a kick is overcome when the tilt stays within {SETTLED:g} deg of what it is without."
    )
    publish("pushes", [*table(columns, rows), "", note], args.write)


if __name__ == "__main__":
    main()
