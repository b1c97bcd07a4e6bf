"""Whole runs of `train.py`, as a user starts them."""

import os
import subprocess
import sys
import time
from collections.abc import Callable
from pathlib import Path
from typing import NamedTuple

REPO = Path(__file__).parents[1]
PATIENCE_S = 300.0


class Done(NamedTuple):
    """What became of a process."""

    code: int
    said: str
    """But for gloo's own line."""


def start(cache: Path, *flags: str) -> subprocess.Popen[str]:
    environment = os.environ | {"MJX_BALANCE_CACHE": str(cache)}
    environment.pop("TF_CPP_MIN_LOG_LEVEL", None)  # JAX, imported here, has set it
    return subprocess.Popen(
        [sys.executable, str(REPO / "train.py"), *flags],
        env=environment,
        stdout=subprocess.PIPE,
        stderr=subprocess.STDOUT,
        text=True,
    )


def end(process: subprocess.Popen[str]) -> Done:
    said, _ = process.communicate(timeout=PATIENCE_S)
    lines = [line for line in said.splitlines() if not line.startswith("[Gloo]")]
    return Done(process.returncode, "\n".join(lines))


def wait(process: subprocess.Popen[str], when: Callable[[], object]) -> None:
    """Until something is the case, or the process has ended."""
    until = time.monotonic() + PATIENCE_S
    while not when() and process.poll() is None and time.monotonic() < until:
        time.sleep(0.02)


def interrupt(process: subprocess.Popen[str], number: int, when: Callable[[], object]) -> Done:
    """Sends a signal as soon as something is the case."""
    wait(process, when)
    process.send_signal(number)
    return end(process)
