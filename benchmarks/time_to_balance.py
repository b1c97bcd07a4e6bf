"""How soon does a robot balance?

Every contender is a fresh process. Its clock runs from its start, imports and compiling
included, to its exported policy, which then has to show what it can do, off the clock: mean tilt
and falls in the headline suites, held-out scenarios of 60 s, plain MuJoCo. Ours are
`train.py --preset quick --engine ENGINE`, cold (no program in the cache) and warm (the same again).
The peer is stable-baselines3's DQN on one env of the same task (`sb3_dqn.py`): it stands still
while its checkpoints are judged, and its time is that of the first with a mean of at most
`--threshold` deg in suite `paper` and no fall.

    python benchmarks/time_to_balance.py [--contenders mujoco mjx sb3] [--json FILE]
"""

import argparse
import importlib.util
import os
import subprocess
import sys
import tempfile
import time
from collections.abc import Iterator
from pathlib import Path
from typing import Any

from markers import publish, table
from rich.console import Console
from throughput import hardware

from mjx_balance.config import preset
from mjx_balance.evaluation import rollout as evaluation
from mjx_balance.evaluation.suites import HEADLINE, SEEDS
from mjx_balance.files.run_folder import RunFolder, write_json
from mjx_balance.policy.file import load_policy
from mjx_balance.report.progress import Display

HERE = Path(__file__).resolve().parent
ENGINES = ("mujoco", "mjx")
PRESET = preset("quick")
PEER = "sb3"
SCENARIOS, DURATION = 64, 60.0
POLL = 0.02
"""Seconds between two looks for a policy."""
INTERRUPTED = 130


class Failed(Exception):
    """A contender that ended without a policy; the message says which and how."""


def judged(policy: Path, suite: str, display: Display) -> dict[str, Any]:
    """`mean` tilt in deg and `falls` of a policy file in a suite."""
    with display.bar(f"judging, suite {suite}") as bar:
        result = evaluation.evaluate(
            load_policy(policy), suite, SCENARIOS, DURATION, SEEDS.held_out, bar
        )
    return {"mean": result["tilt_deg"]["mean"], "falls": result["falls"]}


def ours(engine: str, decisions: int, work: Path, display: Display) -> Iterator[dict[str, Any]]:
    """Two rows, cold and warm, of `train.py` with one engine."""
    for start in ("cold", "warm"):
        display.say(f"{engine}, {start}:")
        folder = RunFolder(work / f"{engine}-{start}")
        flags = f"--preset {PRESET.preset} --engine {engine} --num-env-steps {decisions}".split()
        flags += ["--run-dir", str(folder.path)]
        command = [sys.executable, str(HERE.parent / "train.py"), *flags]
        seconds = time_to_file(command, folder.policy, work / f"cache-{engine}")
        training = load_policy(folder.policy).manifest["training"]
        yield {
            "contender": engine,
            "engine": engine,
            "start": start,
            "seconds": seconds,
            "decisions": training["env_steps"],
            **{suite: judged(folder.policy, suite, display) for suite in HEADLINE},
        }


def time_to_file(command: list[str], file: Path, cache: Path) -> float:
    """Seconds from the start of a process until it has written a file; then it is stopped.

    Args:
      command: of the process; what it prints goes to our standard error.
      file: that it moves into place whole.
      cache: folder for its compiled programs.

    Raises:
      Failed: if it ends without the file.
    """
    began = time.perf_counter()
    process = subprocess.Popen(
        command, env=os.environ | {"MJX_BALANCE_CACHE": str(cache)}, stdout=sys.stderr
    )
    try:
        while not file.is_file():
            if process.poll() is not None:
                raise Failed(f"{' '.join(command)} gave no policy, exit code {process.returncode}")
            time.sleep(POLL)
        return time.perf_counter() - began
    finally:
        process.kill()
        process.wait()


