"""What each piece of a preset is worth: trains with it taken out or exchanged.

Every variant is a run of `train` with a few flags changed, shorter than a full run, and
keeps its folder, so that an interrupted ablation goes on where it stopped. `--write`
puts the tables between the markers of a Markdown file.

    python benchmarks/ablation.py --write benchmarks/README.md
"""

import argparse
import hashlib
import json
import re
import subprocess
import sys
from collections.abc import Iterable
from pathlib import Path
from typing import Any

import numpy as np
from markers import publish, table

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
        "head: factored, 21 + 21 outputs": "--head factored",
        "head: joint, 441 outputs (paper)": "--head joint",
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
        "no kicks": "--push-max 0",
        "no kicks, all errors squared": "--push-max 0 --huber-delta None",
        "reward for the tilt at the end": "--reward-tilt end",
        "Double DQN": "--double",
        "two decisions of samples and commands": lags(range(0, 100, 5), "0 1"),
        "one decision": lags(range(0, 50, 5), "0"),
    },
}
"""Preset -> title -> flags."""
DECISIONS = {"default": 40_000, "best": 100_000}
SCENARIOS = {"default": 24, "best": 128}


def result_of(
    name: str, title: str, flags: str, seed: int, runs: Path, wanted: bool
) -> dict[str, Any] | None:
    """The evaluation of one run, trained if it is wanted and missing."""
    common = (
        f"--preset {name} --engine mujoco --num-env-steps {DECISIONS[name]} --seed {seed} "
        f"--eval-every 0 --eval-scenarios {SCENARIOS[name]}"
    )
    digest = hashlib.sha256(f"{common} {flags}".encode()).hexdigest()[:8]
    slug = "-".join(re.findall("[a-z0-9.]+", title.lower()))
    folder = runs / f"{name}-{slug}-seed{seed}-{digest}"
    result = folder / "evaluation.json"
    if wanted and not result.is_file():
        if folder.is_dir():  # it has the flags in its folder
            more = ["--resume", str(folder)]
        else:
            more = ["--run-dir", str(folder), *common.split(), *flags.split()]
        subprocess.run([sys.executable, "-m", "mjx_balance", "train", *more], check=True)
    return json.loads(result.read_text()) if result.is_file() else None


def rows_of(name: str, args: argparse.Namespace) -> list[list[str]]:
    """Trains what is missing of a preset's variants; returns the rows that there are."""
    rows = []
    for number, (title, flags) in enumerate(VARIANTS[name].items()):
        wanted = args.only is None or f"{name}-{number}" in args.only
        each = [result_of(name, title, flags, seed, args.runs, wanted) for seed in args.seeds]
        found = [result for result in each if result is not None]
        if not found:
            continue
        cells = [title, str(len(found))]
        for suite in HEADLINE:
            tilts = [result[suite]["tilt_deg"] for result in found]
            cells.append(str(sum(result[suite]["falls"] for result in found)))
            cells += [f"{np.mean([tilt[key] for tilt in tilts]):.3f}" for key in ("mean", "p95")]
            cells.append(f"{max(tilt['max'] for tilt in tilts):.3f}")
        rows.append(cells)
    return rows


def main() -> None:
    """Trains what is missing and prints the tables."""
    parser = argparse.ArgumentParser()
    parser.add_argument("--presets", nargs="+", default=list(VARIANTS), choices=VARIANTS)
    parser.add_argument("--seeds", type=int, nargs="+", default=[0])
    parser.add_argument("--runs", type=Path, default=Path("runs/ablation"))
    parser.add_argument("--only", nargs="*", help="variants to train, as default-3; none: all")
    parser.add_argument("--write", type=Path, help="Markdown file with markers")
    args = parser.parse_args()
    lines = []
    for name in args.presets:
        columns = [f"preset `{name}`", "seeds"]
        for suite in HEADLINE:
            columns += [f"`{suite}`: falls", "mean", "p95", "max"]
        lines += [*table(columns, rows_of(name, args)), ""]
        lines += [
            f"{DECISIONS[name]:,} of {preset(name).num_env_steps:,} decisions, engine mujoco, "
            f"{SCENARIOS[name]} held-out scenarios of 60 s per suite and seed, tilt in deg: means "
            "over the seeds, their sum of falls and greatest max.",
            "",
        ]
    publish("ablation", lines[:-1], args.write)


if __name__ == "__main__":
    main()
