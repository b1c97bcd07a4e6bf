"""Does training always start, and how soon does it learn?

Starts the same training several times in a row, waits until it has logged its first
gradient steps, then stops it. Prints the seconds that took, of which the first start
includes the compilation, and the peak memory. A start that takes longer than the
limit counts as hung.

    python benchmarks/starts.py [--starts 10] [--num-envs 1024]
"""

import argparse
import json
import os
import resource
import subprocess
import sys
import tempfile
import time
from pathlib import Path

LIMIT_S = 300.0
REPO = Path(__file__).resolve().parent.parent


def start(folder: Path, num_envs: int, cache: str) -> float | None:
    """Seconds until a new run has logged its first gradient steps; None if it never does."""
    flags = f"--num-envs {num_envs} --log-every 1024".split()
    process = subprocess.Popen(
        [sys.executable, str(REPO / "train.py"), *flags, "--run-dir", str(folder)],
        env=os.environ | {"MJX_BALANCE_CACHE": cache},
        stdout=subprocess.DEVNULL,
    )
    began = time.perf_counter()
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
    args = parser.parse_args()
    hung = 0
    with tempfile.TemporaryDirectory() as work:
        for k in range(args.starts):
            seconds = start(Path(work) / f"run{k}", args.num_envs, f"{work}/cache")
            hung += seconds is None
            print(f"start {k + 1}: " + ("hung" if seconds is None else f"{seconds:.1f} s"))
    peak = resource.getrusage(resource.RUSAGE_CHILDREN).ru_maxrss / 2**20
    print(f"{hung} of {args.starts} starts hung; peak memory {peak:.2f} GiB")


if __name__ == "__main__":
    main()
