"""How soon does a robot balance?

Every contender is a fresh process. Its clock runs from its start, imports and compiling included,
to its exported policy, which is then evaluated off the clock: held-out scenarios of 60 s, plain
MuJoCo. Ours are `train.py --preset quick --engine ENGINE`, cold (no program in the cache) and warm
(the same again). The time of a peer, with the settings of `peers.py`, is that of the first policy
with a mean tilt of at most `--threshold` deg in suite `paper` and no fall.

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

import common
import peers
from common import DURATION, REPO, Row
from peers import ContenderError

from mjx_balance.config import preset
from mjx_balance.evaluation.suites import HEADLINE
from mjx_balance.files.run_folder import RunFolder
from mjx_balance.policy.file import load_policy

ENGINES = ("mujoco", "mjx")
PEERS = {"sb3": "sb3-dqn", "ppo": "brax-ppo", "sac": "brax-sac"}
"""Contender -> its name in `peers.py`."""
POLL_S = 0.02
INTERRUPTED = 130


def train_rows(engine: str, args: argparse.Namespace, work: Path) -> Iterator[Row]:
    """Two rows, cold and warm, of `train.py` with one engine."""
    for start in ("cold", "warm"):
        common.log(f"{engine}, {start}:")
        folder = RunFolder(work / f"{engine}-{start}")
        flags = f"--preset quick --engine {engine} --num-env-steps {args.decisions} --run-dir"
        command = [sys.executable, str(REPO / "train.py"), *flags.split(), str(folder.path)]
        seconds = time_to_file(command, folder.policy, work / f"cache-{engine}")
        policy = load_policy(folder.policy)
        results = common.evaluated_policies([policy], args.scenarios)
        decisions = policy.manifest["training"]["env_steps"]
        yield make_row(engine, engine, start, seconds, decisions, results)


def make_row(
    contender: str, engine: str, start: str, seconds: float | None, decisions: int, results: Row
) -> Row:
    """One row; `seconds` is none if no policy was good enough."""
    return {
        "contender": contender,
        "engine": engine,
        "start": start,
        "seconds": seconds,
        "decisions": decisions,
        **{s: {name: results[s][name] for name in ("mean", "falls")} for s in HEADLINE},
    }


def time_to_file(command: list[str], file: Path, cache: Path) -> float:
    """Seconds from the start of a process until it has written a file; then it is stopped.

    It has to move the file into place whole.

    Raises:
      ContenderError: if it ends without the file.
    """
    began = time.perf_counter()
    process = subprocess.Popen(
        command, env=os.environ | {"MJX_BALANCE_CACHE": str(cache)}, stdout=sys.stderr
    )
    try:
        while not file.is_file():
            if process.poll() is not None:
                code = process.returncode
                raise ContenderError(f"{' '.join(command)} gave no policy, exit code {code}")
            time.sleep(POLL_S)
        return time.perf_counter() - began
    finally:
        process.kill()
        process.wait()


def peer_row(name: str, args: argparse.Namespace, work: Path) -> Row:
    """The row of a peer, with the first policy that is good enough, or the last.

    Raises:
      ContenderError: if the process fails.
    """
    common.log(f"{name}:")
    points = peers.run_peer(PEERS[name], 0, args, work, coarse=1)
    passed = [x for x in points if x["paper"]["mean"] <= args.threshold and not x["paper"]["falls"]]
    point = (passed or points[-1:])[0]
    seconds = point["seconds"] if passed else None
    return make_row(name, "mujoco", "cold", seconds, point["decisions"], point)


def table_lines(rows: list[Row], scenarios: int, threshold: float) -> list[str]:
    """The table, and what a reader has to know of it."""
    sb3 = next((row["seconds"] for row in rows if row["contender"] == "sb3"), None)

    cells = [
        {
            "contender": row["contender"],
            "start": row["start"],
            "seconds": f"{row['seconds']:.1f}" if row["seconds"] else "not reached",
            "decisions": f"{row['decisions']:,}",
            **{suite: row[suite] for suite in HEADLINE},
            "sb3 / this": f"{sb3 / row['seconds']:.1f}" if sb3 and row["seconds"] else "-",
        }
        for row in rows
    ]
    note = (
        f"{scenarios} held-out scenarios per suite, of {DURATION:g} s, peers of {peers.DURATION:g} "
        f"s, mean tilt in deg; peers: first policy with at most {threshold:g} in `paper` and no "
        f"fall; {common.machine()}."
    )
    return [*common.table(cells), "", note]


def main() -> int:
    """Runs the contenders and prints the table; returns the exit code."""
    parser = common.arguments(__doc__)
    names, quick = (*ENGINES, *PEERS), preset("quick").num_env_steps
    parser.add_argument("--contenders", nargs="+", default=[*ENGINES, "sb3"], choices=names)
    parser.add_argument("--decisions", type=int, default=quick, help="of our trainings")
    parser.add_argument("--threshold", type=float, default=0.20, help="that peers reach, deg")
    parser.add_argument("--seconds", type=float, default=60.0, help="of a peer's run")
    parser.add_argument("--scenarios", type=int, default=64, help="of each suite")
    args = parser.parse_args()
    for name in args.contenders:
        package = peers.PACKAGES[PEERS[name].split("-")[0]] if name in PEERS else None
        if package and importlib.util.find_spec(package) is None:
            return complain(
                f"contender {name} needs {package}, which is not installed; "
                "pip install -e '.[benchmarks]', or choose others with --contenders mujoco mjx"
            )
    if args.json and not args.json.absolute().parent.is_dir():
        return complain(f"cannot write {args.json}: its folder does not exist")
    rows, code = [], 0
    with tempfile.TemporaryDirectory() as work:
        try:
            for name in dict.fromkeys(args.contenders):
                folder, peer = Path(work), name in PEERS
                for row in (
                    [peer_row(name, args, folder)] if peer else train_rows(name, args, folder)
                ):
                    rows.append(row)
                    common.save(args.json, rows, threshold=args.threshold)
        except (ContenderError, OSError) as error:
            code = complain(str(error))
        except KeyboardInterrupt:
            code = INTERRUPTED
    if rows:  # an unfinished table is shown, and kept out of the page
        lines = table_lines(rows, args.scenarios, args.threshold)
        common.publish("time_to_balance", lines, None if code else args.write)
    return code


def complain(message: str) -> int:
    """Says what is wrong in a sentence; returns the exit code."""
    common.log(f"time_to_balance: {message}")
    return 2


if __name__ == "__main__":
    sys.exit(main())
