r"""Does the paper's DQN do what the paper says? The learning curve of preset `paper`.

Judges every policy that runs of the preset kept on their way (`validated/`) on held-out
scenarios, beside the evaluation after training, and draws 100 s of the first run's last policy
as in the paper's Fig. 7.

    for seed in 0 1 2; do python train.py --preset paper --engine mujoco --num-devices 1 \
        --log-every 1600 --eval-every 40000 --eval-scenarios 256 --seed $seed \
        --run-dir runs/paper-$seed; done
    python benchmarks/paper.py runs/paper-? [--write README.md] [--figure docs/paper.png]
"""

import argparse
import json
import shutil
from pathlib import Path
from typing import Any

from markers import publish, table
from rich.console import Console

from mjx_balance.evaluation.rollout import evaluate
from mjx_balance.evaluation.suites import HEADLINE, SEEDS
from mjx_balance.files.run_folder import RunFolder
from mjx_balance.policy.file import load_policy
from mjx_balance.report.progress import Display

DURATION = 60.0


def cell(results: list[dict[str, Any]]) -> str:
    """Falls of all seeds; mean, p95 and max tilt in deg, the first two as means over the seeds."""
    falls, of = (sum(r[name] for r in results) for name in ("falls", "scenarios"))
    mean, p95 = (sum(r["tilt_deg"][x] for r in results) / len(results) for x in ("mean", "p95"))
    worst = max(r["tilt_deg"]["max"] for r in results)
    return f"{falls} of {of}; {mean:.3f} / {p95:.2f} / {worst:.1f}"


def main() -> None:
    """Judges, prints, writes."""
    parser = argparse.ArgumentParser()
    parser.add_argument("runs", nargs="+", type=Path)
    parser.add_argument("--scenarios", type=int, default=64)
    parser.add_argument("--write", type=Path, help="Markdown file with markers")
    parser.add_argument("--figure", type=Path, help="where to copy the rollout's picture to")
    args = parser.parse_args()
    folders, display = [RunFolder(path) for path in args.runs], Display(Console(stderr=True))
    steps = sorted({int(p.name) for folder in folders for p in folder.validated.iterdir()})
    rows = []
    for step in steps:
        files = [f for folder in folders for f in (folder.validated / str(step)).iterdir()]
        cells = [f"{step:,}"]
        for suite in HEADLINE:
            with display.phase(f"{step:,} decisions, suite {suite}"):
                cells.append(
                    cell(
                        [
                            evaluate(
                                load_policy(file), suite, args.scenarios, DURATION, SEEDS.held_out
                            )
                            for file in files
                        ]
                    )
                )
        rows.append(cells)
    final = [json.loads(folder.evaluation.read_text()) for folder in folders]
    rows.append(
        ["after training", *(cell([results[suite] for results in final]) for suite in HEADLINE)]
    )
    columns = ["decisions", *(f"`{suite}`: falls; mean / p95 / max deg" for suite in HEADLINE)]
    note = (
        f"{len(folders)} seeds, {args.scenarios} held-out scenarios of {DURATION:g} s each; after "
        f"training {final[0]['paper']['scenarios']}."
    )
    publish("paper", [*table(columns, rows), "", note], args.write)
    if args.figure:
        shutil.copyfile(folders[0].figures / "rollout.png", args.figure)


if __name__ == "__main__":
    main()
