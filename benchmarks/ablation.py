"""What is each piece of a preset worth? Trains with it taken out or exchanged.

Every variant is a run of `train` with a few flags changed, shorter than a full run, and keeps its
folder, so that an interrupted ablation goes on where it stopped.

    python benchmarks/ablation.py [--preset default] [--write benchmarks/README.md]
"""

import argparse
import hashlib
import json
import subprocess
import sys
from collections.abc import Iterable
from pathlib import Path

import common
from common import DURATION, Row

from mjx_balance.config import preset
from mjx_balance.evaluation.suites import HEADLINE


def lags(samples: Iterable[int], commands: str) -> str:
    """Flags for IMU samples and commands that the network sees."""
    some = " ".join(str(lag) for lag in samples)
    return f"--gyro-lags {some} --accel-lags {some} --command-lags {commands}"


VARIANTS = {
    "default": {
        "as it is": "",
        "no whitening": "--whiten-steps 0",
        "no exploration noise": "--exploration-noise 0",
        "no mirror": "--no-mirror",
        "action: on the grid (paper)": "--action grid",
        "the same, head: factored, 21 + 21 outputs": "--action grid --head factored",
        "the same, head: joint, 441 outputs (paper)": "--action grid --head joint",
        "reward for the tilt at the end": "--reward-tilt end",
        "a quarter of the updates": "--replay-ratio 8",
        "learning rate 1e-3": "--learning-rate 1e-3",
        "errors beyond 0.03 count linearly": "--huber-delta 0.03",
        "Double DQN": "--double",
        "gamma 0.4": "--gamma 0.4",
        "legs move for 40% of the decision": "--action-ramp 0.4",
        "targets from the paper's disc alone": "--square-share 0",
    },
    "best": {
        "as it is": "",
        "all errors squared": "--huber-delta None",
        "no pushes": "--push-max 0",
        "no pushes, all errors squared": "--push-max 0 --huber-delta None",
        "reward for the tilt at the end": "--reward-tilt end",
        "Double DQN": "--double",
        "two decisions of samples and commands": lags(range(0, 100, 5), "0 1"),
        "one decision": lags(range(0, 50, 5), "0"),
    },
}
"""Preset -> title -> flags."""
DECISIONS = {"default": 40_000, "best": 100_000}
SCENARIOS = {"default": 24, "best": 128}


def run_result(flags: str, seed: int, args: argparse.Namespace, train: bool) -> Row | None:
    """The evaluation of one run, trained if it is missing; none if it is missing and not asked."""
    name = args.preset
    flags += f" --preset {name} --engine mujoco --eval-every 0 --seed {seed}"
    flags += f" --num-env-steps {args.decisions or DECISIONS[name]}"
    flags += f" --eval-scenarios {args.scenarios or SCENARIOS[name]}"
    folder = args.runs / f"{name}-{seed}-{hashlib.sha256(flags.encode()).hexdigest()[:8]}"
    result = folder / "evaluation.json"
    if train and not result.is_file():
        # The folder of an interrupted run has its flags.
        how = ["--resume", str(folder)] if folder.is_dir() else ["--run-dir", str(folder)]
        how += [] if folder.is_dir() else flags.split()
        subprocess.run([sys.executable, "-m", "mjx_balance", "train", *how], check=True)
    return json.loads(result.read_text()) if result.is_file() else None


def variant_rows(args: argparse.Namespace) -> list[Row]:
    """Trains what is missing; returns the variants that have a run."""
    rows = []
    for number, (title, flags) in enumerate(VARIANTS[args.preset].items()):
        train = args.only is None or number in args.only
        runs = [run_result(flags, seed, args, train) for seed in args.seeds]
        results = [result for result in runs if result is not None]
        if results:
            suites = {
                suite: common.pooled([result[suite] for result in results]) for suite in HEADLINE
            }
            rows.append({f"preset {args.preset}": title, "seeds": len(results), **suites})
    return rows


def main() -> None:
    """Trains what is missing and prints the table."""
    parser = common.arguments(__doc__)
    parser.add_argument("--preset", default="default", choices=VARIANTS)
    parser.add_argument("--seeds", type=int, nargs="+", default=[0])
    parser.add_argument("--runs", type=Path, default=Path("runs/ablation"))
    parser.add_argument("--only", type=int, nargs="*", help="rows to train, from 0; none: all")
    parser.add_argument("--decisions", type=int, help="of each run")
    parser.add_argument("--scenarios", type=int, help="of each evaluation and suite")
    args = parser.parse_args()
    name = args.preset
    note = (
        f"{args.decisions or DECISIONS[name]:,} of {preset(name).num_env_steps:,} decisions, "
        f"engine mujoco, {args.scenarios or SCENARIOS[name]} held-out scenarios of {DURATION:g} s "
        f"per suite and seed; {common.TILTS}: means over the seeds, greatest max."
    )
    common.report(args, f"ablation {name}", variant_rows(args), note)


if __name__ == "__main__":
    main()
