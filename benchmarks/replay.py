"""Is the replay buffer as fast as those of others?

Adds one decision of all envs and samples batches, in a jitted scan with the buffer donated, as
in training, but on one device: `mjx_balance.dqn.replay` against flashbax's item and flat buffers
and brax's UniformSamplingQueue, interleaved in one process. Filling: the buffer begins with one
decision in it; full: every decision overwrites another. Compile time stands apart.

    python benchmarks/replay.py [--rounds 7] [--json FILE] [--write benchmarks/README.md]
"""

import argparse
import functools
import importlib.util
import itertools
import json
import random
import statistics
import sys
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
from markers import publish, table
from throughput import hardware

from mjx_balance.dqn import replay
from mjx_balance.dqn.replay import Transition
from mjx_balance.quiet import quiet_imports

CAPACITY, BATCH = 131_072, 512
OBS_SIZES, NUM_ENVS = (34, 136), (256, 1024)
SAMPLES = (32, 1)
"""After each add; 32 as in training."""
ADDS = 8
"""Per call."""
MOST_ROUNDS = CAPACITY // (ADDS * max(NUM_ENVS)) - 1
"""As many calls, and a first to warm up, just fill the buffer."""


class Buffer(NamedTuple):
    """One implementation; every function is pure and takes its own kind of state."""

    init: Callable[[], Any]
    add: Callable[[Any, Transition], Any]
    sample: Callable[[Any, jax.Array], tuple[Any, Transition]]
    """(state, key) -> (state, BATCH transitions)."""


def buffers(obs_size: int, num_envs: int) -> dict[str, Buffer]:
    """The contenders, for transitions of one size."""
    with quiet_imports():
        import flashbax  # pyright: ignore[reportMissingImports]
        from brax.training.replay_buffers import UniformSamplingQueue

    obs, scalar = jnp.zeros(obs_size), jnp.float32(0)
    example = Transition(obs, jnp.int32(0), scalar, scalar, obs)
    item = flashbax.make_item_buffer(CAPACITY, num_envs, BATCH, add_batches=True)
    flat = flashbax.make_flat_buffer(CAPACITY, num_envs, BATCH, add_batch_size=num_envs)
    queue = UniformSamplingQueue(CAPACITY, example, BATCH)
    # The flat buffer finds the next observation in the next row, whether a reset lies between
    # or not, so that it need not be stored.
    nothing = jnp.zeros((num_envs, 0))

    def next_row(state: Any, key: jax.Array) -> tuple[Any, Transition]:
        pair = flat.sample(state, key).experience
        return state, pair.first._replace(next_obs=pair.second.obs)

    return {
        "ours": Buffer(
            lambda: replay.init(example, CAPACITY, num_envs),
            # Whether to store is known only when the program runs, as in training.
            lambda state, batch: replay.add(state, batch, jnp.isfinite(batch.reward).all()),
            lambda state, key: (state, replay.sample(state, key, BATCH)),
        ),
        "flashbax item": Buffer(
            lambda: item.init(example),
            item.add,
            lambda state, key: (state, item.sample(state, key).experience),
        ),
        "flashbax flat": Buffer(
            lambda: flat.init(example._replace(next_obs=nothing[0])),
            lambda state, batch: flat.add(state, batch._replace(next_obs=nothing)),
            next_row,
        ),
        "brax": Buffer(
            lambda: queue.init(jax.random.PRNGKey(0)),
            queue.insert_internal,
            lambda state, _: queue.sample_internal(state),
        ),
    }


def decision(obs_size: int, num_envs: int, number: jax.Array) -> Transition:
    """What all envs hand over after decision `number`; no two rows are the same."""
    mark = num_envs * number + jnp.arange(num_envs)
    obs = mark[:, None] + jnp.zeros(obs_size)
    return Transition(obs, mark, mark + 0.5, mark % 2.0, obs + 1)


def program(buffer: Buffer, make: Callable[[jax.Array], Transition], adds: int, samples: int):
    """Jitted (state, key) -> (state, the last batch); the state is donated."""

    def draw(carry: tuple[Any, Transition], key: jax.Array) -> tuple[Any, None]:
        # The batch is carried, so that every one is written to memory, as a network needs it:
        # a mere sum would be computed on the way and none would.
        return buffer.sample(carry[0], key), None

    def step(carry: tuple[Any, Transition], step: Any) -> tuple[Any, None]:
        number, key = step
        state = buffer.add(carry[0], make(number))
        return jax.lax.scan(draw, (state, carry[1]), jax.random.split(key, samples))

    def run(state: Any, key: jax.Array) -> tuple[Any, Transition]:
        batch = jax.tree.map(jnp.zeros_like, jax.eval_shape(buffer.sample, state, key)[1])
        steps = jnp.arange(adds), jax.random.split(key, adds)
        carry, _ = jax.lax.scan(step, (state, batch), steps)
        return carry

    return jax.jit(run, donate_argnums=0)


