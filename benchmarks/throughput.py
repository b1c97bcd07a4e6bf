"""How fast is the simulation, and what does learning cost on top?

Measures, on whatever device JAX finds and interleaved in the same run:
  env        the raw environment over an engine, random actions, robots on their feet;
  training   the whole training program of a preset, its own number of updates;
  Batch      `mujoco.batch.Batch`, MuJoCo's C engine on all cores, same model and
             actions of the same kind: the peer that the ratios are against.
Each row runs in a process of its own. Compile time and peak memory stand apart.

    python benchmarks/throughput.py [--engines mjx mujoco] [--num-envs 64 256 1024]
"""

import argparse
import dataclasses
import itertools
import json
import os
import platform
import resource
import statistics
import subprocess
import sys
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

from markers import publish, table

DECISIONS_PER_CALL = 2048


def measure(engine: Any, num_envs: int, preset_name: str, rounds: int) -> dict[str, Any]:
    """Measures one row in this process."""
    from mjx_balance.quiet import quiet_imports

    with quiet_imports("torch", *(["warp"] if engine != "warp" else [])):
        import jax

        from mjx_balance.envs.balance import BalanceEnv
        from mjx_balance.training import sizing
    from mjx_balance.config import preset

    config = dataclasses.replace(preset(preset_name), engine=engine, num_envs=num_envs)
    sizing.configure_jax(print)
    jax.config.update("jax_enable_compilation_cache", False)  # to time the compilation
    config = sizing.size_to_device(config)
    env = BalanceEnv(config)
    learner = sizing.make_learner(config, env)
    iterations = max(1, DECISIONS_PER_CALL // num_envs)
    decisions = iterations * num_envs

    state = learner.init(0)
    raw, raw_compile = compiled(env_program(learner, iterations), state.env_state)
    train, train_compile = compiled(learner.train_program(iterations), state)
    env_state = jax.tree.map(lambda x: x.copy(), state.env_state)
    warm_up = config.dqn.min_replay_size // decisions + 1
    for _ in range(warm_up):
        state, _ = train(state)
    env_state, _ = raw(env_state, jax.random.PRNGKey(0))
    roll, peer_steps = _peer(env, num_envs)
    seconds: dict[str, list[float]] = {"env": [], "training": [], "batch": []}
    for k in range(rounds):
        took, (env_state, _) = timed(lambda s=env_state, k=k: raw(s, jax.random.PRNGKey(k)))
        seconds["env"].append(took / (decisions * config.task.sim_steps))
        took, (state, _) = timed(lambda s=state: train(s))
        seconds["training"].append(took / (decisions * config.task.sim_steps))
        took, _ = timed(roll)
        seconds["batch"].append(took / peer_steps)
    rate = {name: 1 / statistics.median(values) for name, values in seconds.items()}
    device = jax.devices()[0]
    stats = device.memory_stats() or {}
    return {
        "engine": engine,
        "num_envs": num_envs,
        "preset": preset_name,
        "updates_per_step": config.dqn.updates_per_step(num_envs),
        "device": f"{len(jax.devices())} x {device.device_kind}",
        "devices_used": config.num_devices,
        "physics_steps_per_second": rate,
        "decisions_per_second": {k: v / config.task.sim_steps for k, v in rate.items()},
        "env_over_batch": _ratio(seconds["batch"], seconds["env"]),
        "training_over_batch": _ratio(seconds["batch"], seconds["training"]),
        "compile_s": {"env": raw_compile, "training": train_compile},
        "peak_host_memory_mib": resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1024,
        "peak_device_memory_mib": stats.get("peak_bytes_in_use", 0) / 2**20 or None,
    }


def env_program(learner, iterations: int, act: Callable[..., Any] | None = None):
    """The env alone, done robots reset as in training: state and key -> state.

    Args:
      learner: of the env and the devices.
      iterations: decisions of every env.
      act: observations (n, obs_size) -> actions (n,); random ones if none.
    """
    import jax
    import jax.numpy as jnp

    from mjx_balance.dqn.collecting import reset_done
    from mjx_balance.dqn.devices import device_key, on_each_device
    from mjx_balance.dqn.learner import REPLICATED

    env = learner.env

    def step(state, key):
        key_act, key_reset = jax.random.split(device_key(key))
        shape = state.reward.shape
        drawn = jax.random.randint(key_act, shape, 0, env.action_size)
        action = drawn if act is None else act(state.obs)
        return reset_done(env.reset, jax.vmap(env.step)(state, action), key_reset), None

    def program(state, key):
        state, _ = jax.lax.scan(step, state, jax.random.split(key, iterations))
        return state, jnp.zeros(())

    sharded = learner.specs.env_state
    return jax.jit(
        on_each_device(
            program,
            learner.mesh,
            in_specs=(sharded, REPLICATED),
            out_specs=(sharded, REPLICATED),
        )
    )


def compiled(program: Callable[..., Any], state: Any) -> tuple[Callable[..., Any], float]:
    """A program for such states, and the seconds that it took to compile."""
    import jax
    from brax.envs.base import State

    from mjx_balance.training.program_cache import compiler_options

    arguments = (state, jax.random.PRNGKey(0)) if isinstance(state, State) else (state,)
    began = time.perf_counter()
    lowered = program.lower(*arguments)  # pyright: ignore
    return lowered.compile(compiler_options()), time.perf_counter() - began


def _peer(env, num_envs: int) -> tuple[Callable[[], Any], int]:
    """One decision of MuJoCo's C engine from the standing state, random actions."""
    import numpy as np
    from mujoco.batch import Batch

    from mjx_balance.task import decision
    from mjx_balance.task.actions import action_table
    from mjx_balance.task.tilt import Scenario

    config, scene = env.config, env.scene
    task, rng = config.task, np.random.default_rng(0)
    memory = decision.start(task, scene.robot, np.tile(scene.stance.imu, (num_envs, 1)))
    change = action_table(task)[rng.integers(env.action_size, size=num_envs)]
    targets = rng.uniform(-5, 5, (num_envs, 2, 2))
    scenario = Scenario(targets, np.zeros(num_envs), np.full(num_envs, task.board_rate))
    now = np.zeros(num_envs)
    _, wanted = decision.controls(task, scene.robot, memory, change, None, scenario, now)
    ctrl = scene.ctrl(wanted)
    batch = Batch(scene.model, num_envs, os.cpu_count() or 1)
    repeats = max(1, DECISIONS_PER_CALL // num_envs)

    def roll() -> None:
        for _ in range(repeats):
            batch.qpos, batch.qvel = scene.stance.qpos, scene.stance.qvel
            batch.qacc_warmstart = scene.stance.qacc_warmstart
            batch.rollout(config.task.sim_steps, ctrl, record=("qpos", "sensordata"))

    return roll, repeats * num_envs * config.task.sim_steps


def timed(call: Callable[[], Any]) -> tuple[float, Any]:
    """Seconds of a call, and what it gave."""
    import jax

    began = time.perf_counter()
    result = jax.block_until_ready(call())
    return time.perf_counter() - began, result


def _ratio(slower: list[float], faster: list[float]) -> float:
    """Median over the rounds of the rate of the second over that of the first."""
    return statistics.median(a / b for a, b in zip(slower, faster, strict=True))


def hardware() -> dict[str, Any]:
    """What this was measured on."""
    model = platform.processor()
    cpuinfo = Path("/proc/cpuinfo")
    if cpuinfo.is_file():
        names = [x for x in cpuinfo.read_text().splitlines() if x.startswith("model name")]
        model = names[0].split(":", 1)[1].strip() if names else model
    return {"cpu": model, "cores": os.cpu_count(), "system": platform.platform()}


def main() -> None:
    """Measures every row and prints the table."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])  # pyright: ignore
    parser.add_argument("--engines", nargs="+", default=["mjx", "mujoco"])
    parser.add_argument("--num-envs", type=int, nargs="+", default=[64, 256, 1024])
    parser.add_argument("--preset", default="default")
    parser.add_argument("--rounds", type=int, default=7)
    parser.add_argument("--json", type=Path, help="file to write the figures to")
    parser.add_argument("--write", type=Path, help="Markdown file with markers")
    parser.add_argument("--row", action="store_true", help=argparse.SUPPRESS)
    args = parser.parse_args()
    if args.row:
        print(json.dumps(measure(args.engines[0], args.num_envs[0], args.preset, args.rounds)))
        return
    rows = []
    flags = ["--preset", args.preset, "--rounds", str(args.rounds)]
    for engine, num_envs in itertools.product(args.engines, args.num_envs):
        print(f"measuring {engine}, {num_envs} envs ...", file=sys.stderr, flush=True)
        row = ["--row", "--engines", engine, "--num-envs", str(num_envs), *flags]
        command = [sys.executable, __file__, *row]
        done = subprocess.run(command, stdout=subprocess.PIPE, text=True, check=True)
        rows.append(json.loads(done.stdout.splitlines()[-1]))
    machine = hardware()
    columns = ["engine", "envs", "env", "training", "Batch", "env / Batch", "training / Batch"]
    columns += ["compile env, training", "host memory"]
    cells = []
    for row in rows:
        rates, decisions = row["physics_steps_per_second"], row["decisions_per_second"]
        cells.append(
            [
                f"`{row['engine']}`",
                str(row["num_envs"]),
                *(f"{rates[k]:,.0f} ({decisions[k]:,.0f})" for k in rates),
                f"{row['env_over_batch']:.2f}",
                f"{row['training_over_batch']:.2f}",
                ", ".join(f"{s:.0f} s" for s in row["compile_s"].values()),
                f"{row['peak_host_memory_mib']:,.0f} MiB",
            ]
        )
    note = (
        f"{machine['cpu']}, {machine['cores']} cores, {rows[0]['device']}, preset {args.preset}; "
        "physics steps per second, decisions per second in brackets, medians of "
        f"{args.rounds} rounds."
    )
    publish("throughput", [*table(columns, cells), "", note], args.write)
    if args.json:
        args.json.write_text(json.dumps({"hardware": machine, "rows": rows}, indent=2) + "\n")


if __name__ == "__main__":
    main()
