"""What does an exported controller cost: the header in C, and the stateful ONNX model?

Each is called with the noisy samples of a standing robot, one call after the other, on one core: a
program around the header (`gcc -O2`), the model under onnxruntime with one thread. The worst call
is that of the calls from which the kernel did not take the core. Flash and RAM
are those of the header on a Cortex-M7 (`arm-none-eabi-gcc -Os`), without the C library.

    python benchmarks/exports.py [--policy policies/best.safetensors] [--write docs/deploy.md]
"""

import os
import resource
import subprocess
import tempfile
import time
from pathlib import Path

import common
import numpy as np

MEASURE = r"""
#define _POSIX_C_SOURCE 199309L
#include "policy.h"
#include <stdio.h>
#include <stdlib.h>
#include <sys/resource.h>
#include <time.h>

static uint32_t bits = 1;

static long interruptions(void)
{
    struct rusage usage;
    getrusage(RUSAGE_SELF, &usage);
    return usage.ru_nivcsw;
}

static float noise(float size) /* uniform, of this standard deviation */
{
    bits ^= bits << 13, bits ^= bits >> 17, bits ^= bits << 5;
    return size * 3.4641f * ((float)bits / 4294967296.0f - 0.5f);
}

/* calls; their times, us, to standard output, below 0 if the call was interrupted */
int main(int count, char **arguments)
{
    static mjxb_controller c;
    const mjxb_options options = mjxb_default_options();
    mjxb_sample sample = {0};
    mjxb_init(&c, &options);
    for (int k = 0; count > 1 && k < atoi(arguments[1]); ++k) {
        struct timespec began, ended;
        sample.time += MJXB_SAMPLE_S;
        for (int joint = 0; joint < MJXB_JOINTS; ++joint) {
            sample.joints[joint / 3][joint % 3] = (float)c.out.position[joint / 3][joint % 3];
        }
        for (int axis = 0; axis < 3; ++axis) {
            sample.gyro[axis] = noise(0.002f);
            sample.accelerometer[axis] = noise(0.023f) + (axis == 2 ? 9.81f : 0.0f);
        }
        const long before = interruptions();
        clock_gettime(CLOCK_MONOTONIC, &began);
        mjxb_step(&c, &sample);
        clock_gettime(CLOCK_MONOTONIC, &ended);
        const float passed = 1e6f * (float)(ended.tv_sec - began.tv_sec) +
                             1e-3f * (float)(ended.tv_nsec - began.tv_nsec);
        const float took = interruptions() == before ? passed : -passed;
        fwrite(&took, sizeof took, 1, stdout);
    }
    return c.state != MJXB_BALANCING;
}
"""
ALONE = """
#include "policy.h"
mjxb_controller controller;
mjxb_state step(const mjxb_sample *s);
bool start(const mjxb_options *o);
void stand(void);
mjxb_state step(const mjxb_sample *s) { return mjxb_step(&controller, s); }
bool start(const mjxb_options *o) { return mjxb_init(&controller, o); }
void stand(void) { mjxb_stand(&controller); }
"""


def interruptions() -> int:
    """How often this process' core has been taken away."""
    return resource.getrusage(resource.RUSAGE_SELF).ru_nivcsw


def compile_c(folder: Path, compiler: str, source: str, *flags: str) -> Path:
    """Compiles a program around `policy.h`; returns what the compiler writes."""
    (folder / "main.c").write_text(source)
    command = [compiler, "-std=c99", *flags, "main.c", "-o", "main", "-lm"]
    subprocess.run(command, check=True, cwd=folder)
    return folder / "main"


def size_on_a_cortex(folder: Path) -> tuple[int, int]:
    """Bytes of flash and of RAM that the controller takes on a Cortex-M7."""
    program = compile_c(folder, "arm-none-eabi-gcc", ALONE, "-mcpu=cortex-m7", "-Os", "-c")
    command = ["arm-none-eabi-size", str(program)]
    output = subprocess.run(command, check=True, capture_output=True, text=True).stdout
    code, data, zeros = map(int, output.splitlines()[1].split()[:3])
    return code + data, data + zeros


def times_of_c(folder: Path, calls: int) -> np.ndarray:
    """Wall time of every call of the header's controller, us; below 0: it was interrupted."""
    program = compile_c(folder, "gcc", MEASURE, "-O2")
    done = subprocess.run([program, str(calls)], check=True, capture_output=True)
    return np.frombuffer(done.stdout, np.float32)


def times_of_onnx(file: Path, calls: int) -> np.ndarray:
    """Wall time of every call of the model, us; below 0: it was interrupted."""
    import onnxruntime

    options = onnxruntime.SessionOptions()
    options.intra_op_num_threads = 1
    session = onnxruntime.InferenceSession(str(file), options, providers=["CPUExecutionProvider"])
    joints, *_, memory = (np.zeros(x.shape) for x in session.get_inputs())
    sigmas = (*[0.002] * 3, *[0.023] * 3)
    noise = np.random.default_rng(0).normal((0, 0, 0, 0, 0, 9.81), sigmas, (calls, 6))
    took = np.empty(calls)
    for k in range(calls):
        inputs = {"joint_positions": joints, "gyro": noise[k, :3], "accelerometer": noise[k, 3:]}
        inputs["state"] = memory
        before, began = interruptions(), time.perf_counter_ns()
        joints, *_, memory = session.run(None, inputs)
        took[k] = (time.perf_counter_ns() - began) / (1e3 if interruptions() == before else -1e3)
    return took


def main() -> None:
    """Measures and prints."""
    parser = common.arguments(__doc__)
    parser.add_argument("--policy", type=Path, default=common.POLICY)
    parser.add_argument(
        "--calls", type=int, default=1_000_000, help="of the header; ONNX: a hundredth"
    )
    args = parser.parse_args()
    os.sched_setaffinity(0, {max(os.sched_getaffinity(0))})
    from mjx_balance.policy.c_header import export_header
    from mjx_balance.policy.onnx_controller import export_controller
    from mjx_balance.runtime import Controller

    decision = Controller(args.policy).decision_samples
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        header = export_header(args.policy, folder / "policy.h", "")
        model, _ = export_controller(args.policy, folder / "policy.onnx")
        flash, ram = size_on_a_cortex(folder)
        took = (
            times_of_c(folder, args.calls),
            times_of_onnx(folder / "policy.onnx", args.calls // 100),
        )
    rows = [
        {
            "file": kind,
            "kB": size / 1e3,
            "median": float(np.median(abs(us))),
            "of a decision": float(np.median(abs(us[::decision]))),
            "worst": float(us.max()),
            "flash kB": memory[0],
            "RAM kB": memory[1],
        }
        for kind, size, us, memory in (
            ("C", header, took[0], (flash / 1e3, ram / 1e3)),
            ("ONNX", model, took[1], (None, None)),
        )
    ]
    forms = {"kB": "{:.0f}", "median": "{:.1f}", "of a decision": "{:.1f}", "worst": "{:,.0f}"}
    forms |= {"flash kB": "{:.1f}", "RAM kB": "{:.1f}"}
    note = (
        f"us a call; `{args.policy.stem}`, {args.calls:,} calls in C, a hundredth of that in ONNX, "
    )
    note += f"one core of {common.machine()}; flash and RAM of a Cortex-M7."
    common.report(args, "exports", rows, note, forms)


if __name__ == "__main__":
    main()
