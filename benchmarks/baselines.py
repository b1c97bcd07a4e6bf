"""Tunes the PD baselines on training seeds and measures all baselines on held-out ones.

Coordinate search: each parameter in turn is set to the best of a few values, until a
round changes nothing. The score is the mean tilt over suite `paper`, falls counting as
6 deg. The winners are the defaults in `mjx_balance/baselines.py`.

    python benchmarks/baselines.py [--scenarios 16] [--duration 40]
"""

import argparse
from collections.abc import Mapping, Sequence

from mjx_balance.baselines import AttitudePD, ImuPD
from mjx_balance.config import preset
from mjx_balance.evaluation import run_suite
from mjx_balance.scene import load_scene

TRAINING_SEED = 5_000_000
GRIDS: Mapping[type, Mapping[str, Sequence[float]]] = {
    AttitudePD: {
        "proportional": (0.6, 0.7, 0.8, 0.9, 1.0, 1.1, 1.2, 1.3),
        "rate": (0.08, 0.1, 0.12, 0.14, 0.16, 0.18, 0.2),
    },
    ImuPD: {
        "tau": (0.1, 0.2, 0.5, 1.0, 2.0, 4.0, 8.0, 16.0),
        "proportional": (0.4, 0.6, 0.7, 0.8, 0.9, 1.0, 1.1, 1.2),
        "rate": (0.0, 0.04, 0.08, 0.12, 0.14, 0.16, 0.18, 0.2, 0.22),
        "samples": (1, 3, 6, 12, 20),
    },
}


def main() -> None:
    """Searches and prints every improvement."""
    parser = argparse.ArgumentParser()
    parser.add_argument("--scenarios", type=int, default=16)
    parser.add_argument("--duration", type=float, default=40.0)
    args = parser.parse_args()
    config = preset("default")
    scene = load_scene(config)
    for kind, grid in GRIDS.items():
        chosen = {name: values[len(values) // 2] for name, values in grid.items()}
        scores: dict[tuple[float, ...], float] = {}

        def score(trial: Mapping[str, float], kind=kind, scores=scores) -> float:
            key = tuple(trial.values())
            if key not in scores:
                controller = kind(scene, config, **trial)
                rollout = run_suite(
                    scene, config, controller, "paper", args.scenarios, args.duration, TRAINING_SEED
                )
                scores[key] = float(rollout.tilt.mean())
            return scores[key]

        while True:
            before = dict(chosen)
            for name, values in grid.items():
                best = min(values, key=lambda value, name=name: score(chosen | {name: value}))
                chosen[name] = best
            if chosen == before:
                break
            print(f"{kind.__name__}: {chosen} -> {score(chosen):.4f} deg", flush=True)
        print(f"{kind.__name__}: best of {len(scores)} trials", flush=True)


if __name__ == "__main__":
    main()
