"""What does a machine make of it that nobody has measured yet?

One command of at most eight minutes, for a GPU or without one:
  rates      physics steps per second of every engine, robots on their feet under a trained policy;
  training   the whole program of preset `default`, sized as a run on this device is, and its share
             of the best of these rates; on an accelerator, runs are sized by them from now on;
  whole run  `train.py` with the fastest engine, cold and warm: seconds from the start of the
             process to a validation below 0.2 and 0.1 deg without a fall, and its evaluation.
Every part is a process of its own. One that fails is listed with the reason.

    python benchmarks/accelerator.py [--json FILE] [--write benchmarks/README.md]
"""

import contextlib
import json
import math
import multiprocessing
import os
import shutil
import signal
import statistics
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import common
import throughput
from common import POLICY, REPO, Row
from throughput import Program, jax, sizing

from mjx_balance.evaluation.suites import HEADLINE
from mjx_balance.files.run_folder import RunFolder
from mjx_balance.policy.file import load_policy
from mjx_balance.policy.manifest import installed_version
from mjx_balance.training.program_cache import cache_dir

ENGINES = ("mjx", "warp", "mujoco")
RATE = "physics steps/s"
PACKAGES = ("jax", "mujoco", "mujoco-mjx", "warp-lang")
SIZES = (256, 2_048, 8_192, 32_768)
THRESHOLDS = (0.2, 0.1)
"""Mean tilts that a validation has to reach, deg."""
ROUNDS = 5
DECISIONS_PER_CALL = {"cpu": 1_024, "gpu": 16_384}
SHARES = {"rates": 0.16, "training": 0.1, "whole_run": 0.2}
"""Most of the budget that one part may take."""


def timed(program: Program, num_envs: int, config: Any, iterations: int) -> Row:
    """A row of what a program takes."""
    [seconds] = common.interleaved({"program": program}, ROUNDS).values()
    steps, device = iterations * num_envs * config.task.sim_steps, throughput.device_fields()
    return {
        "engine": config.engine,
        "device": device["device"],
        "envs": num_envs,
        RATE: steps / statistics.median(seconds),
        "training / rate": None,
        "compiling": program.compile_s,
        "memory": device["peak_device_memory_mib"],
    }


