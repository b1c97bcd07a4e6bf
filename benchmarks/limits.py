"""What can any controller reach with these actions?

Tables, one per call (`--table`):
  ramp    `rate-oracle` and `pd-attitude` while the legs move for other shares of a decision;
  push    policy and baselines in every scenario of suite `push`, with its pushes and without. A
          push is overcome once the tilt stays within `SETTLED` of its twin's until the next push;
  decks   policy and `pd-imu` on decks at sea, from calm to faster than the legs can follow;
  gains   the PD baselines' gains, tuned on training seeds of `--suite` by coordinate search: each
          in turn is set to the best of a few values until a round changes nothing. Those of suite
          `paper` are the defaults in `mjx_balance/evaluation/controllers.py`.

    python benchmarks/limits.py [--table ramp] [--write benchmarks/README.md]
"""

import argparse
import dataclasses
from pathlib import Path

import common
import numpy as np
from common import DURATION, POLICY, Row

from mjx_balance.config import TaskConfig, preset
from mjx_balance.config.sea import bounds
from mjx_balance.evaluation.controllers import AttitudePD, Controller, ImuPD, make_controller
from mjx_balance.evaluation.rollout import observing, policy_scene, roll_out, run_suite, summarize
from mjx_balance.evaluation.suites import HEADLINE, SEEDS, SUITES, draw_suite
from mjx_balance.policy.file import load_policy
from mjx_balance.sim.scene import Scene, load_scene

RAMPS = (0.02, 0.1, 0.2, 0.4, 0.6)
RAMPED = ("rate-oracle", "pd-attitude")
PUSHED = ("pd-imu", "pd-attitude", "rate-oracle", "clairvoyant")
SEAS = (
    *((2.0, 10.0, 0.0), (4.3, 10.0, 0.0), (7.0, 10.0, 0.0), (7.0, 7.0, 0.0), (10.0, 7.0, 0.0)),
    *((4.3, 10.0, 0.25), (4.3, 10.0, 1.0), (4.3, 10.0, 3.0), (7.0, 7.0, 2.0)),
)
"""Significant angles, deg, peak periods, s, and significant heights, m."""
SETTLED = 0.2
"""Tilt that is no consequence of a push any more, deg."""
GRIDS: dict[type, dict[str, tuple[float, ...]]] = {
    AttitudePD: {
        "proportional": (0.2, 0.4, 0.6, 0.8, 0.9, 1.0, 1.1, 1.2, 1.3, 1.4, 1.5, 1.6),
        "rate": (0.08, 0.1, 0.12, 0.14, 0.16, 0.18, 0.2),
    },
    ImuPD: {
        "tau": (0.1, 0.2, 0.5, 1.0, 2.0, 4.0, 8.0, 16.0),
        "proportional": (0.2, 0.4, 0.6, 0.8, 0.9, 1.0, 1.1, 1.2, 1.3, 1.4),
        "rate": (0.0, 0.04, 0.08, 0.12, 0.14, 0.16, 0.18, 0.2, 0.22),
        "samples": (1, 3, 6, 12, 20),
    },
}


def ramp(args: argparse.Namespace) -> None:
    """Table `ramp`."""
    default, rows = preset("default"), []
    for share in RAMPS:
        task = dataclasses.replace(default.task, action_ramp=share)
        scene = load_scene(dataclasses.replace(default, task=task))
        shipped = " (as shipped)" if task == default.task else ""
        row: Row = {"legs move for": f"{share:.0%}{shipped}"}
        for name in RAMPED:
            for suite in HEADLINE:
                controller = make_controller(name, scene)
                result = common.evaluated(scene, controller, suite, args.scenarios)
                row[f"{name}, {suite}"] = common.pooled([result])
        rows.append(row)
    note = f"{args.scenarios} held-out scenarios of {DURATION:g} s; {common.TILTS}."
    common.report(args, "limits ramp", rows, note)


