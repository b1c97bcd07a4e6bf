"""What does a machine that nobody has measured yet make of it?

One command of at most eight minutes, for a GPU or without one:
  rates      physics steps per second of every engine, robots on their feet under a trained policy;
  training   the whole program of preset `default`, sized as a run on this device is, and its share
             of the best of these rates; on an accelerator, runs are sized by them from now on;
  whole run  `train.py` with the fastest engine, started twice (cold, then warm): seconds from the
             start of the process to a validation below 0.2 and 0.1 deg without a fall in both
             headline suites, and the held-out evaluation of what comes out.
Every part is a process of its own. One that fails, for want of memory, of a package or of time, is
said, and leaves the others alone.

    python benchmarks/accelerator.py [--json FILE] [--write benchmarks/README.md]
"""

import argparse
import contextlib
import dataclasses
import importlib.metadata
import json
import os
import shutil
import signal
import subprocess
import sys
import tempfile
import threading
import time
from pathlib import Path
from typing import Any

from markers import publish, table
from throughput import compiled, env_program, hardware, timed

REPO = Path(__file__).resolve().parent.parent
POLICY = REPO / "policies" / "best.safetensors"
ENGINES = ("mjx", "warp", "mujoco")
SIZES = (256, 2_048, 8_192, 32_768)
THRESHOLDS = (0.2, 0.1)
ROUNDS = 5
DECISIONS_PER_CALL = {"cpu": 1_024, "gpu": 16_384}
SHARES = {"rates": 0.16, "training": 0.1, "whole run": 0.2}
"""Most of the budget that one part may take."""


def sized(engine: Any, num_envs: int | None) -> Any:
    """Config and learner of the shipped policy; of preset `default` if a run is to choose."""
    from mjx_balance.config import preset
    from mjx_balance.envs.balance import BalanceEnv
    from mjx_balance.policy.file import load_policy
    from mjx_balance.training import sizing

    config = load_policy(POLICY).config if num_envs else preset("default")
    config = dataclasses.replace(
        config, engine=engine, num_envs=num_envs, num_devices=None, num_seeds=1
    )
    config = sizing.size_to_device(config)
    env = BalanceEnv(config)
    return config, sizing.make_learner(config, env)


def kind() -> str:
    """Of the devices that JAX uses: a CPU's cores, or accelerators."""
    import jax

    return "cpu" if jax.devices()[0].platform == "cpu" else "gpu"


