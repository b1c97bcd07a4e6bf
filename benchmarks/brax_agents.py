"""What do brax's PPO and SAC, with continuous actions, make of the time in which ours learns?

Every contender is a fresh process over MuJoCo's C engine; its clock runs while its compiled
program does. What it knows by then is judged off the clock, in plain MuJoCo, on held-out scenarios.
brax's hyperparameters are those of `examples/train_brax.py`; ours is preset `default`, which ends
by itself.

    python benchmarks/brax_agents.py [--contenders ours ppo sac] [--seconds 15 30 60]
"""

import argparse
import contextlib
import dataclasses
import itertools
import multiprocessing
import runpy
import statistics
import sys
import tempfile
import time
from collections.abc import Iterator, Sequence
from concurrent.futures import ProcessPoolExecutor
from pathlib import Path
from typing import Any, NamedTuple

from markers import publish, table
from throughput import hardware

from mjx_balance.config import preset
from mjx_balance.evaluation import rollout as evaluation
from mjx_balance.evaluation.controllers import Controller
from mjx_balance.evaluation.suites import HEADLINE, SEEDS
from mjx_balance.sim.scene import Scene

CONTENDERS = ("ours", "ppo", "sac")
EXAMPLE = Path(__file__).resolve().parent.parent / "examples" / "train_brax.py"
SCENARIOS, DURATION = 16, 60.0
EVERY, MOST = 2_048, 1_000
"""Decisions between two looks at the clock, and looks."""


class Mark(NamedTuple):
    """What a contender had done at one look at the clock."""

    decisions: int
    seconds: float
    """Of training, compiling left out."""


class Enough(Exception):
    """The time is up."""


def marks(looks: Sequence[tuple[int, float]]) -> tuple[float, list[Mark]]:
    """Tells compiling from training.

    Args:
      looks: decisions, and seconds since the start of training, after equal numbers of decisions;
        at least four. brax compiles in the first stretch, and once more in the second, whose
        arguments come from a program.

    Returns:
      Seconds of compiling: what two stretches took beyond twice the median of the others; and
      the marks without them.
    """
    times = [seconds for _, seconds in looks]
    usual = statistics.median(b - a for a, b in itertools.pairwise(times[1:]))
    compiling = times[1] - 2 * usual
    spent = [usual, *(seconds - compiling for seconds in times[1:])]
    return compiling, [Mark(*pair) for pair in zip((n for n, _ in looks), spent, strict=True)]


def reached(found: Sequence[Mark], seconds: float) -> Mark:
    """The first mark at which that time had passed, or the last."""
    return next((mark for mark in found if mark.seconds >= seconds), found[-1])


def judged(scene: Scene, acting: Controller) -> dict[str, Any]:
    """Mean tilt, deg, and falls by suite."""
    found = {}
    for suite in HEADLINE:
        rollout = evaluation.run_suite(scene, acting, suite, SCENARIOS, DURATION, SEEDS.held_out)
        found[suite] = {"mean": float(rollout.tilt.mean()), "falls": int(rollout.fell.sum())}
    return found


def brax_rows(name: str, budgets: Sequence[float], seed: int) -> Iterator[dict[str, Any]]:
    """Rows of "ppo" or "sac"."""
    import jax
    from brax.training.agents.sac import checkpoint

    example = runpy.run_path(str(EXAMPLE))
    env = example["make_env"]("mujoco")
    looks: list[tuple[int, float]] = []
    kept: dict[int, Any] = {}

    def keep(decisions: int, make_policy: Any, params: Any) -> None:
        kept[decisions] = make_policy(jax.device_get(params), deterministic=True)

    def look(decisions: int, metrics: dict[str, Any]) -> None:
        if "training/walltime" in metrics:
            looks.append((decisions, float(metrics["training/walltime"])))
        if len(looks) > 4 and marks(looks)[1][-1].seconds >= max(budgets):
            raise Enough

    with tempfile.TemporaryDirectory() as folder:
        # SAC shows its parameters in files alone; those of PPO, brax 0.14 cannot read back.
        show = {"ppo": {"policy_params_fn": keep}, "sac": {"checkpoint_logdir": folder}}[name]
        more = show | {"num_evals": MOST + 1, "progress_fn": look}
        with contextlib.suppress(Enough):
            example["train"](name, env, MOST * EVERY, seed, **more)
        compiling, found = marks(looks)
        for budget in budgets:
            mark = reached(found, budget)
            path = Path(folder) / f"{mark.decisions:012d}"
            policy = kept.get(mark.decisions) or checkpoint.load_policy(str(path))
            acting = example["controller"](env, policy)
            yield row(name, budget, compiling, mark, judged(env.scene, acting))


