"""How fast is it: the envs, training on top, many seeds, several processes, Gymnasium?

Tables, one per call (`--table`):
  engines     per engine and number of envs: the env alone with random actions, the whole training
              program of a preset, and the peer, `mujoco.batch.Batch`: MuJoCo's C engine on all
              cores, same model, servo targets of the same kind;
  seeds       training with `--num-seeds` 1, 4, 16, 64 and as many envs in all;
  processes   training in two processes of one core each, against one, and the exchange of one
              update's gradients alone;
  gymnasium   `make_vec` with random actions against `Batch`.
A row is a process of its own; what a row compares takes turns. Compile time and memory stand apart.

    python benchmarks/throughput.py [--table engines] [--num-envs 256 1024] [--json FILE]
"""

import argparse
import concurrent.futures
import dataclasses
import itertools
import multiprocessing
import os
import resource
import socket
import statistics
import time
from collections.abc import Callable
from typing import Any

import common
import numpy as np
from common import Row
from mujoco.batch import Batch

from mjx_balance.config import Config, preset
from mjx_balance.machine import cores
from mjx_balance.quiet import quiet_imports

with quiet_imports("torch"):
    import jax
    import jax.numpy as jnp
    from jax.flatten_util import ravel_pytree

    from mjx_balance.dqn import DQN
    from mjx_balance.dqn.dqn import reset_done
    from mjx_balance.dqn.mesh import REPLICATED, device_key, mean_over_devices, on_each_device
    from mjx_balance.envs.balance import BalanceEnv
    from mjx_balance.training import program_cache, sizing
    from mjx_balance.training.processes import Cluster, joined
from mjx_balance.sim.scene import Scene, load_scene

DECISIONS_PER_CALL = 2_048
EXCHANGES = 500
SCALINGS = {
    "one": (1, 1, 1),
    "weak": (2, 2, 2),
    "weak, same batch": (2, 2, 1),
    "strong": (2, 1, 1),
}
"""Processes, envs and batches over those of one."""


class Program:
    """A compiled program (state) -> (state, metrics), and the state that each call replaces."""

    def __init__(self, jitted: Any, state: Any):
        """Compiles it for such a state; `compile_s` says how long that took."""
        began = time.perf_counter()
        self.run = jitted.lower(state).compile(program_cache.compiler_options())
        self.compile_s, self.state = time.perf_counter() - began, state

    def __call__(self) -> None:
        """Runs it to its end."""
        self.state, _ = jax.block_until_ready(self.run(self.state))


def make_learner(config: Config | None = None, **fields: Any) -> tuple[Config, DQN]:
    """A config (preset `default`) with other fields, sized, and its learner; in a new process."""
    sizing.configure_jax(common.log)
    jax.config.update("jax_enable_compilation_cache", False)  # to time the compilation
    config = dataclasses.replace(config or preset("default"), **fields)
    config = sizing.size_to_device(config)
    return config, sizing.make_learner(config, BalanceEnv(config))


