"""Does a run survive being killed at any moment?

Trains a small run to its end, then the same run again and again with `kill -9` at a random
moment between the making of its folder and its end, resumed until it is finished. The policy,
the best of six validated ones, must be that of the undisturbed run, bit for bit. Prints a table.

    python benchmarks/kills.py [--kills 20] [--seed 0]
"""

import argparse
import os
import random
import subprocess
import sys
import tempfile
import time
from pathlib import Path

from mjx_balance.files.run_folder import RunFolder
from mjx_balance.policy.file import load_policy
from mjx_balance.training.checkpoints import saved_steps

REPO = Path(__file__).resolve().parent.parent
FLAGS = (
    "--preset smoke --num-env-steps 3072 --eval-scenarios 4 --eval-duration 5 "
    "--log-every 512 --checkpoint-seconds 1 --eval-every 512 --export best"
).split()
LIMIT_S = 600.0


def start(cache: str, *flags: str) -> subprocess.Popen[bytes]:
    """Starts a training."""
    return subprocess.Popen(
        [sys.executable, str(REPO / "train.py"), *flags],
        env=os.environ | {"MJX_BALANCE_CACHE": cache},
        stdout=subprocess.DEVNULL,
        stderr=subprocess.STDOUT,
    )


def since_its_folder(process: subprocess.Popen[bytes], folder: RunFolder) -> float:
    """Waits for the folder, then for the end; returns the seconds in between."""
    while not folder.path.exists() and process.poll() is None:
        time.sleep(0.005)
    began = time.monotonic()
    if process.wait(LIMIT_S):
        raise SystemExit(f"the run in {folder.path} failed")
    return time.monotonic() - began


def killed(process: subprocess.Popen[bytes], folder: RunFolder, after: float) -> bool:
    """Kills a run so long after its folder appeared; false if it had ended before."""
    while not folder.path.exists() and process.poll() is None:
        time.sleep(0.005)
    try:
        process.wait(after)
    except subprocess.TimeoutExpired:
        process.kill()
        process.wait()
        return True
    return False


def state_of(folder: RunFolder) -> str:
    """How far a killed run had come."""
    logged = folder.metrics.read_bytes().count(b"\n") if folder.metrics.is_file() else 0
    saved = saved_steps(folder.checkpoints)
    at = f"checkpoint {saved[-1]}" if saved else "no checkpoint"
    return f"{logged} lines of metrics, {at}" + (", a policy" if folder.policy.is_file() else "")


def ends(folder: RunFolder, cache: str) -> str:
    """Resumes a killed run, unless all was written before the kill; the policy it ends in."""
    finished = folder.evaluation.is_file()
    if not finished and start(cache, "--resume", str(folder.path)).wait(LIMIT_S):
        return "does not resume"
    return load_policy(folder.policy).fingerprint


def main() -> int:
    """Kills, resumes, compares; returns 1 if one run ended otherwise."""
    parser = argparse.ArgumentParser()
    parser.add_argument("--kills", type=int, default=20)
    parser.add_argument("--seed", type=int, default=0, help="draws the moments")
    parser.add_argument("--cache", help="compilation cache; none: a new one")
    args = parser.parse_args()
    drawn = random.Random(args.seed)
    same = 0
    with tempfile.TemporaryDirectory() as work:
        cache = args.cache or f"{work}/cache"
        for name in ("cold", "whole"):  # the second knows the length of a warm run
            whole = RunFolder(Path(work) / name)
            length = since_its_folder(start(cache, *FLAGS, "--run-dir", str(whole.path)), whole)
        wanted = load_policy(whole.policy).fingerprint
        print(f"undisturbed: {length:.1f} s from its folder to its end, policy {wanted}")
        for k in range(args.kills):
            folder = RunFolder(Path(work) / f"run{k}")
            after = drawn.uniform(0, length)
            process = start(cache, *FLAGS, "--run-dir", str(folder.path))
            how = state_of(folder) if killed(process, folder, after) else "had ended"
            got = ends(folder, cache)
            same += got == wanted
            print(f"kill {k + 1:2} after {after:5.1f} s | {how} | {got}", flush=True)
    print(f"{same} of {args.kills} ended in the same policy")
    return 0 if same == args.kills else 1


if __name__ == "__main__":
    sys.exit(main())
