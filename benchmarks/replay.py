"""Is the replay buffer as fast as those of others?

Adds one decision of all envs and samples batches, in a jitted scan with the buffer donated, as in
training, but on one device: `mjx_balance.dqn.replay` against flashbax's item and flat buffers and
brax's UniformSamplingQueue. Filling: the buffer begins with one decision in it; full: every
decision overwrites another.

    python benchmarks/replay.py [--rounds 7] [--json FILE] [--write benchmarks/README.md]
"""

import functools
import importlib.util
import itertools
import statistics
from collections.abc import Callable
from typing import Any, NamedTuple

import common
import jax
import jax.numpy as jnp
from common import Row

from mjx_balance.dqn import replay
from mjx_balance.dqn.replay import Transition
from mjx_balance.quiet import quiet_imports

CAPACITY, BATCH = 131_072, 512
OBS_SIZES, NUM_ENVS = (34, 136), (256, 1024)
SAMPLES = 32
"""After each add, as in training."""
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


def measure(obs_size: int, num_envs: int, rounds: int) -> list[Row]:
    """Two rows, us of all contenders while they fill, and full."""
    make = functools.partial(decision, obs_size, num_envs)
    key, contenders = jax.random.PRNGKey(0), buffers(obs_size, num_envs)
    states = {name: buffer.init() for name, buffer in contenders.items()}
    runs = {name: program(buffer, make, ADDS, SAMPLES) for name, buffer in contenders.items()}

    def call(name: str) -> None:
        states[name], _ = jax.block_until_ready(runs[name](states[name], key))

    calls, rows = {name: functools.partial(call, name) for name in runs}, []
    for phase in ("filling", "full"):
        for name, buffer in contenders.items() if phase == "full" else ():
            fill = program(buffer, make, CAPACITY // num_envs, 0)
            states[name], _ = fill(states[name], key)
        # The first round compiles. Who comes after brax, which moves all its rows, finds cold
        # caches: the order changes.
        seconds = {
            name: [second / ADDS for second in those[1:]]
            for name, those in common.interleaved(calls, 1 + rounds).items()
        }
        medians = {name: statistics.median(those) for name, those in seconds.items()}
        best = min(medians.keys() - {"ours"}, key=lambda name: medians[name])
        row = {"inputs": obs_size, "envs": num_envs, "buffer": phase}
        row |= {name: 1e6 * median for name, median in medians.items()}
        rows.append(row | {"ours / best other": common.ratio(seconds[best], seconds["ours"])})
    return rows


def main() -> None:
    """Measures every row and prints the table."""
    parser = common.arguments(__doc__)
    parser.add_argument("--rounds", type=int, default=MOST_ROUNDS, help="at most the default")
    args = parser.parse_args()
    if not 1 <= args.rounds <= MOST_ROUNDS:
        parser.error(f"--rounds is {args.rounds}; it must be 1 to {MOST_ROUNDS}")
    if importlib.util.find_spec("flashbax") is None:
        parser.error("flashbax is not installed: pip install -e '.[benchmarks]'")
    rows = []
    for obs_size, num_envs in itertools.product(OBS_SIZES, NUM_ENVS):
        common.log(f"measuring {obs_size} inputs, {num_envs} envs ...")
        rows += measure(obs_size, num_envs, args.rounds)
    times = dict.fromkeys(list(rows[0])[3:-1], "{:,.0f}")
    note = (
        f"Microseconds for one add and {SAMPLES} samples of {BATCH}, {CAPACITY:,} rows; ratio of "
        f"rates; medians of {args.rounds} rounds; {common.machine()}."
    )
    common.report(args, "replay", rows, note, times | {"ours / best other": "{:.2f}"})


if __name__ == "__main__":
    main()