def iterations_of(num_envs: int) -> int:
    """Decisions of every env in one call."""
    kind = "cpu" if jax.devices()[0].platform == "cpu" else "gpu"
    return max(1, DECISIONS_PER_CALL[kind] // num_envs)


def rates(engine: str, sizes: list[int]) -> Iterator[Row]:
    """The shipped policy in the env it was trained in, a row per number of envs."""
    from flax.traverse_util import unflatten_dict
    from safetensors.flax import load_file

    params, by_size = unflatten_dict(load_file(POLICY), sep="/"), {}
    for num_envs in sizes:
        fields = {"engine": engine, "num_envs": num_envs, "num_devices": None, "num_seeds": 1}
        config, learner = throughput.make_learner(load_policy(POLICY).config, **fields)

        def act(obs: Any, head: Any = learner.head) -> Any:
            return head({"params": params}, obs).argmax()

        iterations = iterations_of(num_envs)
        start = learner.init(0).env_state, jax.random.PRNGKey(0)
        program = Program(throughput.env_program(learner, iterations, act), start)
        program()
        row = timed(program, num_envs, config, iterations)
        yield row
        by_size[num_envs] = row[RATE]
        # Of one size nobody knows whether it is enough.
        if jax.devices()[0].platform != "cpu" and len(by_size) > 1:
            sizing.remember_envs(engine, by_size)


def training(engine: str) -> Iterator[Row]:
    """One row: preset `default`, sized as a run is."""
    config, learner = throughput.make_learner(engine=engine, num_devices=None)
    iterations = iterations_of(learner.spec.num_envs)
    program = throughput.training_program(config, learner, iterations)
    yield timed(program, learner.spec.num_envs, config, iterations)


def whole_run(engine: str, num_envs: int, start: str, work: Path) -> Iterator[Row]:
    """One row: a whole `train.py`."""
    folder, cache = RunFolder(work / start), work / "cache"
    cache.mkdir(exist_ok=True)  # empty, but for what the rates say of this device
    with contextlib.suppress(FileNotFoundError):
        shutil.copy(cache_dir() / sizing.SIZES_FILE, cache)
    variables = os.environ | {"MJX_BALANCE_CACHE": str(cache)}
    if engine == "mujoco":
        variables["JAX_PLATFORMS"] = "cpu"
    often = str(8 * num_envs)  # 20 times in a run
    flags = ["--engine", engine, "--eval-every", often, "--log-every", often]
    command = [sys.executable, str(REPO / "train.py"), *flags, "--run-dir", str(folder.path)]
    began = time.time()
    done = subprocess.run(command, env=variables, stdout=sys.stderr)
    if done.returncode:
        raise RuntimeError(f"train.py: {why(done.returncode)}")
    results = json.loads(folder.evaluation.read_text())
    evaluation = {suite: common.pooled([result]) for suite, result in results.items()}
    reached = {str(most): seconds_to(folder, began, most) for most in THRESHOLDS}
    yield {"start": start, "engine": engine, "reached_s": reached, "evaluation": evaluation}


def seconds_to(folder: RunFolder, began: float, most: float) -> float | None:
    """Seconds from `began`, of the epoch, to a validation with no fall and at most so many deg."""
    for line in map(json.loads, folder.metrics.read_text().splitlines()):
        tilts = [line.get(f"eval/{suite}/tilt_mean", math.inf) for suite in HEADLINE]
        if max(tilts) <= most and not any(line[f"eval/{suite}/falls"] for suite in HEADLINE):
            [policy] = (folder.validated / str(line["env_steps"])).iterdir()
            return policy.stat().st_mtime - began
    return None


def why(code: int) -> str:
    """How a process ended."""
    return f"ended by {signal.Signals(-code).name}" if code < 0 else f"exit code {code}"


def send_rows(sender: Any, part: Callable[..., Iterator[Row]], engine: str, *args: Any) -> None:
    """In a process of its own: sends a part's rows as they come, or the error's last line."""
    os.setsid()  # to be stopped with all that it starts
    if engine == "mujoco":  # needs a CPU, whatever else there is
        jax.config.update("jax_platforms", "cpu")
    try:
        for row in part(engine, *args):
            sender.send(row)
    except Exception as error:  # whatever it is, the other parts go on
        lines = [line for line in str(error).splitlines() if line.strip()]
        sender.send((lines or [type(error).__name__])[-1][:200])


class Parts:
    """Runs the parts within the budget, and keeps why parts failed."""

    def __init__(self, budget: float):
        """Begins now; `budget` in s."""
        self.began, self.budget = time.monotonic(), budget
        self.failures: list[str] = []

    def rows(self, part: Callable[..., Iterator[Row]], engine: str, *args: Any) -> list[Row]:
        """Rows that a part gives until it ends or its time is up."""
        kind, begins = part.__name__, time.monotonic()
        name, results = f"{kind.replace('_', ' ')}, {engine}", []
        seconds = min(self.began + self.budget - begins, SHARES[kind] * self.budget)
        if seconds < 10:
            self.failures.append(f"{name}: no time left")
            return []
        common.log(f"{name} ...")
        spawn = multiprocessing.get_context("spawn")
        receiver, sender = spawn.Pipe(duplex=False)
        process = spawn.Process(target=send_rows, args=(sender, part, engine, *args))
        process.start()
        pid = process.pid
        assert pid is not None
        sender.close()
        try:
            while receiver.poll(max(0.0, begins + seconds - time.monotonic())):
                results.append(receiver.recv())
            results.append(f"stopped after {seconds:.0f} s")
        except EOFError:
            process.join()
            if process.exitcode:
                results.append(why(process.exitcode))
        finally:
            with contextlib.suppress(ProcessLookupError):
                os.killpg(pid, signal.SIGKILL)
            process.kill()  # if it has no group of its own yet
            process.join()
        self.failures += [f"{name}: {result}" for result in results if isinstance(result, str)]
        return [result for result in results if isinstance(result, dict)]


def measure(budget: float, sizes: list[int], engines: list[str]) -> dict[str, Any]:
    """Everything, as far as the budget goes."""
    parts = Parts(budget)
    rows = [row for engine in engines for row in parts.rows(rates, engine, sizes)]
    best: dict[str, float] = {}
    for row in rows:
        best[row["engine"]] = max(row[RATE], best.get(row["engine"], 0.0))
    trainings = []
    for engine in sorted(best, key=lambda engine: -best[engine]):
        for row in parts.rows(training, engine):
            trainings.append(row | {"training / rate": row[RATE] / best[engine]})
    runs = []
    with tempfile.TemporaryDirectory() as work:
        if trainings:
            fastest = max(trainings, key=lambda row: row[RATE])
            for start in ("cold", "warm"):
                where = fastest["envs"], start, Path(work)
                runs += parts.rows(whole_run, fastest["engine"], *where)
    return {
        "versions": {x: installed_version(x) for x in PACKAGES},
        "rows": rows + trainings,
        "runs": runs,
        "failures": parts.failures,
        "seconds": time.monotonic() - parts.began,
    }


def lines_of(measured: dict[str, Any]) -> list[str]:
    """The Markdown of it."""
    versions = ", ".join(f"{k} {v}" for k, v in measured["versions"].items() if v)
    forms = {"envs": "{:,}", RATE: "{:,.0f}", "training / rate": "{:.2f}"}
    forms |= {"compiling": "{:.0f} s", "memory": "{:,.0f} MiB"}
    lines = [f"{common.machine()}; {versions}.", "", *common.table(measured["rows"], forms)]
    for run in measured["runs"]:
        times = [
            f"{most} deg never" if seconds is None else f"{most} deg after {seconds:.1f} s"
            for most, seconds in run["reached_s"].items()
        ]
        results = [f"`{suite}` {common.tilts(x)}" for suite, x in run["evaluation"].items()]
        command = f"`train.py --engine {run['engine']}`, {run['start']}"
        lines += ["", f"{command}: {', '.join(times)}; {'; '.join(results)} deg."]
    failures = [f"- {failure}" for failure in measured["failures"]]
    return [*lines, "", *failures, "", f"{measured['seconds']:.0f} s in all."]


def main() -> None:
    """Measures and prints."""
    parser = common.arguments(__doc__)
    parser.add_argument("--budget", type=float, default=450.0, help="s")
    parser.add_argument("--engines", nargs="+", default=list(ENGINES), choices=ENGINES)
    parser.add_argument("--sizes", type=int, nargs="+", default=list(SIZES))
    args = parser.parse_args()
    measured = measure(args.budget, args.sizes, args.engines)
    common.save(args.json, **measured)
    common.publish("accelerator", lines_of(measured), args.write)


if __name__ == "__main__":
    main()