def peer(
    decisions: int, every: int, threshold: float, work: Path, display: Display
) -> dict[str, Any]:
    """The row of stable-baselines3; `seconds` is none if no checkpoint passed.

    Args:
      decisions: to give up after.
      every: decisions between two checkpoints.
      threshold: greatest mean tilt in suite `paper` that passes, deg.
      work: folder for the checkpoints.
      display: shows progress.

    Raises:
      Failed: if the process ends before it has made its decisions.
    """
    flags = ["--decisions", str(decisions), "--every", str(every)]
    command = [sys.executable, str(HERE / "sb3_dqn.py"), str(work), *flags]
    display.say(f"{PEER}:")
    made, seconds, passed = 0, 0.0, False
    paper: dict[str, Any] = {}
    began = time.perf_counter()
    process = subprocess.Popen(
        command, stdin=subprocess.PIPE, stdout=subprocess.PIPE, text=True, bufsize=1
    )
    assert process.stdin is not None
    assert process.stdout is not None
    try:
        for line in process.stdout:
            seconds += time.perf_counter() - began
            made = int(line)
            paper = judged(work / f"{made}.safetensors", "paper", display)
            display.say(
                f"{made:>9,}/{decisions:,} decisions  {seconds:.0f} s  "
                f"mean tilt {paper['mean']:.3f} deg  falls {paper['falls']}"
            )
            passed = paper["mean"] <= threshold and not paper["falls"]
            if passed or made + every > decisions:
                break
            began = time.perf_counter()
            process.stdin.write("\n")
        else:
            raise Failed(f"{' '.join(command)} ended after {made} decisions")
    finally:
        process.kill()
        process.communicate()
    return {
        "contender": PEER,
        "engine": "mujoco",
        "start": "cold",
        "seconds": seconds if passed else None,
        "decisions": made,
        "paper": paper,
        "corner": judged(work / f"{made}.safetensors", "corner", display),
    }


def lines_of(rows: list[dict[str, Any]], threshold: float, machine: dict[str, Any]) -> list[str]:
    """The table, and what it needs to be read."""
    peers = [row["seconds"] for row in rows if row["contender"] == PEER]
    reference = peers[0] if peers else None
    cells = []
    for row in rows:
        seconds = row["seconds"]
        ratio = f"{reference / seconds:.1f}" if reference and seconds else "-"
        cells.append(
            [
                f"`{row['contender']}`",
                row["start"],
                "not reached" if seconds is None else f"{seconds:.1f}",
                f"{row['decisions']:,}",
                *(f"{row[suite]['mean']:.3f} ({row[suite]['falls']})" for suite in HEADLINE),
                ratio,
            ]
        )
    suites = [f"`{suite}`, deg (falls)" for suite in HEADLINE]
    columns = ["contender", "start", "seconds", "decisions", *suites, f"`{PEER}` / this"]
    note = (
        f"{SCENARIOS} held-out scenarios of {DURATION:g} s per suite; `{PEER}`: first checkpoint "
        f"with a mean of at most {threshold:g} deg in `paper` and no fall; {machine['cpu']}, "
        f"{machine['cores']} cores."
    )
    return [*table(columns, cells), "", note]


def main() -> int:
    """Runs the contenders and prints the table; returns the exit code."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])  # pyright: ignore
    names = (*ENGINES, PEER)
    parser.add_argument("--contenders", nargs="+", default=names, choices=names)
    wanted = PRESET.num_env_steps
    parser.add_argument("--decisions", type=int, default=wanted, help="of our trainings")
    parser.add_argument("--threshold", type=float, default=0.20, help=f"that {PEER} reaches, deg")
    parser.add_argument("--most", type=int, default=200_000, help=f"decisions of {PEER} at most")
    parser.add_argument("--every", type=int, default=5_000, help="decisions between checkpoints")
    parser.add_argument("--json", type=Path, help="file to write the figures to, row by row")
    parser.add_argument("--write", type=Path, help="Markdown file with markers")
    args = parser.parse_args()
    if PEER in args.contenders and importlib.util.find_spec("stable_baselines3") is None:
        return complain(
            f"contender {PEER} needs stable-baselines3, which is not installed; "
            "pip install -e '.[benchmarks]', or choose others with --contenders mujoco mjx"
        )
    if not 1 <= args.every <= args.most:
        return complain(f"--every is {args.every}; it must be 1 to --most, {args.most}")
    if args.json and not args.json.absolute().parent.is_dir():
        return complain(f"cannot write {args.json}: its folder does not exist")
    display, machine, code = Display(Console(stderr=True)), hardware(), 0
    rows: list[dict[str, Any]] = []

    def keep(row: dict[str, Any]) -> None:
        rows.append(row)
        if args.json:
            write_json(args.json, {"hardware": machine, "threshold": args.threshold, "rows": rows})

    with tempfile.TemporaryDirectory() as folder:
        work = Path(folder)
        try:
            for name in dict.fromkeys(args.contenders):
                if name == PEER:
                    keep(peer(args.most, args.every, args.threshold, work, display))
                    continue
                for row in ours(name, args.decisions, work, display):
                    keep(row)
        except (Failed, OSError) as failure:
            code = complain(str(failure))
        except KeyboardInterrupt:
            code = INTERRUPTED
    if rows:  # an unfinished table is shown, and kept out of the page
        lines = lines_of(rows, args.threshold, machine)
        publish("time_to_balance", lines, None if code else args.write)
    return code


def complain(message: str) -> int:
    """Says what is wrong in a sentence; returns the exit code."""
    print(f"time_to_balance: {message}", file=sys.stderr)
    return 2


if __name__ == "__main__":
    sys.exit(main())