def settling(task: TaskConfig, pushed: np.ndarray, calm: np.ndarray, at: np.ndarray) -> np.ndarray:
    """Time from every push to the last difference above `SETTLED` before the next.

    Args:
      task: length of a decision.
      pushed: (scenarios, steps) tilt with pushes, deg.
      calm: (scenarios, steps) without, deg.
      at: (n,) numbers of the decisions that begin with a push.

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


def push_row(name: str, scene: Scene, controller: Controller, scenarios: int) -> Row:
    """One controller, with pushes and without."""
    drawn = draw_suite(scene.task, scene.robot, "push", scenarios, DURATION, SEEDS.held_out)
    assert drawn.pushes is not None
    calm, pushed = (
        roll_out(scene, controller, episodes, DURATION)
        for episodes in (drawn._replace(pushes=None), drawn)
    )
    times = settling(scene.task, pushed.tilt, calm.tilt, drawn.pushes.due[0])
    half, most = np.percentile(times, (50, 95)).tolist()
    return {
        "controller": name,
        "push": common.pooled([summarize(pushed, "push", DURATION, SEEDS.held_out)]),
        "p95 without pushes": float(np.percentile(calm.tilt, 95)),
        "half overcome in": half,
        "95% in": most,
    }


def push(args: argparse.Namespace) -> None:
    """Table `push`."""
    policy, scene = load_policy(args.policy), load_scene(preset("default"))
    rows = [push_row(args.policy.name, policy_scene(policy), observing(policy), args.scenarios)]
    rows += [push_row(x, scene, make_controller(x, scene), args.scenarios) for x in PUSHED]
    note = (
        f"{args.scenarios} held-out scenarios of {DURATION:g} s; {common.TILTS}; a push is "
        f"overcome when the tilt stays within {SETTLED:g} deg of what it is without."
    )
    forms = {"p95 without pushes": "{:.3f}", "half overcome in": "{:.2f} s", "95% in": "{:.2f} s"}
    common.report(args, "limits push", rows, note, forms)


def decks(args: argparse.Namespace) -> None:
    """Table `decks`."""
    policy, default = load_policy(args.policy), load_scene(preset("default"))
    acting = {
        args.policy.name: (policy_scene(policy), observing(policy)),
        "pd-imu": (default, make_controller("pd-imu", default)),
    }
    rows = []
    for angle, period, height in SEAS:
        row: Row = {"significant angle": angle, "peak period": period, "heave": height}
        for name, (scene, controller) in acting.items():
            task = dataclasses.replace(
                scene.task,
                max_incline=max(angle, scene.task.max_incline),
                board_rate=max(bounds()[0] * angle / period, scene.task.board_rate) + 1e-6,
                sea_angle=angle,
                sea_period=period,
                sea_height=height,
            )
            at_sea = dataclasses.replace(scene, task=task)
            suite = "platform" if height else "sea"
            row[name] = common.pooled([common.evaluated(at_sea, controller, suite, args.scenarios)])
        rows.append(row)
    note = f"{args.scenarios} held-out scenarios of {DURATION:g} s; {common.TILTS}."
    forms = {"significant angle": "{:g} deg", "peak period": "{:g} s", "heave": "{:g} m"}
    common.report(args, "limits decks", rows, note, forms)


def gains_row(kind: type, suite: str, scenarios: int) -> Row:
    """The search for one baseline's gains."""
    scene = load_scene(preset("default"))

    def mean(gains: dict[str, float], seed: int) -> float:
        controller = kind(scene, **gains)
        return float(run_suite(scene, controller, suite, scenarios, 40.0, seed).tilt.mean())

    scores: dict[tuple[float, ...], float] = {}

    def score(gains: dict[str, float]) -> float:
        key = tuple(gains.values())
        if key not in scores:
            scores[key] = mean(gains, SEEDS.tuning)
        return scores[key]

    # From today's gains, so that a search that betters nothing confirms them.
    best, before = {name: getattr(kind(scene), name) for name in GRIDS[kind]}, None
    while best != before:
        before = best
        for name, values in GRIDS[kind].items():
            best = min(({**best, name: value} for value in values), key=score)
        common.log(f"{kind.__name__}: {best} {score(best):.4f} deg")
    return {
        "baseline": kind.__name__,
        "best gains": ", ".join(f"{name} {value:g}" for name, value in best.items()),
        "mean deg": score(best),
        "held out": mean(best, SEEDS.held_out),
    }


def gains(args: argparse.Namespace) -> None:
    """Table `gains`."""
    rows = [gains_row(kind, args.suite, args.scenarios) for kind in GRIDS]
    note = f"{args.scenarios} scenarios of 40 s of suite `{args.suite}`, training seeds and others."
    forms = {"mean deg": "{:.4f}", "held out": "{:.4f}"}
    common.report(args, "limits gains", rows, note, forms)


TABLES = {x.__name__: x for x in (ramp, push, decks, gains)}


def main() -> None:
    """Measures one table."""
    parser = common.arguments(__doc__, TABLES)
    parser.add_argument("--policy", type=Path, default=POLICY, help="of tables push and decks")
    parser.add_argument("--suite", choices=SUITES, default="paper", help="of table gains")
    parser.add_argument("--scenarios", type=int, default=16)
    args = parser.parse_args()
    TABLES[args.table](args)


if __name__ == "__main__":
    main()
