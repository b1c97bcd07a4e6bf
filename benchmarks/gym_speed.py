"""What do Gymnasium's envs cost beyond the physics?

The vector env takes random actions, and starts robots that fall again; then `mujoco.batch.Batch`
steps the same scene through the same servo targets, from and to the same states, to the last bit.

    python benchmarks/gym_speed.py [--num-envs 1 64 256 1024] [--write benchmarks/README.md]
"""

import argparse
import statistics
import time
from pathlib import Path
from typing import Any

import gymnasium
import numpy as np
from markers import publish, table
from mujoco.batch import Batch
from throughput import hardware

import mjx_balance
from mjx_balance.sim.engines.mujoco import cores

DECISIONS = 4096
"""Of all boards together, in a round."""
LEAST = 16
"""Of each board: enough for some to fall."""


def timed(envs: Any, actions: np.ndarray) -> float:
    """Seconds of the decisions `actions` (d, n)."""
    envs.reset(seed=0)
    began = time.perf_counter()
    for row in actions:
        envs.step(row)
    return time.perf_counter() - began


def recorded(envs: Any, actions: np.ndarray) -> tuple[list[np.ndarray], list[np.ndarray]]:
    """Servo targets (n, sim_steps, nu) of each decision, and whose episode (n,) it ends."""
    engine, targets, ended = envs.boards._engine, [], []
    advance = engine.advance
    engine.advance = lambda ids, ctrl: targets.append(ctrl) or advance(ids, ctrl)
    envs.reset(seed=0)
    for row in actions:
        _, _, fell, late, _ = envs.step(row)
        ended.append(fell | late)
    engine.advance = advance
    return targets, ended


def replayed(batch: Batch, scene: Any, targets: list[np.ndarray], ended: list[np.ndarray]) -> float:
    """Seconds that the batch takes for the same."""
    stance = scene.stance
    batch.qpos, batch.qvel, batch.qacc_warmstart = stance.qpos, stance.qvel, stance.qacc_warmstart
    began = time.perf_counter()
    for ctrl, over in zip(targets, ended, strict=True):
        batch.rollout(ctrl.shape[1], ctrl, record=("qpos", "sensordata"))
        batch.qpos[over], batch.qvel[over] = stance.qpos, stance.qvel
        batch.qacc_warmstart[over] = stance.qacc_warmstart
    return time.perf_counter() - began


def measure(num_envs: int, rounds: int) -> list[str]:
    """A row of the table."""
    envs: Any = gymnasium.make_vec("mjx_balance/Balance-v0", num_envs=num_envs)
    scene, decisions = envs.boards.scene, max(LEAST, DECISIONS // num_envs)
    actions = np.random.default_rng(0).integers(441, size=(decisions, num_envs))
    targets, ended = recorded(envs, actions)
    batch = Batch(scene.model, num_envs, cores())
    seconds = []
    for _ in range(rounds):
        ours = timed(envs, actions)
        seconds.append((ours, replayed(batch, scene, targets, ended)))
        assert np.array_equal(batch.qpos, envs.boards.qpos), "not the same physics"
    ours, theirs = (statistics.median(column) for column in zip(*seconds, strict=True))
    ratio = statistics.median(theirs / ours for ours, theirs in seconds)
    made = decisions * num_envs
    rates = (f"{made / ours:,.0f}", f"{made / theirs:,.0f}")
    return [str(num_envs), *rates, f"{ratio:.2f}", f"{np.sum(ended):,} of {made:,}"]


def main() -> None:
    """Measures every row and prints the table."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])  # pyright: ignore
    parser.add_argument("--num-envs", type=int, nargs="+", default=[1, 16, 64, 256, 1024])
    parser.add_argument("--rounds", type=int, default=9)
    parser.add_argument("--write", type=Path, help="Markdown file with markers")
    args = parser.parse_args()
    gymnasium.register_envs(mjx_balance)
    columns = ["envs", "make_vec", "Batch", "make_vec / Batch", "decisions that end an episode"]
    rows = [measure(num_envs, args.rounds) for num_envs in args.num_envs]
    machine = hardware()
    note = (
        f"{machine['cpu']}, {machine['cores']} cores; decisions per second, medians of "
        f"{args.rounds} interleaved rounds, gymnasium {gymnasium.__version__}."
    )
    publish("gym_speed", [*table(columns, rows), "", note], args.write)


if __name__ == "__main__":
    main()
