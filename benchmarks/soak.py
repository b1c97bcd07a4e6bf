"""Does memory stay flat?

Trains for some minutes, then gives a controller millions of samples, each in a process of its own,
and compares the memory after a tenth of the time with that at the end. Pages of files do not count:
the kernel takes them back when it likes. Training counts from its second checkpoint on, when each
part of the loop has run. The controller's samples are those of a standing robot; one in 10,000 is
impossible, and the controller is reset.

    python benchmarks/soak.py [--minutes 10] [--samples 10000000] [--write benchmarks/README.md]
"""

import statistics
import subprocess
import sys
import tempfile
import time
from pathlib import Path

import common
import numpy as np
import psutil

FAULT_EVERY = 10_000
"""Samples from one impossible reading to the next."""
REST = (0, 0, 0, 0, 0, 9.81)
"""Gyro, rad/s, and accelerometer, m/s^2, of a standing robot."""
READINGS = 1_000
"""How often memory is read in all."""


def memory(process: int | None = None) -> float:
    """Resident memory of a process, or of this one, without pages of files, MiB."""
    info = psutil.Process(process).memory_info()
    return (info.rss - info.shared) / 2**20


def train(engine: str, minutes: float) -> list[float]:
    """Memory of a training run, MiB, from its second checkpoint on.

    Raises:
      RuntimeError: if it ends early.
    """
    readings: list[float] = []
    with tempfile.TemporaryDirectory() as folder:
        run = Path(folder) / "run"
        flags = f"--engine {engine} --num-env-steps 1000000000 --run-dir {run}".split()
        command = [sys.executable, str(common.REPO / "train.py"), *flags]
        with subprocess.Popen(command, stdout=subprocess.DEVNULL) as process:
            began = 0.0
            while not began or time.monotonic() - began < 60 * minutes:
                time.sleep(60 * minutes / READINGS)
                if process.poll() is not None:
                    raise RuntimeError(f"training ended with exit status {process.returncode}")
                if not began and len([*run.glob("checkpoints/*")]) > 1:
                    began = time.monotonic()
                if began:
                    readings.append(memory(process.pid))
            process.kill()
    return readings


def control(policy: Path, samples: int) -> list[float]:
    """Memory of a process that runs a controller, MiB.

    Raises:
      RuntimeError: if it holds without a fault, or balances with one.
    """
    from mjx_balance.runtime import Controller, State

    now = 0.0
    controller = Controller(policy, lambda: now)
    joints, readings = controller.targets, []
    rng = np.random.default_rng(0)
    sizes = [*[0.002] * 3, *[0.023] * 3]
    for k in range(samples):
        now += controller.sample_dt
        gyro, accel = np.split(rng.normal(REST, sizes), 2)
        faulty = k % FAULT_EVERY == FAULT_EVERY - 1
        controller.step(joints, gyro + (np.nan if faulty else 0), accel)
        if (controller.state is State.HOLDING) != faulty:
            raise RuntimeError(f"sample {k}: {controller.state} {controller.reason}")
        if faulty:
            controller.reset()
        if k % max(1, samples // READINGS) == 0:
            readings.append(memory())
    return readings


def row(name: str, readings: list[float]) -> common.Row:
    """Medians over the second and the last tenth, and what grew in between."""
    tenth = len(readings) // 10
    early = statistics.median(readings[tenth : 2 * tenth])
    late = statistics.median(readings[-tenth:])
    return {"what": name, "after a tenth": early, "at the end": late, "growth": late / early - 1}


def main() -> None:
    """Measures and prints."""
    parser = common.arguments(__doc__)
    parser.add_argument("--policy", type=Path, default=common.POLICY)
    parser.add_argument("--engine", default="mujoco", help="of the training")
    parser.add_argument("--minutes", type=float, default=10.0, help="of training")
    parser.add_argument("--samples", type=int, default=10_000_000, help="of the controller")
    args = parser.parse_args()
    training = train(args.engine, args.minutes)
    controller = common.fresh(control, args.policy, args.samples)
    rows = [
        row(f"training, engine {args.engine}, {args.minutes:g} min", training),
        row(f"`Controller`, {args.samples:,} samples", controller),
    ]
    forms = {"after a tenth": "{:.1f}", "at the end": "{:.1f}", "growth": "{:+.2%}"}
    note = f"Memory without pages of files, MiB; {common.machine()}."
    common.report(args, "soak", rows, note, forms)


if __name__ == "__main__":
    main()
