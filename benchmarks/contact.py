"""What the contact model and the solver's accuracy do to the robot. Plain MuJoCo.

A policy, with every tenth action random as in training, stands on the boards of suite
`corner` under other solver settings. Prints falls, tilt, and how far feet creep.

    python benchmarks/contact.py POLICY [--scenarios 32] [--duration 60]
"""

import argparse
import copy
import dataclasses

import mujoco
import numpy as np

from mjx_balance import load_policy
from mjx_balance.config import Config
from mjx_balance.evaluation import rollout as evaluation
from mjx_balance.evaluation.controllers import Controller, View
from mjx_balance.evaluation.suites import make_scenarios
from mjx_balance.policy.file import Policy
from mjx_balance.sim.scene import Scene

PYRAMIDAL = {"cone": float(mujoco.mjtCone.mjCONE_PYRAMIDAL)}
VARIANTS: dict[str, dict[str, float]] = {
    "as shipped: elliptic cones": {},
    "4 Newton iterations (training)": {"iterations": 4},
    "2 Newton iterations": {"iterations": 2},
    "1 Newton iteration": {"iterations": 1},
    "contact time 20 ms": {"contact_time": 0.02},
    "foot friction 0.4": {"friction": 0.4},
    "pyramidal cones": PYRAMIDAL,
    "pyramidal cones, impratio 2": PYRAMIDAL | {"impratio": 2.0},
    "pyramidal cones, impratio 2, foot friction 0.4": PYRAMIDAL
    | {"impratio": 2.0, "friction": 0.4},
}


def varied(scene: Scene, changes: dict[str, float]) -> Scene:
    """A copy of the scene with other solver settings."""
    changed = copy.copy(scene.model)
    if "iterations" in changes:
        changed.opt.iterations = int(changes["iterations"])
        changed.opt.ls_iterations = Config.line_search_iterations
    if "cone" in changes:
        changed.opt.cone = int(changes["cone"])
    if "friction" in changes:
        changed.pair_friction[:, :2] = changes["friction"]
    if "impratio" in changes:
        changed.opt.impratio = changes["impratio"]
    if "contact_time" in changes:
        changed.pair_solref[:, 0] = changes["contact_time"]
    return dataclasses.replace(scene, model=changed)


def exploring(policy: Policy, share: float, seed: int) -> Controller:
    """The policy, with a share of its actions random."""
    rng = np.random.default_rng(seed)

    def act(view: View) -> np.ndarray:
        random = rng.integers(len(policy.actions), size=len(view.ids))
        return np.where(rng.uniform(size=len(view.ids)) < share, random, policy(view.obs))

    return act


def main() -> None:
    """Runs every variant and prints a table."""
    parser = argparse.ArgumentParser()
    parser.add_argument("policy")
    parser.add_argument("--scenarios", type=int, default=32)
    parser.add_argument("--duration", type=float, default=60.0)
    args = parser.parse_args()
    policy = load_policy(args.policy)
    scene = evaluation.policy_scene(policy)
    drawn, _ = make_scenarios(policy.config, "corner", args.scenarios, args.duration, 0)
    print("| variant | falls | mean tilt deg | max deg | creep of the standing robots, cm |")
    print("|---|---|---|---|---|")
    trunk = scene.trunk_quat[0] - np.asarray((3, 2))
    for name, changes in VARIANTS.items():
        rollout = evaluation.roll_out(
            varied(scene, changes),
            exploring(policy, 0.1, 0),
            drawn,
            args.duration,
            record=True,
        )
        assert rollout.qpos is not None
        end = rollout.qpos[~rollout.fell, -1][:, trunk]
        creep = f"{100 * np.linalg.norm(end, axis=-1).mean():.1f}" if len(end) else "-"
        print(
            f"| {name} | {rollout.fell.sum()} of {len(rollout.fell)} | {rollout.tilt.mean():.3f} "
            f"| {rollout.tilt.max():.2f} | {creep} |",
            flush=True,
        )


if __name__ == "__main__":
    main()