def training_program(
    config: Config, learner: DQN, iterations: int, ready: Callable[[], Any] = lambda: None
) -> Program:
    """Training with its replay filled, so that every call makes its updates.

    A call makes `iterations` decisions of every env. `ready` runs once it is compiled.
    """
    program = Program(learner.train_program(iterations), learner.init(0))
    ready()
    seeds = config.num_seeds
    decisions = iterations * learner.spec.num_envs * seeds
    for _ in range(config.dqn.min_replay_size * seeds // decisions + 2):
        program()
    return program


def env_program(learner: DQN, iterations: int, act: Callable[..., Any] | None = None) -> Any:
    """The env alone, done envs reset as in training: (env state, key) -> (the same, nothing).

    `act` maps observations (n, obs_size) to actions; they are random if none.
    """
    env = learner.env

    def random(key: Any, count: int) -> Any:
        if learner.spec.continuous:
            return jax.random.uniform(key, (count, env.action_size), jnp.float32, -1, 1)
        return jax.random.randint(key, (count,), 0, env.action_size)

    def step(state: Any, key: Any) -> Any:
        key_act, key_reset = jax.random.split(device_key(key))
        action = random(key_act, len(state.reward)) if act is None else act(state.obs)
        return reset_done(env.reset, jax.vmap(env.step)(state, action), key_reset), None

    def program(state_and_key: Any) -> Any:
        state, key = state_and_key
        next_key, *keys = jax.random.split(key, iterations + 1)
        state, _ = jax.lax.scan(step, state, jnp.asarray(keys))
        return (state, next_key), jnp.zeros(())

    specs = (learner.state_specs.env_state, REPLICATED)
    each = on_each_device(program, learner.mesh, in_specs=(specs,), out_specs=(specs, REPLICATED))
    return jax.jit(each)


def device_fields() -> Row:
    """What JAX runs on, and the memory taken there so far."""
    device = jax.devices()[0]
    stats = device.memory_stats() or {}
    return {
        "device": f"{len(jax.devices())} x {device.device_kind}",
        "peak_device_memory_mib": stats.get("peak_bytes_in_use", 0) / 2**20 or None,
    }


def batch_peer(scene: Scene, num_envs: int) -> tuple[Callable[[], Any], int]:
    """Decisions of MuJoCo's C engine from the stance, and how many.

    The servo targets are random, as far from the stance as an action's, on a board that turns.
    """
    task, stance, rng = scene.task, scene.stance, np.random.default_rng(0)
    legs = stance.qpos[scene.leg_qpos] + stance.leg_trim
    turned = np.radians(task.board_rate * task.sim_dt) * np.arange(1, 1 + task.sim_steps)
    ctrl = np.zeros((num_envs, task.sim_steps, scene.model.nu))
    ctrl[..., scene.leg_ctrl] = legs + rng.uniform(-0.01, 0.01, (num_envs, 1, *legs.shape))
    ctrl[..., scene.board_ctrl] = turned[:, None] * rng.choice((-1, 1), (num_envs, 1, 2))
    batch = Batch(scene.model, num_envs, cores())
    repeats = max(1, DECISIONS_PER_CALL // num_envs)

    def roll() -> None:
        for _ in range(repeats):
            batch.qpos, batch.qvel = stance.qpos, stance.qvel
            batch.qacc_warmstart = stance.qacc_warmstart
            batch.rollout(task.sim_steps, ctrl, record=("qpos", "sensordata"))

    return roll, repeats * num_envs


def engine_row(engine: str, num_envs: int, preset_name: str, rounds: int) -> Row:
    """Env, training and peer, as `--json` has them."""
    config, learner = make_learner(preset(preset_name), engine=engine, num_envs=num_envs)
    iterations = max(1, DECISIONS_PER_CALL // num_envs)
    train = training_program(config, learner, iterations)
    start = learner.init(0).env_state, jax.random.PRNGKey(0)
    env = Program(env_program(learner, iterations), start)
    env()
    batch, peers = batch_peer(learner.env.scene, num_envs)
    seconds = common.interleaved({"env": env, "training": train, "batch": batch}, rounds)
    ours, steps = iterations * num_envs, config.task.sim_steps
    counts = {"env": ours, "training": ours, "batch": peers}
    each = {name: [x / counts[name] for x in those] for name, those in seconds.items()}
    rate = {name: 1 / statistics.median(those) for name, those in each.items()}
    return {
        "engine": engine,
        "num_envs": num_envs,
        "preset": preset_name,
        "updates_per_step": config.dqn.updates_per_step(num_envs),
        **device_fields(),
        "devices_used": config.num_devices,
        "physics_steps_per_second": {name: steps * value for name, value in rate.items()},
        "decisions_per_second": rate,
        "env_over_batch": common.ratio(each["batch"], each["env"]),
        "training_over_batch": common.ratio(each["batch"], each["training"]),
        "compile_s": {"env": env.compile_s, "training": train.compile_s},
        "peak_host_memory_mib": resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1024,
    }


def engine_cells(row: Row) -> Row:
    """What the table shows of a row."""
    physics, decisions = row["physics_steps_per_second"], row["decisions_per_second"]
    names = {"env": "env", "training": "training", "batch": "Batch"}
    return {
        "engine": row["engine"],
        "envs": row["num_envs"],
        **{title: f"{physics[x]:,.0f} ({decisions[x]:,.0f})" for x, title in names.items()},
        "env / Batch": f"{row['env_over_batch']:.2f}",
        "training / Batch": f"{row['training_over_batch']:.2f}",
        "compile env, training": ", ".join(f"{x:.0f} s" for x in row["compile_s"].values()),
        "host memory": f"{row['peak_host_memory_mib']:,.0f} MiB",
    }


def engines(args: argparse.Namespace) -> None:
    """Table `engines`."""
    rows = []
    for engine, num_envs in itertools.product(args.engines, args.num_envs):
        common.log(f"measuring {engine}, {num_envs} envs ...")
        rows.append(common.fresh(engine_row, engine, num_envs, args.preset, args.rounds))
    note = (
        f"{common.machine()}, {rows[0]['device']}, preset {args.preset}; physics steps per second, "
        f"decisions per second in brackets, medians of {args.rounds} rounds."
    )
    common.save(args.json, rows)
    lines = common.table([engine_cells(row) for row in rows])
    common.publish("throughput engines", [*lines, "", note], args.write)


def seeds_row(engine: str, num_seeds: int, num_envs: int, rounds: int) -> Row:
    """Training of so many seeds, `num_envs` in all."""
    each, iterations = num_envs // num_seeds, max(1, DECISIONS_PER_CALL // num_envs)
    config, learner = make_learner(engine=engine, num_envs=each, num_seeds=num_seeds)
    train = training_program(config, learner, iterations)
    [seconds] = common.interleaved({"training": train}, rounds).values()
    rate = iterations * num_envs / statistics.median(seconds)
    row = {"engine": engine, "seeds": num_seeds, "envs of each": each, "decisions/s": rate}
    return row | {"over the first": 1.0, "compiling": train.compile_s}


def seeds(args: argparse.Namespace) -> None:
    """Table `seeds`."""
    rows, first = [], {}
    for engine, count in itertools.product(args.engines, args.seeds):
        common.log(f"measuring {engine}, {count} seeds ...")
        row = common.fresh(seeds_row, engine, count, args.num_envs[-1], args.rounds)
        rate = row["decisions/s"]
        rows.append(row | {"over the first": rate / first.setdefault(engine, rate)})
    forms = {"decisions/s": "{:,.0f}", "over the first": "{:.2f}", "compiling": "{:.0f} s"}
    note = f"{common.machine()}; medians of {args.rounds} calls."
    common.report(args, "throughput seeds", rows, note, forms)


def process_row(cluster: Any, engine: str, num_envs: int, batches: int, rounds: int) -> Row:
    """One process of several, on a core of its own: training and exchanges of gradients."""
    os.sched_setaffinity(0, {sorted(os.sched_getaffinity(0))[cluster.process_id]})
    default = preset("default").dqn
    dqn = dataclasses.replace(default, batch_size=batches * default.batch_size)
    iterations = max(1, DECISIONS_PER_CALL // num_envs)

    def exchange(x: Any) -> Any:
        step = lambda x, _: (mean_over_devices(x + 1), None)  # noqa: E731
        return jax.lax.scan(step, x, length=EXCHANGES)[0]

    with joined(cluster) as us:
        config, learner = make_learner(engine=engine, num_envs=num_envs, dqn=dqn)
        gradients = jnp.zeros(len(ravel_pytree(learner.init(0).params)[0]) + 1)  # and the loss
        specs = {"in_specs": REPLICATED, "out_specs": REPLICATED}
        alone = jax.jit(on_each_device(exchange, learner.mesh, **specs))
        meet = lambda: us.gather(None)  # noqa: E731
        # An exchange waits for half a minute, and compiling may take longer.
        train = training_program(config, learner, iterations, ready=meet)
        calls = {"training": train, "exchange": lambda: jax.block_until_ready(alone(gradients))}
        calls["exchange"]()
        seconds = common.interleaved(calls, rounds, before=meet)
        return {
            "decisions_per_second": iterations * num_envs / statistics.median(seconds["training"]),
            "exchange_s": statistics.median(seconds["exchange"]) / EXCHANGES,
            "gradient_bytes": gradients.nbytes,
            "updates_per_decision": learner.spec.updates_per_iteration / num_envs,
        }


def run_of_processes(count: int, *args: Any) -> Row:
    """What the first of so many processes measures; `args` are those of `process_row`."""
    with socket.create_server(("", 0)) as server:
        address = f"localhost:{server.getsockname()[1]}"
    clusters = [Cluster(address, count, index) for index in range(count)]
    spawn = multiprocessing.get_context("spawn")
    with concurrent.futures.ProcessPoolExecutor(count, spawn) as pool:
        runs = [pool.submit(process_row, cluster, *args) for cluster in clusters]
        return runs[0].result()


def typical_runs(engine: str, args: argparse.Namespace) -> dict[str, Row]:
    """Scaling -> medians of its `--repeats` runs; scalings take turns."""
    runs: dict[str, list[Row]] = {scaling: [] for scaling in SCALINGS}
    for _ in range(args.repeats):
        for scaling, (count, envs, batches) in SCALINGS.items():
            common.log(f"measuring {engine}, {scaling} ...")
            num_envs = envs * args.num_envs[-1]
            runs[scaling].append(run_of_processes(count, engine, num_envs, batches, args.rounds))
    return {
        scaling: {name: statistics.median(run[name] for run in those) for name in those[0]}
        for scaling, those in runs.items()
    }


def predicted(row: Row, one: Row, count: int) -> float:
    """The efficiency if processes lost nothing but the time of their exchanges."""
    # While one alone takes a decision, each of them takes one.
    updates = count * row["updates_per_decision"]
    return 1 / (1 + updates * one["decisions_per_second"] * row["exchange_s"])


def processes(args: argparse.Namespace) -> None:
    """Table `processes`."""
    rows, one = [], {}
    for engine in args.engines:
        runs = typical_runs(engine, args)
        one = runs["one"]
        for scaling, (count, envs, _) in SCALINGS.items():
            typical, rate = runs[scaling], runs[scaling]["decisions_per_second"]
            row = {"engine": engine, "scaling": scaling, "processes": count}
            row |= {"envs": envs * args.num_envs[-1], "decisions/s": rate}
            row |= {"efficiency": rate / one["decisions_per_second"] / count}
            row |= {"predicted": predicted(typical, one, count) if count > 1 else None}
            rows.append(row | {"exchange": 1e6 * typical["exchange_s"] if count > 1 else None})
    forms = {"decisions/s": "{:,.0f}", "exchange": "{:.0f} us"}
    forms |= dict.fromkeys(("efficiency", "predicted"), "{:.2f}")
    note = (
        f"{common.machine()}, a core per process, preset default with "
        f"{one['updates_per_decision']:.3f} updates per decision (weak: half as many of twice "
        f"the size) of {one['gradient_bytes']:,.0f} bytes of gradients; medians of "
        f"{args.repeats} runs of {args.rounds} calls; efficiency against the one process, and what "
        "it would be if processes lost nothing but their exchanges."
    )
    common.report(args, "throughput processes", rows, note, forms)


def gymnasium_row(num_envs: int, rounds: int) -> Row:
    """The vector env and the peer."""
    import gymnasium

    import mjx_balance

    gymnasium.register_envs(mjx_balance)
    envs: Any = gymnasium.make_vec("mjx_balance/Balance-v0", num_envs=num_envs)
    decisions = max(16, 2 * DECISIONS_PER_CALL // num_envs)  # enough for some to fall
    actions = np.random.default_rng(0).integers(441, size=(decisions, num_envs))
    batch, peers = batch_peer(load_scene(preset("default")), num_envs)
    calls = {"make_vec": lambda: [envs.step(row) for row in actions], "batch": batch}
    seconds = common.interleaved(calls, rounds, before=lambda: envs.reset(seed=0))
    ours = [second / actions.size for second in seconds["make_vec"]]
    theirs = [second / peers for second in seconds["batch"]]
    rates = {"make_vec": 1 / statistics.median(ours), "Batch": 1 / statistics.median(theirs)}
    return {"envs": num_envs, **rates, "make_vec / Batch": common.ratio(theirs, ours)}


def gymnasium(args: argparse.Namespace) -> None:
    """Table `gymnasium`."""
    rows = [common.fresh(gymnasium_row, num_envs, args.rounds) for num_envs in args.num_envs]
    forms = {"make_vec": "{:,.0f}", "Batch": "{:,.0f}", "make_vec / Batch": "{:.2f}"}
    note = f"{common.machine()}; decisions per second, medians of {args.rounds} rounds."
    common.report(args, "throughput gymnasium", rows, note, forms)


TABLES = {x.__name__: x for x in (engines, seeds, processes, gymnasium)}


def main() -> None:
    """Measures one table."""
    parser = common.arguments(__doc__, TABLES)
    parser.add_argument("--engines", nargs="+", default=["mjx", "mujoco"])
    parser.add_argument(
        "--num-envs", type=int, nargs="+", default=[64, 256, 1024], help="the last in two tables"
    )
    parser.add_argument("--preset", default="default", help="of table engines")
    parser.add_argument("--seeds", type=int, nargs="+", default=[1, 4, 16, 64])
    parser.add_argument("--rounds", type=int, default=7)
    parser.add_argument("--repeats", type=int, default=3, help="runs of each row of processes")
    args = parser.parse_args()
    TABLES[args.table](args)


if __name__ == "__main__":
    main()