def measure(obs_size: int, num_envs: int, samples: int, rounds: int) -> list[dict[str, Any]]:
    """Two rows: all contenders while they fill, and full."""
    make = functools.partial(decision, obs_size, num_envs)
    key = jax.random.PRNGKey(0)
    contenders = buffers(obs_size, num_envs)
    compiled, states, compile_s = {}, {}, {}
    for name, buffer in contenders.items():
        states[name] = buffer.init()
        began = time.perf_counter()
        run = program(buffer, make, ADDS, samples)
        compiled[name] = run.lower(states[name], key).compile()
        compile_s[name] = time.perf_counter() - began
    rows = []
    for phase in ("filling", "full"):
        if phase == "full":
            for name, buffer in contenders.items():
                fill = program(buffer, make, CAPACITY // num_envs, 0)
                states[name], _ = fill(states[name], key)
        seconds: dict[str, list[float]] = {name: [] for name in compiled}
        for k in range(1 + rounds):
            # In any order: who comes after brax, which moves all of its rows, finds cold caches.
            for name in random.Random(k).sample(list(compiled), len(compiled)):
                key_k = jax.random.PRNGKey(k)
                began = time.perf_counter()
                states[name], _ = jax.block_until_ready(compiled[name](states[name], key_k))
                if k:  # the first is a warm-up
                    seconds[name].append((time.perf_counter() - began) / ADDS)
        medians = {name: statistics.median(values) for name, values in seconds.items()}
        best = min(medians.keys() - {"ours"}, key=lambda name: medians[name])
        each_round = zip(seconds[best], seconds["ours"], strict=True)
        rows.append(
            {
                "obs_size": obs_size,
                "num_envs": num_envs,
                "samples_per_add": samples,
                "buffer": phase,
                "microseconds": {name: 1e6 * s for name, s in medians.items()},
                "compile_s": compile_s,
                "best_other": best,
                "ours_over_best_other": statistics.median(a / b for a, b in each_round),
            }
        )
    return rows


def main() -> int:
    """Measures every row and prints the table."""
    parser = argparse.ArgumentParser()
    parser.add_argument("--rounds", type=int, default=MOST_ROUNDS, help="at most the default")
    parser.add_argument("--json", type=Path, help="file to write the figures to")
    parser.add_argument("--write", type=Path, help="Markdown file with markers")
    args = parser.parse_args()
    if not 1 <= args.rounds <= MOST_ROUNDS:
        print(f"--rounds is {args.rounds}; it must be 1 to {MOST_ROUNDS}", file=sys.stderr)
        return 2
    if importlib.util.find_spec("flashbax") is None:
        print("flashbax is not installed: pip install -e '.[benchmarks]'", file=sys.stderr)
        return 2
    rows = []
    for shape in itertools.product(OBS_SIZES, NUM_ENVS, SAMPLES):
        print("measuring {} inputs, {} envs, {}:1 ...".format(*shape), file=sys.stderr, flush=True)
        rows += measure(*shape, args.rounds)
        if args.json:
            args.json.write_text(
                json.dumps({"hardware": hardware(), "rows": rows}, indent=2) + "\n"
            )
    names = list(rows[0]["microseconds"])
    lines = [
        [
            *(str(row[key]) for key in ("obs_size", "num_envs", "samples_per_add", "buffer")),
            *(f"{row['microseconds'][name]:,.0f}" for name in names),
            f"{row['ours_over_best_other']:.2f}",
        ]
        for row in rows
    ]
    columns = ["inputs", "envs", "samples per add", "buffer", *names, "ours / best other"]
    machine = hardware()
    compiles = ", ".join(f"{name} {rows[0]['compile_s'][name]:.2f} s" for name in names)
    note = (
        f"Microseconds for one add and its samples of {BATCH}, {CAPACITY:,} rows; ratio of rates; "
        f"medians of {args.rounds} rounds on {machine['cpu']}, {machine['cores']} cores, "
        f"{jax.devices()[0].device_kind}. Compiling the first row: {compiles}."
    )
    publish("replay", [*table(columns, lines), "", note], args.write)
    return 0


if __name__ == "__main__":
    sys.exit(main())