def our_rows(name: str, budgets: Sequence[float], seed: int) -> Iterator[dict[str, Any]]:
    """Rows of preset `default`."""
    import jax

    from mjx_balance.envs.balance import BalanceEnv
    from mjx_balance.policy.file import save_policy
    from mjx_balance.policy.manifest import make_manifest
    from mjx_balance.sim.engines.mujoco import cores
    from mjx_balance.training.sizing import make_learner, size_to_device

    jax.config.update("jax_num_cpu_devices", cores())
    config = dataclasses.replace(preset("default"), engine="mujoco", seed=seed)
    config = size_to_device(config)
    env = BalanceEnv(config)
    learner = make_learner(config, env)
    calls = config.num_env_steps // config.log_every
    state = learner.init(seed)
    program: Any = learner.train_program(config.log_every // learner.num_envs)
    began = time.perf_counter()
    run = program.lower(state).compile()
    compiling, spent = time.perf_counter() - began, 0.0
    found, exported = [], []
    for k in range(calls):
        began = time.perf_counter()
        state, _ = jax.block_until_ready(run(state))
        spent += time.perf_counter() - began
        found.append(Mark((k + 1) * config.log_every, spent))
        exported.append(jax.device_get(learner.exported(state)))
    for budget in budgets:
        mark = reached(found, budget)
        with tempfile.TemporaryDirectory() as folder:
            params = exported[found.index(mark)]
            manifest = make_manifest(config, env.scene.hash, {})
            policy = save_policy(Path(folder) / "policy.safetensors", params, manifest)
        acting = evaluation.observing(policy)
        yield row(name, budget, compiling, mark, judged(env.scene, acting))
        if mark == found[-1]:
            return


def row(
    name: str, budget: float, compiling: float, mark: Mark, result: dict[str, Any]
) -> dict[str, Any]:
    """One row."""
    return {
        "contender": name,
        "budget": budget,
        "compiling": compiling,
        **mark._asdict(),
        **result,
    }


def rows_of(name: str, budgets: Sequence[float], seed: int) -> list[dict[str, Any]]:
    """All rows of a contender; runs in a process of its own."""
    make = our_rows if name == "ours" else brax_rows
    return list(make(name, budgets, seed))


def lines_of(rows: Sequence[dict[str, Any]], seed: int, machine: dict[str, Any]) -> list[str]:
    """The table, and what it needs to be read."""
    cells = [
        [
            f"`{row['contender']}`",
            f"{row['seconds']:.0f}",
            f"{row['decisions']:,}",
            *(f"{row[suite]['mean']:.3f} ({row[suite]['falls']})" for suite in HEADLINE),
            f"{row['compiling']:.0f} s",
        ]
        for row in rows
    ]
    suites = [f"`{suite}`, deg (falls)" for suite in HEADLINE]
    columns = ["contender", "seconds of training", "decisions", *suites, "compiling"]
    note = (
        f"Seed {seed}, {SCENARIOS} held-out scenarios of {DURATION:g} s per suite; "
        f"{machine['cpu']}, {machine['cores']} cores."
    )
    return [*table(columns, cells), "", note]


def main() -> None:
    """Runs the contenders and prints the table."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])  # pyright: ignore
    parser.add_argument("--contenders", nargs="+", default=CONTENDERS, choices=CONTENDERS)
    parser.add_argument("--seconds", type=float, nargs="+", default=[15.0, 30.0, 60.0])
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--write", type=Path, help="Markdown file with markers")
    args = parser.parse_args()
    rows: list[dict[str, Any]] = []
    context = multiprocessing.get_context("spawn")
    with ProcessPoolExecutor(1, context, max_tasks_per_child=1) as fresh:
        for name in dict.fromkeys(args.contenders):
            rows += fresh.submit(rows_of, name, sorted(args.seconds), args.seed).result()
            print("\n".join(lines_of(rows, args.seed, hardware())), file=sys.stderr)
    publish("brax_agents", lines_of(rows, args.seed, hardware()), args.write)


if __name__ == "__main__":
    main()
