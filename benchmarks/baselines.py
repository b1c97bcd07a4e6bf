"""Tunes the PD baselines on training seeds, and measures what leg timing allows.

Coordinate search: each parameter in turn is set to the best of a few values, until a
round changes nothing. The score is the mean tilt over a suite, falls counting as 6 deg.
The winners for suite `paper` are the defaults in `mjx_balance/evaluation/controllers.py`; `--suite
latency` shows what the same controllers reach if they are tuned for late actions instead.

    python benchmarks/baselines.py [--scenarios 16] [--duration 40] [--suite paper]

With `--write`, instead: a table of what controllers reach when the legs take other shares
of a decision to move, on held-out seeds, between the markers of a Markdown file.

    python benchmarks/baselines.py --scenarios 16 --duration 60 --write benchmarks/README.md
"""

import argparse
import dataclasses
from collections.abc import Mapping, Sequence
from pathlib import Path

from markers import publish, table

from mjx_balance.config import preset
from mjx_balance.evaluation.controllers import AttitudePD, ImuPD, make_controller
from mjx_balance.evaluation.rollout import run_suite, summarize
from mjx_balance.evaluation.suites import HEADLINE, SEEDS
from mjx_balance.sim.scene import load_scene

GRIDS: Mapping[type, Mapping[str, Sequence[float]]] = {
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
RAMPS = (0.02, 0.1, 0.2, 0.4, 0.6)
TIMED = ("rate-oracle", "pd-attitude")


def tune(scenarios: int, duration: float, suite: str) -> None:
    """Searches, prints every improvement, and what the winner does on held-out seeds."""
    config = preset("default")
    scene = load_scene(config)
    for kind, grid in GRIDS.items():
        # From today's gains, so that a search that finds nothing better confirms them.
        controller = kind(scene)
        chosen = {name: getattr(controller, name) for name in grid}
        scores: dict[tuple[float, ...], float] = {}

        def mean(trial: Mapping[str, float], seed: int, kind=kind) -> float:
            controller = kind(scene, **trial)
            rollout = run_suite(scene, controller, suite, scenarios, duration, seed)
            return float(rollout.tilt.mean())

        def score(trial: Mapping[str, float], mean=mean, scores=scores) -> float:
            key = tuple(trial.values())
            if key not in scores:
                scores[key] = mean(trial, SEEDS.tuning)
            return scores[key]

        while True:
            before = dict(chosen)
            for name, values in grid.items():
                best = min(values, key=lambda value, name=name: score(chosen | {name: value}))
                chosen[name] = best
            print(f"{kind.__name__}: {chosen} -> {score(chosen):.4f} deg", flush=True)
            if chosen == before:
                break
        held_out = mean(chosen, SEEDS.held_out)
        print(f"{kind.__name__}: best of {len(scores)}; held out {held_out:.4f} deg", flush=True)


def leg_timing(scenarios: int, duration: float, page: Path) -> None:
    """Measures and writes the table of leg timings."""
    default = preset("default")
    rows = []
    for ramp in RAMPS:
        task = dataclasses.replace(default.task, action_ramp=ramp)
        config = dataclasses.replace(default, task=task)
        scene = load_scene(config)
        cells = [f"{ramp:.0%}" + (" (as shipped)" if task == default.task else "")]
        for name in TIMED:
            for suite in HEADLINE:
                controller = make_controller(name, scene)
                rollout = run_suite(scene, controller, suite, scenarios, duration, SEEDS.held_out)
                tilt = summarize(rollout, suite, duration, SEEDS.held_out)["tilt_deg"]
                cells.append(" / ".join(f"{tilt[x]:.3f}" for x in ("mean", "p95", "max")))
        rows.append(cells)
    columns = [f"`{name}`, `{suite}`" for name in TIMED for suite in HEADLINE]
    note = f"{scenarios} held-out scenarios of {duration:g} s; mean / p95 / max tilt in deg."
    publish("baselines", [*table(["legs move for", *columns], rows), "", note], page)


def main() -> None:
    """Tunes, or measures leg timings."""
    parser = argparse.ArgumentParser()
    parser.add_argument("--scenarios", type=int, default=16)
    parser.add_argument("--duration", type=float, default=40.0)
    parser.add_argument("--suite", default="paper", help="to tune on")
    parser.add_argument("--write", type=Path, help="Markdown file with markers")
    args = parser.parse_args()
    if args.write:
        leg_timing(args.scenarios, args.duration, args.write)
    else:
        tune(args.scenarios, args.duration, args.suite)


if __name__ == "__main__":
    main()
