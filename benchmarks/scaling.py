"""What do more processes bring, and what do their gradients cost?

Preset `default`'s whole training program, steady state, in processes of one core each, connected by
`jax.distributed` as on a cluster:
  weak               twice the processes step twice the boards and learn from batches of twice
                     the size: each has the work that one has alone;
  weak, batch kept   they step twice the boards and make twice the updates;
  strong             they share the same boards and batches;
and the exchange of one update's gradients alone, in the same processes. Runs take turns; what is
said of a kind is the median of its runs.

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
MESSAGE_S = {1: 50e-6, 25: 15e-6, 200: 3e-6}
"""What a small message takes there (assumed: Ethernet, fast Ethernet, InfiniBand)."""
KINDS = {  # processes, boards and batches over those of one
    "one": (1, 1, 1),
    "weak": (2, 2, 2),
    "weak, batch kept": (2, 2, 1),
    "strong": (2, 1, 1),
}


def child(place: Any, engine: Any, num_envs: int, batches: int, rounds: int) -> None:
    """One process: the first prints seconds per decision of all boards and per exchange."""
    import jax
    import jax.numpy as jnp
    from jax.flatten_util import ravel_pytree

    from mjx_balance.config import preset
    from mjx_balance.dqn.devices import mean_over_devices, on_each_device
    from mjx_balance.dqn.learner import REPLICATED
    from mjx_balance.envs.balance import BalanceEnv
    from mjx_balance.training import processes, sizing

    with processes.joined(place, ()) as us:
        sizing.configure_jax(print)
        config = preset("default")
        dqn = dataclasses.replace(config.dqn, batch_size=batches * config.dqn.batch_size)
        config = dataclasses.replace(config, engine=engine, num_envs=num_envs, dqn=dqn)
        config = sizing.size_to_device(config)
        learner = sizing.make_learner(config, BalanceEnv(config))
        iterations = max(1, DECISIONS_PER_CALL // num_envs)
        state = learner.init(0)
        program, _ = compiled(learner.train_program(iterations), state)
        gradients = jnp.zeros(len(ravel_pytree(state.params)[0]) + 1)  # and the loss

        def exchange(x: jax.Array) -> jax.Array:
            step = lambda x, _: (mean_over_devices(x + 1), None)  # noqa: E731
            return jax.lax.scan(step, x, length=EXCHANGES)[0]

        alone = jax.jit(
            on_each_device(exchange, learner.mesh, in_specs=REPLICATED, out_specs=REPLICATED)
        )
        us.gather(None)  # the first exchange waits half a minute, and compiling may take longer
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


def run(count: int, engine: str, num_envs: int, batches: int, rounds: int) -> dict[str, Any]:
    """What the first of so many processes, each on a core of its own, says."""
    with socket.create_server(("", 0)) as server:
        address = f"localhost:{server.getsockname()[1]}"
    print(f"{engine}, {count} processes, {num_envs} boards ...", file=sys.stderr, flush=True)
    flags = f"--address {address} --count {count} --engines {engine} --num-envs {num_envs}".split()
    flags += ["--batches", str(batches)]
    children = []
    for k in range(count):
        command = [sys.executable, __file__, *flags, "--child", str(k), "--rounds", str(rounds)]
        pinned = ["taskset", "-c", str(k), *command]
        children.append(subprocess.Popen(pinned, stdout=subprocess.PIPE, text=True))
    said = [process.communicate()[0] for process in children]
    if any(process.returncode for process in children):
        raise SystemExit(f"{engine}, {count} processes: one of them failed")
    row = json.loads(next(x for x in said[0].splitlines() if x.startswith("{")))
    print(f"  {row}", file=sys.stderr, flush=True)
    return row


def predicted(row: dict[str, Any], one: dict[str, Any], kind: str) -> float:
    """The efficiency, if more processes lost nothing but the time of their exchanges."""
    # While one alone takes a decision, each of them takes one.
    updates = KINDS[kind][0] * row["updates_per_decision"]
    return 1 / (1 + updates * one["decisions_per_second"] * row["exchange_s"])


def arithmetic(one: dict[str, Any]) -> list[str]:
    """Rows: of a network, what exchanges take there, and with how many hosts half of the time."""
    rows, per_update = [], 1 / one["decisions_per_second"] / one["updates_per_decision"]
    for gbit in NETWORKS_GBIT:
        # All to all in a ring: with n hosts, n - 1 steps in which each sends one host's gradients.
        step = MESSAGE_S[gbit] + 8 * one["gradient_bytes"] / (gbit * 1e9)
        grown, kept = 1 + per_update / step, 0.5 + (0.25 + per_update / step) ** 0.5
        cells = [f"{1e6 * n * step:,.0f} us" for n in (1, 7, 63)]
        rows.append([f"{gbit} Gbit/s", *cells, f"{grown:,.0f}", f"{kept:,.0f}"])
    columns = ["network", "2 hosts", "8 hosts", "64 hosts", "bound at, weak", "at, batch kept"]
    return table(columns, rows)


def main() -> None:
    """Measures and prints."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])  # pyright: ignore
    parser.add_argument("--engines", nargs="+", default=["mujoco", "mjx"])
    parser.add_argument("--num-envs", type=int, default=512, help="boards of one process")
    parser.add_argument("--rounds", type=int, default=9, help="calls of a run")
    parser.add_argument("--repeats", type=int, default=3, help="runs of each kind")
    parser.add_argument("--write", type=Path, help="Markdown file with markers")
    parser.add_argument("--child", type=int, help=argparse.SUPPRESS)
    parser.add_argument("--address", help=argparse.SUPPRESS)
    parser.add_argument("--batches", type=int, help=argparse.SUPPRESS)
    parser.add_argument("--count", type=int, help=argparse.SUPPRESS)
    args = parser.parse_args()
    if args.child is not None:
        from mjx_balance.quiet import quiet_imports

        with quiet_imports("torch", "warp"):
            from mjx_balance.training import processes
        place = processes.Place(args.address, args.child, args.count)
        child(place, args.engines[0], args.num_envs, args.batches, args.rounds)
        return
    rows, fastest = [], {}
    for engine in args.engines:
        found: dict[str, list[dict[str, Any]]] = {kind: [] for kind in KINDS}
        for _ in range(args.repeats):
            for kind, (count, boards, batches) in KINDS.items():
                row = run(count, engine, boards * args.num_envs, batches, args.rounds)
                found[kind].append(row)
        median = {kind: typical(those) for kind, those in found.items()}
        one = median["one"]
        fastest = max((fastest, one), key=lambda row: row.get("decisions_per_second", 0))
        for kind, row in median.items():
            count, boards, _ = KINDS[kind]
            gain = row["decisions_per_second"] / one["decisions_per_second"]
            cells = [f"`{engine}`", kind, str(count), str(boards * args.num_envs)]
            cells += [f"{row['decisions_per_second']:,.0f}", f"{gain / count:.2f}"]
            cells += ["-", "-"]
            if count > 1:
                cells[-2:] = [
                    f"{predicted(row, one, kind):.2f}",
                    f"{1e6 * row['exchange_s']:.0f} us",
                ]
            rows.append(cells)
    machine = hardware()
    columns = "engine scaling processes boards decisions/s efficiency predicted exchange".split()
    note = (
        f"{machine['cpu']}, {machine['cores']} cores, a core per process, preset default with "
        f"{fastest['updates_per_decision']:.3f} updates per decision (weak: half as many of twice "
        f"the size) of {fastest['gradient_bytes']:,.0f} bytes of gradients; medians of "
        f"{args.repeats} runs of {args.rounds} calls; efficiency against the one process, and what "
        "it would be if processes lost nothing but their exchanges."
    )
    publish("scaling", [*table(columns, rows), "", note, "", *arithmetic(fastest)], args.write)


def typical(rows: list[dict[str, Any]]) -> dict[str, Any]:
    """Medians of every number."""
    return {name: statistics.median(row[name] for row in rows) for name in rows[0]}


if __name__ == "__main__":
    main()