def rates(engine: str, sizes: list[int]) -> None:
    """Prints a line of JSON per number of envs."""
    import jax
    import jax.numpy as jnp
    from safetensors.numpy import load_file

    from mjx_balance.training import sizing

    params: dict[str, Any] = {}
    found: dict[int, float] = {}
    for name, value in load_file(POLICY).items():
        layer, _, part = name.partition("/")
        if part:
            params.setdefault(layer, {})[part] = jnp.asarray(value)
        else:
            params[layer] = jnp.asarray(value)
    for num_envs in sizes:
        config, learner = sized(engine, num_envs)

        def act(obs: Any, network: Any = learner.network) -> Any:
            return network.apply({"params": params}, obs, method="head").argmax()

        iterations = max(1, DECISIONS_PER_CALL[kind()] // num_envs)
        state = learner.init(0).env_state
        program, compile_s = compiled(env_program(learner, iterations, act), state)
        state, _ = program(state, jax.random.PRNGKey(0))
        seconds = []
        for k in range(ROUNDS):
            took, (state, _) = timed(lambda p=program, s=state, k=k: p(s, jax.random.PRNGKey(k)))
            seconds.append(took)
        steps = iterations * num_envs * config.task.sim_steps
        tilt = float(jnp.mean(state.metrics["tilt_deg"]))
        found[num_envs] = steps / sorted(seconds)[ROUNDS // 2]
        say(num_envs, found[num_envs], compile_s, mean_tilt_deg=tilt)
        if kind() == "gpu" and len(found) > 1:  # of one size nobody knows whether it is enough
            sizing.remember_envs(engine, found)


def training(engine: str) -> None:
    """Prints a line of JSON."""
    config, learner = sized(engine, None)
    num_envs = learner.num_envs
    iterations = max(1, DECISIONS_PER_CALL[kind()] // num_envs)
    state = learner.init(0)
    program, compile_s = compiled(learner.train_program(iterations), state)
    for _ in range(config.dqn.min_replay_size // (iterations * num_envs) + 1):
        state, _ = program(state)
    seconds = []
    for _ in range(ROUNDS):
        took, (state, _) = timed(lambda s=state: program(s))
        seconds.append(took)
    steps = iterations * num_envs * config.task.sim_steps
    say(num_envs, steps / sorted(seconds)[ROUNDS // 2], compile_s, updates=learner.updates)


def say(num_envs: int, rate: float, compile_s: float, **more: Any) -> None:
    """Prints what was measured, with the memory that it has taken so far."""
    import jax

    device = jax.devices()[0]
    stats = device.memory_stats() or {}
    row = {
        "num_envs": num_envs,
        "physics_steps_per_second": rate,
        "compile_s": compile_s,
        "device": f"{len(jax.devices())} x {device.device_kind}",
        "device_memory_mib": stats.get("peak_bytes_in_use", 0) / 2**20 or None,
        **more,
    }
    print(json.dumps(row), flush=True)


class Parts:
    """Runs the parts within the budget, and keeps what each of them gave."""

    def __init__(self, budget: float):
        """Begins now; `budget` in s."""
        self.began, self.budget = time.monotonic(), budget
        self.failures: list[str] = []

    def left(self, kind: str) -> float:
        """Seconds that a part of this kind may take."""
        rest = self.budget - (time.monotonic() - self.began)
        return min(rest, SHARES[kind] * self.budget)

    def lines(self, kind: str, engine: str, *flags: str) -> list[dict[str, Any]]:
        """Lines of JSON that a part of this script prints, until it ends or its time is up."""
        name, seconds = f"{kind}, {engine}", self.left(kind)
        if seconds < 10:
            self.failures.append(f"{name}: no time left")
            return []
        print(f"{name} ...", file=sys.stderr, flush=True)
        command = [sys.executable, __file__, "--part", kind, "--engine", engine, *flags]
        process = subprocess.Popen(
            command,
            env=environment(engine),
            stdout=subprocess.PIPE,
            stderr=subprocess.PIPE,
            text=True,
        )
        timer = threading.Timer(seconds, process.kill)
        timer.start()
        out, errors = process.communicate()
        if process.returncode:
            stopped = None if timer.is_alive() else f"stopped after {seconds:.0f} s"
            self.failures.append(f"{name}: {stopped or why(process.returncode, errors)}")
        timer.cancel()
        return [json.loads(x) for x in out.splitlines() if x.startswith("{")]

    def run(self, engine: str, num_envs: int, start: str, work: Path) -> dict[str, Any] | None:
        """A whole `train.py`; none if it did not end well or in time."""
        from mjx_balance.training.program_cache import cache_dir
        from mjx_balance.training.sizing import SIZES_FILE

        name, seconds = f"whole run, {engine}, {start}", self.left("whole run")
        print(f"{name} ...", file=sys.stderr, flush=True)
        folder = work / start
        often = str(8 * num_envs)  # 20 times in a run
        cache = work / "cache"  # empty, but for what the rates say of this device
        cache.mkdir(exist_ok=True)
        with contextlib.suppress(FileNotFoundError):
            shutil.copy(cache_dir() / SIZES_FILE, cache)
        flags = ["--engine", engine, "--eval-every", often, "--log-every", often]
        began = time.monotonic()
        process = subprocess.Popen(
            [sys.executable, str(REPO / "train.py"), *flags, "--run-dir", str(folder)],
            env=environment(engine) | {"MJX_BALANCE_CACHE": str(cache)},
            stdout=sys.stderr,
        )
        reached: dict[float, float] = {}
        while process.poll() is None:
            now = time.monotonic() - began
            if now > seconds:
                process.kill()
                process.wait()
                self.failures.append(f"{name}: stopped after {seconds:.0f} s")
                return None
            for most in THRESHOLDS:
                if most not in reached and passes(folder / "metrics.jsonl", most):
                    reached[most] = now
            time.sleep(0.05)
        results = folder / "evaluation.json"
        if process.returncode or not results.is_file():
            self.failures.append(f"{name}: exit code {process.returncode}")
            return None
        evaluation = {
            suite: result["tilt_deg"] | {"falls": result["falls"], "of": result["scenarios"]}
            for suite, result in json.loads(results.read_text()).items()
        }
        return {"start": start, "engine": engine, "reached_s": reached, "evaluation": evaluation}


def why(code: int, errors: str) -> str:
    """Why a part ended: by its signal, or else its last line."""
    if code < 0:
        return f"ended by {signal.Signals(-code).name}"
    return ([x for x in errors.splitlines() if x.strip()] or [f"exit code {code}"])[-1][:200]


def environment(engine: str) -> dict[str, str]:
    """MuJoCo's C engine needs a CPU, whatever else there is."""
    return os.environ | ({"JAX_PLATFORMS": "cpu"} if engine == "mujoco" else {})


def passes(metrics: Path, most: float) -> bool:
    """Whether a validation had no fall and a mean tilt of at most that, deg, in both suites."""
    lines = metrics.read_text().splitlines(keepends=True) if metrics.is_file() else []
    validated = [json.loads(x) for x in lines if x.endswith("\n") and "eval/" in x]
    return any(
        all(
            x[f"eval/{s}/tilt_mean"] <= most and not x[f"eval/{s}/falls"]
            for s in ("paper", "corner")
        )
        for x in validated
    )


def measure(budget: float, sizes: list[int], engines: list[str]) -> dict[str, Any]:
    """Everything, as far as the budget goes."""
    parts = Parts(budget)
    found: dict[str, Any] = {
        "hardware": hardware() | gpu(),
        "versions": {},
        "rates": [],
        "training": [],
    }
    for name in ("jax", "mujoco", "mujoco-mjx", "warp-lang"):
        try:
            found["versions"][name] = importlib.metadata.version(name)
        except importlib.metadata.PackageNotFoundError:
            found["versions"][name] = None
    best: dict[str, dict[str, Any]] = {}
    for engine in engines:
        if engine == "warp" and found["versions"]["warp-lang"] is None:
            parts.failures.append("warp: warp-lang is not installed")
            continue
        rows = parts.lines("rates", engine, "--sizes", *map(str, sizes))
        found["rates"] += [{"engine": engine} | row for row in rows]
        if rows:
            best[engine] = max(rows, key=lambda row: row["physics_steps_per_second"])
    ranked = sorted(best, key=lambda engine: -best[engine]["physics_steps_per_second"])
    for engine in ranked:
        for row in parts.lines("training", engine):
            share = row["physics_steps_per_second"] / best[engine]["physics_steps_per_second"]
            found["training"].append({"engine": engine, "share_of_rate": share} | row)
    fastest = max(found["training"], key=lambda row: row["physics_steps_per_second"], default=None)
    with tempfile.TemporaryDirectory() as work:
        runs = [
            parts.run(fastest["engine"], fastest["num_envs"], start, Path(work))
            for start in ("cold", "warm")
            if fastest is not None
        ]
    found["runs"] = [run for run in runs if run is not None]
    return found | {"failures": parts.failures, "seconds": time.monotonic() - parts.began}


def gpu() -> dict[str, Any]:
    """Name and memory of the GPUs, where there are NVIDIA's tools."""
    command = [
        "nvidia-smi",
        "--query-gpu=name,memory.total,driver_version",
        "--format=csv,noheader",
    ]
    try:
        said = subprocess.run(command, capture_output=True, text=True, check=True).stdout
    except (OSError, subprocess.CalledProcessError):
        return {"gpu": None}
    return {"gpu": said.strip().splitlines()}


def shown(found: dict[str, Any]) -> list[str]:
    """The Markdown of it."""
    machine = found["hardware"]
    gpus = ", ".join(machine["gpu"] or ["no GPU"])
    versions = ", ".join(f"{k} {v}" for k, v in found["versions"].items() if v)
    lines = [f"{machine['cpu']}, {machine['cores']} cores, {gpus}; {versions}.", ""]
    cells = [
        [
            f"`{row['engine']}`",
            row["device"],
            f"{row['num_envs']:,}",
            f"{row['physics_steps_per_second']:,.0f}",
            "-" if "share_of_rate" not in row else f"{row['share_of_rate']:.2f}",
            f"{row['compile_s']:.0f} s",
            "-" if row["device_memory_mib"] is None else f"{row['device_memory_mib']:,.0f} MiB",
        ]
        for row in (*found["rates"], *found["training"])
    ]
    columns = [
        "engine",
        "device",
        "envs",
        "physics steps/s",
        "training / rate",
        "compiling",
        "memory",
    ]
    lines += table(columns, cells)
    for run in found["runs"]:
        times = ", ".join(
            f"{most} deg after {run['reached_s'][most]:.1f} s"
            if most in run["reached_s"]
            else f"{most} deg never"
            for most in THRESHOLDS
        )
        results = "; ".join(
            f"`{suite}` {x['mean']:.3f} / {x['p95']:.3f} / {x['max']:.3f} deg, "
            f"{x['falls']} of {x['of']} fall"
            for suite, x in run["evaluation"].items()
        )
        lines += ["", f"`train.py --engine {run['engine']}`, {run['start']}: {times}; {results}."]
    if found["failures"]:
        lines += ["", *(f"- {failure}" for failure in found["failures"])]
    return [*lines, "", f"{found['seconds']:.0f} s in all."]


def main() -> None:
    """Measures and prints."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])  # pyright: ignore
    parser.add_argument("--budget", type=float, default=450.0, help="s")
    parser.add_argument("--engines", nargs="+", default=list(ENGINES), choices=ENGINES)
    parser.add_argument("--sizes", type=int, nargs="+", default=list(SIZES))
    parser.add_argument("--json", type=Path, help="file to write the figures to")
    parser.add_argument("--write", type=Path, help="Markdown file with markers")
    parser.add_argument("--part", choices=("rates", "training"), help=argparse.SUPPRESS)
    parser.add_argument("--engine", help=argparse.SUPPRESS)
    args = parser.parse_args()
    if args.part:
        from mjx_balance.quiet import quiet_imports

        with quiet_imports("torch", *(["warp"] if args.engine != "warp" else [])):
            from mjx_balance.training import sizing
        sizing.configure_jax(lambda line: print(line, file=sys.stderr))
        if args.part == "rates":
            rates(args.engine, args.sizes)
        else:
            training(args.engine)
        return
    found = measure(args.budget, args.sizes, args.engines)
    if args.json:
        args.json.write_text(json.dumps(found, indent=2) + "\n")
    publish("accelerator", shown(found), args.write)


if __name__ == "__main__":
    main()
