"""What each piece of preset `default` is worth: trains with it taken out or exchanged.

Every variant is a run of `train` with one flag changed, shorter than a full run, and
keeps its folder, so that an interrupted ablation goes on where it stopped. `--write`
puts the table between the markers of a Markdown file.

    python benchmarks/ablation.py --write benchmarks/README.md
"""

import argparse
import json
import subprocess
import sys
from pathlib import Path

from markers import publish, table

from mjx_balance.config import preset

LAGS = " ".join(str(lag) for lag in range(0, 50, 5))
VARIANTS = {
    "preset `default`": "",
    "no whitening": "--whiten-steps 0",
    "no dither": "--dither 0",
    "no mirror": "--no-mirror",
    "head: factored, 21 + 21 outputs": "--head factored",
    "head: joint, 441 outputs (paper)": "--head joint",
    "reward for the tilt at the end": "--reward-tilt end",
    "8 updates per decision of all boards": "--updates-per-step 8",
    "learning rate 1e-3": "--learning-rate 1e-3",
    "Double DQN": "--double",
    "gamma 0.4": "--gamma 0.4",
    "means over 20 ms of all IMU samples": f"--imu-mean 5 --gyro-lags {LAGS} --accel-lags {LAGS}",
    "commanded foot heights as inputs": "--command-lags 0",
    "legs move for 40% of the decision": "--action-ramp 0.4",
    "targets from the paper's disc alone": "--square-share 0",
}


def main() -> None:
    """Trains what is missing and prints the table."""
    parser = argparse.ArgumentParser()
    parser.add_argument("--decisions", type=int, default=40_000)
    parser.add_argument("--scenarios", type=int, default=64)
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--runs", type=Path, default=Path("runs/ablation"))
    parser.add_argument("--only", nargs="*", help="numbers of the variants to train; none: all")
    parser.add_argument("--write", type=Path, help="Markdown file with markers")
    args = parser.parse_args()
    rows = []
    for number, (title, flags) in enumerate(VARIANTS.items()):
        folder = args.runs / f"{number:02}-{args.decisions}-seed{args.seed}"
        result = folder / "evaluation.json"
        wanted = args.only is None or str(number) in args.only
        if wanted and not result.is_file():
            start = ["--resume", str(folder)] if folder.exists() else ["--run-dir", str(folder)]
            common = (
                f"--num-env-steps {args.decisions} --eval-scenarios {args.scenarios} "
                f"--seed {args.seed} --checkpoint-every {args.decisions}"
            )
            train = [sys.executable, "-m", "mjx_balance", "train", *start]
            # A resumed run takes its flags from its folder.
            more = [] if folder.exists() else [*common.split(), *flags.split()]
            subprocess.run(train + more, check=True)
        if not result.is_file():
            continue
        suites = json.loads(result.read_text())
        cells = [title, f"`{flags}`" if flags else ""]
        for suite in ("paper", "corner"):
            tilt, falls = suites[suite]["tilt_deg"], suites[suite]["falls"]
            cells += [str(falls), *(f"{tilt[name]:.3f}" for name in ("mean", "p95", "max"))]
        rows.append(cells)
    columns = "variant|flag|`paper`: falls|mean|p95|max|`corner`: falls|mean|p95|max".split("|")
    note = (
        f"{args.decisions:,} decisions instead of {preset('default').num_env_steps:,}, seed "
        f"{args.seed}, {args.scenarios} held-out scenarios of 60 s per suite, tilt in deg."
    )
    publish("ablation", [*table(columns, rows), "", note], args.write)


if __name__ == "__main__":
    main()
