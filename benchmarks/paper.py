r"""Does the paper's DQN do what the paper says? The learning curve of preset `paper`.

Evaluates every policy that runs of the preset validated on their way, on held-out scenarios, beside
the evaluation after training. `docs/paper.png` is `figures/rollout.png` of the first run.

    for seed in 0 1 2; do python train.py --preset paper --engine mujoco --num-devices 1 \
        --log-every 1600 --eval-every 40000 --eval-scenarios 256 --seed $seed \
        --run-dir runs/paper-$seed; done
    python benchmarks/paper.py runs/paper-? [--write docs/results.md]
"""

import json
import sys
from pathlib import Path

import common
from common import DURATION, Row

from mjx_balance.evaluation.suites import HEADLINE
from mjx_balance.files.run_folder import RunFolder
from mjx_balance.policy.file import load_policy


def checkpoint_row(step: int, folders: list[RunFolder], scenarios: int) -> Row:
    """All runs' policies after so many decisions."""
    print(f"{step:,} decisions ...", file=sys.stderr, flush=True)
    files = [file for folder in folders for file in (folder.validated / str(step)).iterdir()]
    policies = [load_policy(file) for file in files]
    return {"decisions": f"{step:,}", **common.evaluated_policies(policies, scenarios)}


def main() -> None:
    """Evaluates, prints, writes."""
    parser = common.arguments(__doc__)
    parser.add_argument("runs", nargs="+", type=Path)
    parser.add_argument("--scenarios", type=int, default=64)
    args = parser.parse_args()
    folders = [RunFolder(path) for path in args.runs]
    steps = sorted({int(path.name) for folder in folders for path in folder.validated.iterdir()})
    rows = [checkpoint_row(step, folders, args.scenarios) for step in steps]
    final = [json.loads(folder.evaluation.read_text()) for folder in folders]
    last = {suite: common.pooled([results[suite] for results in final]) for suite in HEADLINE}
    rows.append({"decisions": "after training", **last})
    note = (
        f"{len(folders)} seeds, {args.scenarios} held-out scenarios of {DURATION:g} s each, "
        f"{final[0]['paper']['scenarios']} after training; {common.TILTS}: means over the seeds, "
        "greatest max."
    )
    common.report(args, "paper", rows, note)


if __name__ == "__main__":
    main()
