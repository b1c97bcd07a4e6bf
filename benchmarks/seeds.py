"""What do many runs in one program cost, against one run of as many boards?

Preset `default`'s whole training program with `--num-seeds` 1, 4, 16 and 64: the boards of all
seeds together stay the same, and so do the updates. Each row is a process of its own.

    python benchmarks/seeds.py [--engines mjx mujoco] [--num-envs 1024] [--write FILE]
"""

import argparse
import dataclasses
import itertools
import json
import statistics
import subprocess
import sys
from pathlib import Path
from typing import Any

from markers import publish, table
from throughput import DECISIONS_PER_CALL, compiled, hardware, timed


def measure(engine: Any, num_seeds: int, num_envs: int, rounds: int) -> dict[str, Any]:
    """Decisions per second over all seeds, `num_envs` boards in all, in this process."""
    from mjx_balance.quiet import quiet_imports

    with quiet_imports("torch", "warp"):
        import jax

        from mjx_balance.envs.balance import BalanceEnv
        from mjx_balance.training import sizing
    from mjx_balance.config import preset

    sizing.configure_jax(print)
    jax.config.update("jax_enable_compilation_cache", False)  # to time the compilation
    config = dataclasses.replace(
        preset("default"), engine=engine, num_envs=num_envs // num_seeds, num_seeds=num_seeds
    )
    config = sizing.size_to_device(config)
    learner = sizing.make_learner(config, BalanceEnv(config))
    iterations = max(1, DECISIONS_PER_CALL // num_envs)
    state = learner.init(0)
    program, compile_s = compiled(learner.train_program(iterations), state)
    for _ in range(config.dqn.min_replay_size * num_seeds // (iterations * num_envs) + 2):
        state, _ = jax.block_until_ready(program(state))
    seconds = []
    for _ in range(rounds):
        took, (state, _) = timed(lambda s=state: program(s))
        seconds.append(took)
    rate = iterations * num_envs / statistics.median(seconds)
    return {"decisions_per_second": rate, "compile_s": compile_s}


def main() -> None:
    """Measures every row and prints the table."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])  # pyright: ignore
    parser.add_argument("--engines", nargs="+", default=["mjx", "mujoco"])
    parser.add_argument("--seeds", type=int, nargs="+", default=[1, 4, 16, 64])
    parser.add_argument("--num-envs", type=int, default=1_024, help="boards of all seeds")
    parser.add_argument("--rounds", type=int, default=7)
    parser.add_argument("--write", type=Path, help="Markdown file with markers")
    parser.add_argument("--row", action="store_true", help=argparse.SUPPRESS)
    args = parser.parse_args()
    if args.row:
        row = measure(args.engines[0], args.seeds[0], args.num_envs, args.rounds)
        print(json.dumps(row))
        return
    rows, one = [], {}
    for engine, num_seeds in itertools.product(args.engines, args.seeds):
        print(f"measuring {engine}, {num_seeds} seeds ...", file=sys.stderr, flush=True)
        flags = f"--row --engines {engine} --seeds {num_seeds} --num-envs {args.num_envs}"
        command = [sys.executable, __file__, *flags.split(), "--rounds", str(args.rounds)]
        done = subprocess.run(command, stdout=subprocess.PIPE, text=True, check=True)
        row = json.loads(done.stdout.splitlines()[-1])
        rate = row["decisions_per_second"]
        one.setdefault(engine, rate)
        rows.append(
            [
                f"`{engine}`",
                str(num_seeds),
                str(args.num_envs // num_seeds),
                f"{rate:,.0f}",
                f"{rate / one[engine]:.2f}",
                f"{row['compile_s']:.0f} s",
            ]
        )
    machine = hardware()
    columns = ["engine", "seeds", "boards of each", "decisions/s", "over the first", "compiling"]
    note = f"{machine['cpu']}, {machine['cores']} cores; medians of {args.rounds} calls."
    publish("seeds", [*table(columns, rows), "", note], args.write)


if __name__ == "__main__":
    main()
