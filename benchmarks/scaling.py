"""What do more processes bring, and what do their gradients cost?

Preset `default`'s whole training program, steady state, in processes of one core each, connected by
`jax.distributed` as on a cluster:
  weak     twice the processes step twice the boards;
  strong   they share the same boards;
and the exchange of one update's gradients alone, in the same processes.

    python benchmarks/scaling.py [--engines mujoco mjx] [--num-envs 512] [--write FILE]
"""

import argparse
import dataclasses
import json
import socket
import statistics
import subprocess
import sys
import time
from pathlib import Path
from typing import Any

from markers import publish, table
from throughput import compiled, hardware

DECISIONS_PER_CALL = 2_048
EXCHANGES = 500
NETWORKS_GBIT = (1, 25, 200)
"""Speeds of networks for the arithmetic."""
ROUND_TRIP_S = {1: 100e-6, 25: 30e-6, 200: 5e-6}
"""What a small message takes there and back (assumed: Ethernet, fast Ethernet, InfiniBand)."""


def child(place: Any, engine: Any, num_envs: int, rounds: int) -> None:
    """One process: the first prints seconds per decision of all boards and per exchange."""
    import jax
    import jax.numpy as jnp
    from jax.flatten_util import ravel_pytree

    from mjx_balance.config import preset
    from mjx_balance.dqn.devices import AXIS
    from mjx_balance.dqn.learner import REPLICATED
    from mjx_balance.env import BalanceEnv
    from mjx_balance.training import devices, processes

    with processes.joined(place, ()) as us:
        devices.configure_jax(print)
        config = dataclasses.replace(preset("default"), engine=engine, num_envs=num_envs)
        config = devices.size_to_device(config)
        learner = devices.make_learner(config, BalanceEnv(config))
        iterations = max(1, DECISIONS_PER_CALL // num_envs)
        state = learner.init(0)
        program, _ = compiled(learner.train_program(iterations), state)
        gradients = jnp.zeros(len(ravel_pytree(state.params)[0]) + 1)  # and the loss

        def exchange(x: jax.Array) -> jax.Array:
            step = lambda x, _: (jax.lax.pmean(x + 1, AXIS), None)  # noqa: E731
            return jax.lax.scan(step, x, length=EXCHANGES)[0]

        alone = jax.jit(
            jax.shard_map(
                exchange,
                mesh=learner.mesh,
                in_specs=REPLICATED,
                out_specs=REPLICATED,
                check_vma=False,
            )
        )
        jax.block_until_ready(alone(gradients))
        for _ in range(config.dqn.min_replay_size // (iterations * num_envs) + 2):
            state, _ = jax.block_until_ready(program(state))
        training, exchanging = [], []
        for _ in range(rounds):
            us.gather(None)
            began = time.perf_counter()
            state, _ = jax.block_until_ready(program(state))
            training.append((time.perf_counter() - began) / (iterations * num_envs))
            us.gather(None)
            began = time.perf_counter()
            jax.block_until_ready(alone(gradients))
            exchanging.append((time.perf_counter() - began) / EXCHANGES)
        if us.first:
            row = {
                "decisions_per_second": 1 / statistics.median(training),
                "exchange_s": statistics.median(exchanging),
                "gradient_bytes": gradients.nbytes,
                "updates_per_decision": learner.updates / num_envs,
                "devices": learner.num_devices,
            }
            print(json.dumps(row), flush=True)


def run(count: int, engine: str, num_envs: int, rounds: int) -> dict[str, Any]:
    """What the first of so many processes, each on a core of its own, says."""
    with socket.create_server(("", 0)) as server:
        address = f"localhost:{server.getsockname()[1]}"
    print(f"{engine}, {count} processes, {num_envs} boards ...", file=sys.stderr, flush=True)
    flags = f"--address {address} --count {count} --engines {engine} --num-envs {num_envs}".split()
    children = []
    for k in range(count):
        command = [sys.executable, __file__, *flags, "--child", str(k), "--rounds", str(rounds)]
        pinned = ["taskset", "-c", str(k), *command]
        children.append(subprocess.Popen(pinned, stdout=subprocess.PIPE, text=True))
    said = [process.communicate()[0] for process in children]
    if any(process.returncode for process in children):
        raise SystemExit(f"{engine}, {count} processes: one of them failed")
    return json.loads(next(x for x in said[0].splitlines() if x.startswith("{")))


def arithmetic(one: dict[str, Any]) -> list[str]:
    """Rows: of a network, what an exchange takes there and when it takes as long as the rest."""
    rows = []
    per_update = 1 / one["decisions_per_second"] / one["updates_per_decision"]
    for gbit in NETWORKS_GBIT:
        # A ring sends and receives about twice the gradients, whatever the number of hosts.
        exchange = ROUND_TRIP_S[gbit] + 2 * 8 * one["gradient_bytes"] / (gbit * 1e9)
        rows.append(
            [f"{gbit} Gbit/s", f"{1e6 * exchange:,.0f} us", f"{per_update / exchange:,.0f}"]
        )
    columns = ["network", "an exchange", "hosts at which it takes half of the time"]
    return table(columns, rows)


def main() -> None:
    """Measures and prints."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])  # pyright: ignore
    parser.add_argument("--engines", nargs="+", default=["mujoco", "mjx"])
    parser.add_argument("--num-envs", type=int, default=512, help="boards of one process")
    parser.add_argument("--rounds", type=int, default=9)
    parser.add_argument("--write", type=Path, help="Markdown file with markers")
    parser.add_argument("--child", type=int, help=argparse.SUPPRESS)
    parser.add_argument("--address", help=argparse.SUPPRESS)
    parser.add_argument("--count", type=int, help=argparse.SUPPRESS)
    args = parser.parse_args()
    if args.child is not None:
        from mjx_balance.quiet import quiet_imports

        with quiet_imports("torch", "warp"):
            from mjx_balance.training import processes
        place = processes.Place(args.address, args.child, args.count)
        child(place, args.engines[0], args.num_envs, args.rounds)
        return
    rows, one = [], {}
    for engine in args.engines:
        one = run(1, engine, args.num_envs, args.rounds)
        for kind, count, num_envs in (
            ("one", 1, args.num_envs),
            ("weak", 2, 2 * args.num_envs),
            ("strong", 2, args.num_envs),
        ):
            row = one if kind == "one" else run(count, engine, num_envs, args.rounds)
            gain = row["decisions_per_second"] / one["decisions_per_second"]
            rows.append(
                [
                    f"`{engine}`",
                    kind,
                    str(count),
                    str(num_envs),
                    f"{row['decisions_per_second']:,.0f}",
                    f"{gain / count:.2f}",
                    f"{1e6 * row['exchange_s']:.0f} us",
                ]
            )
    machine = hardware()
    columns = ["engine", "scaling", "processes", "boards", "decisions/s", "efficiency", "exchange"]
    note = (
        f"{machine['cpu']}, {machine['cores']} cores, a core per process, preset default with "
        f"{one['updates_per_decision']:.3f} updates per decision of {one['gradient_bytes']:,} "
        f"bytes of gradients; medians of {args.rounds} calls; efficiency against the one process."
    )
    publish("scaling", [*table(columns, rows), "", note, "", *arithmetic(one)], args.write)


if __name__ == "__main__":
    main()
