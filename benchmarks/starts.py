"""Does training always start, and how soon does it learn?

Starts the same training several times in a row, waits until it has logged its first
gradient steps, then stops it. The first start has an empty cache. A start that takes
longer than the limit counts as hung. Engine `mujoco` is also started on one core, where
two devices share it, and with one device of more threads than it has cores.

    python benchmarks/starts.py [--starts 10] [--num-envs 1024] [--write benchmarks/README.md]
"""

import argparse
import json
import os
import resource
import statistics
import subprocess
import sys
import tempfile
import time
from pathlib import Path
from typing import NamedTuple

from markers import publish, table

LIMIT_S = 300.0
REPO = Path(__file__).resolve().parent.parent


class Case(NamedTuple):
    """What is started, and where."""

    engine: str
    cores: int | None
    """The process is held to so many; all if none."""
    devices: int | None


CASES = (
    Case("mjx", None, None),
    Case("mujoco", None, None),
    Case("mujoco", None, 1),
    Case("mujoco", 1, None),
    Case("mujoco", 1, 1),
)


def start(case: Case, folder: Path, num_envs: int, cache: str) -> float | None:
    """Seconds until a new run has logged its first gradient steps; None if it never does."""
    flags = f"--engine {case.engine} --num-envs {num_envs} --log-every 1024".split()
    flags += ["--num-devices", str(case.devices)] if case.devices else []
    held = ["taskset", "-c", f"0-{case.cores - 1}"] if case.cores else []
    began = time.perf_counter()
    process = subprocess.Popen(
        [*held, sys.executable, str(REPO / "train.py"), *flags, "--run-dir", str(folder)],
        env=os.environ | {"MJX_BALANCE_CACHE": cache},
        stdout=subprocess.DEVNULL,
    )
    metrics = folder / "metrics.jsonl"
    try:
        while time.perf_counter() - began < LIMIT_S and process.poll() is None:
            lines = metrics.read_text().splitlines(keepends=True) if metrics.is_file() else []
            if any(json.loads(x)["gradient_steps"] for x in lines if x.endswith("\n")):
                return time.perf_counter() - began
            time.sleep(0.05)
        return None
    finally:
        process.kill()
        process.wait()


def main() -> None:
    """Starts and prints."""
    parser = argparse.ArgumentParser()
    parser.add_argument("--starts", type=int, default=10)
    parser.add_argument("--num-envs", type=int, default=1024)
    parser.add_argument("--write", type=Path, help="Markdown file with markers")
    args = parser.parse_args()
    rows = []
    for case in CASES:
        with tempfile.TemporaryDirectory() as work:
            took = []
            for k in range(args.starts):
                took.append(start(case, Path(work) / f"run{k}", args.num_envs, f"{work}/cache"))
                print(f"{case}: {took[-1] or 'hung'}", file=sys.stderr, flush=True)
        first, later = took[0], [x for x in took[1:] if x is not None]
        rows.append(
            [
                f"`{case.engine}`",
                str(case.cores or os.cpu_count()),
                str(case.devices or os.cpu_count()),
                f"{took.count(None)} of {args.starts}",
                f"{first:.1f} s" if first else "-",
                f"{statistics.median(later):.1f} s" if later else "-",
                f"{max(later):.1f} s" if later else "-",
            ]
        )
    peak = resource.getrusage(resource.RUSAGE_CHILDREN).ru_maxrss / 2**20
    columns = ["engine", "cores", "devices", "hung", "first start", "median of the others", "worst"]
    note = f"{args.num_envs} envs; peak memory of a process {peak:.2f} GiB."
    publish("starts", [*table(columns, rows), "", note], args.write)


if __name__ == "__main__":
    main()
