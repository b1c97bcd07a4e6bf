"""Is a robot's computer fast enough for the runtime?

Calls `Controller.step` on one core with the noisy samples of a standing robot, one call after the
other: 100,000 are 7 minutes of a robot's life. Where other work shares the core, the worst call is
the scheduler's: interrupted calls are counted, and the worst of the others given. A robot's control
loop has a real-time priority; where that is allowed, it is measured too.

    python benchmarks/runtime.py [--policy policies/best.safetensors] [--write benchmarks/README.md]
"""

import importlib.util
import os
import resource
import time
from pathlib import Path

os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")

import common
import numpy as np

# The file alone, as on a robot: beside JAX and MuJoCo a garbage collection takes longer.
SPEC = importlib.util.spec_from_file_location("alone", common.REPO / "mjx_balance/runtime.py")
assert SPEC is not None
assert SPEC.loader is not None
runtime = importlib.util.module_from_spec(SPEC)
SPEC.loader.exec_module(runtime)


def interruptions() -> int:
    """How often this thread's core has been taken away."""
    return resource.getrusage(resource.RUSAGE_THREAD).ru_nivcsw


def measure(path: Path, calls: int) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Wall time of every call, ms, whether it decided, and whether it was interrupted.

    Raises:
      RuntimeError: if the controller did not balance all along.
    """
    now = 0.0
    controller = runtime.Controller(path, lambda: now)
    joints = controller.targets
    noise = np.random.default_rng(0).normal(0, (*[0.002] * 3, *[0.023] * 3), (calls, 6))
    gyro, accel = noise[:, :3], noise[:, 3:] + np.array([0, 0, 9.81])
    took, interrupted = np.empty(calls), np.empty(calls, bool)
    for k in range(calls):
        if k % 1_000 == 0:
            time.sleep(0.001)  # the kernel takes the core from what never rests
        now += controller.sample_dt
        before, began = interruptions(), time.perf_counter_ns()
        controller.step(joints, gyro[k], accel[k])
        took[k] = (time.perf_counter_ns() - began) / 1e6
        interrupted[k] = interruptions() != before
    if controller.state is not runtime.State.BALANCING:
        raise RuntimeError(controller.reason)
    return took, np.arange(calls) % controller.decision_samples == 0, interrupted


def main() -> None:
    """Measures and prints."""
    parser = common.arguments(__doc__)
    parser.add_argument("--policy", type=Path, default=common.POLICY)
    parser.add_argument("--calls", type=int, default=100_000)
    args = parser.parse_args()
    os.sched_setaffinity(0, {max(os.sched_getaffinity(0))})
    rows = []
    for priority in ("ordinary", "real-time"):
        if priority == "real-time":
            try:
                os.sched_setscheduler(0, os.SCHED_FIFO, os.sched_param(1))
            except PermissionError:
                continue
        took, decided, interrupted = measure(args.policy, args.calls)
        row = {
            "priority": priority,
            "median": float(np.median(took)),
            "of a decision": float(np.median(took[decided])),
            "99.9%": float(np.percentile(took, 99.9)),
            "worst": float(took.max()),
            "calls interrupted": int(interrupted.sum()),
            "worst of the others": float(took[~interrupted].max()),
        }
        rows.append(row)
    os.sched_setscheduler(0, os.SCHED_OTHER, os.sched_param(0))
    forms = {"median": "{:.4f}", "of a decision": "{:.3f}", "99.9%": "{:.3f}"}
    forms |= {"worst": "{:.2f}", "worst of the others": "{:.2f}"}
    note = f"ms; `{args.policy.name}`, {args.calls:,} calls on one core of {common.machine()}."
    common.report(args, "runtime", rows, note, forms)


if __name__ == "__main__":
    main()
