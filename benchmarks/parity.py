"""Do the engines agree? One policy, the same scenarios, in each of them.

Closed loop over whole periods of the board: the policy sees what its own robot's IMU says, in the
training env over engines `mjx` and `mujoco` and in the evaluation's plain MuJoCo. Open loop: the
actions of the evaluation are repeated in both, and the IMU samples compared one by one. Sensor
noise is left out, as engines could not be given the same.

    python benchmarks/parity.py policies/best.safetensors [--scenarios 64] [--periods 3]
"""

import argparse
import dataclasses
from pathlib import Path
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from markers import publish, table

from mjx_balance import load_policy
from mjx_balance.config import RandomizationConfig
from mjx_balance.envs.balance import BalanceEnv
from mjx_balance.evaluation.controllers import View
from mjx_balance.evaluation.rollout import policy_scene, roll_out
from mjx_balance.evaluation.suites import SEEDS, make_scenarios
from mjx_balance.policy.file import Policy
from mjx_balance.task.randomization import Conditions
from mjx_balance.task.tilt import Scenario

ENGINES = ("mjx", "mujoco")
CIRCUMSTANCES = ("paper", "corner", "payload", "friction", "gains", "latency")


class Course(NamedTuple):
    """What happened in n scenarios."""

    tilt: np.ndarray
    """(decisions, n) mean of each decision, deg."""
    imu: np.ndarray
    """(decisions, n, sim_steps, 6) samples of each decision."""
    action: np.ndarray
    """(decisions, n)"""


def evaluated(
    policy: Policy, drawn: Scenario, conditions: Conditions, duration: float
) -> tuple[Course, bool]:
    """The course of the evaluation, and whether a robot fell."""
    imu, actions = [], []

    def act(view: View) -> np.ndarray:
        imu.append(view.imu)
        actions.append(policy(view.obs))
        return actions[-1]

    rollout = roll_out(policy_scene(policy), act, drawn, duration, conditions=conditions)
    n, decisions = rollout.action_mm.shape
    tilt = rollout.tilt.reshape(n, decisions, -1).mean(axis=-1).T
    if rollout.fell.any():
        return Course(tilt, np.zeros(0), np.zeros(0)), True
    return Course(tilt, np.asarray(imu[1:]), np.asarray(actions)), False


def trained(
    policy: Policy,
    engine: Any,
    cases: list[tuple[Scenario, Conditions, np.ndarray]],
) -> list[tuple[Course, Course]]:
    """The courses over a training engine, closed and open loop, for each of the cases."""
    # Whatever it is, randomisation makes the env take circumstances, which are then given.
    config = dataclasses.replace(
        policy.config, engine=engine, randomization=RandomizationConfig(payload=1.0)
    )
    env = BalanceEnv(config)
    count = len(cases[0][0].phase)
    reset = jax.jit(jax.vmap(env.reset))
    first = reset(jax.random.split(jax.random.PRNGKey(0), count))
    step = jax.jit(jax.vmap(env.step))
    found = []
    for drawn, conditions, actions in cases:
        values = {"scenario": drawn, "conditions": conditions}
        cast = lambda x: jnp.asarray(x, jnp.float32)  # noqa: E731
        given = jax.tree.map(cast, values)
        pair = []
        for replay in (False, True):
            state = first.replace(info=first.info | given)
            tilt, imu, chosen = [], [], []
            for action in actions:
                chosen.append(action if replay else policy(np.asarray(state.obs)))
                state = step(state, jnp.asarray(chosen[-1]))
                tilt.append(state.metrics["tilt_deg"])
                imu.append(state.info["memory"].imu[:, -config.task.sim_steps :])
            pair.append(Course(*(np.asarray(x) for x in (tilt, imu, chosen))))
        found.append(tuple(pair))
    return found


def figures(tilt: np.ndarray) -> np.ndarray:
    """Mean, 95th percentile and maximum, deg."""
    return np.asarray((tilt.mean(), np.percentile(tilt, 95), tilt.max()))


def main() -> None:
    """Measures and prints the table."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])  # pyright: ignore
    parser.add_argument("policy", type=Path)
    parser.add_argument("--scenarios", type=int, default=64)
    parser.add_argument("--periods", type=int, default=3, help="of 10 s")
    parser.add_argument("--write", type=Path, help="Markdown file with markers")
    args = parser.parse_args()
    policy = load_policy(args.policy)
    duration = args.periods * policy.config.task.target_period
    cases, plain = [], []
    for suite in CIRCUMSTANCES:
        drawn, conditions = make_scenarios(
            policy.config, suite, args.scenarios, duration, SEEDS.held_out
        )
        course, fell = evaluated(policy, drawn, conditions, duration)
        if fell:
            raise SystemExit(f"a robot fell in suite {suite}: there is nothing to compare")
        plain.append(course)
        cases.append((drawn, conditions, course.action))
    courses = {engine: trained(policy, engine, cases) for engine in ENGINES}
    rows = []
    for k, suite in enumerate(CIRCUMSTANCES):
        theirs = figures(plain[k].tilt)
        cells = [f"`{suite}`", " / ".join(f"{x:.3f}" for x in theirs)]
        for engine in ENGINES:
            closed, opened = courses[engine][k]
            ours = figures(closed.tilt)
            off = np.abs(opened.imu[:-1] - plain[k].imu).reshape(-1, 6)
            spread = plain[k].imu.reshape(-1, 6).std(axis=0)
            cells += [
                " / ".join(f"{x:.3f}" for x in ours),
                f"{np.abs(ours / theirs - 1).max():.1%}",
                f"{np.max(np.percentile(off, 99, axis=0) / spread):.1%}",
            ]
        rows.append(cells)
    columns = ["circumstances", "plain MuJoCo"]
    for engine in ENGINES:
        columns += [f"`{engine}`", "off by", "IMU off by"]
    note = (
        f"{args.scenarios} held-out scenarios of {duration:g} s; mean / p95 / max of the tilt of "
        "decisions, deg; the largest relative difference of the three; and open loop the 99th "
        "percentile of the IMU samples' difference, over their deviation, of the worst channel."
    )
    publish("parity", [*table(columns, rows), "", note], args.write)


if __name__ == "__main__":
    main()
