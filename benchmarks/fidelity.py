"""Does what is learnt in training hold in plain MuJoCo?

Tables, one per call (`--table`):
  engines    one policy in the same scenarios over the training engines and in the evaluation,
             without sensor noise. Closed loop: the policy sees what its own robot's IMU reads. Open
             loop: the actions of the evaluation are repeated and the IMU samples compared;
  contact    the policy, every tenth action random as in training, under other solver settings;
  precision  preset `default` trained with products rounded as GPUs and TPUs round them, and with
             as many envs as an accelerator steps.

    python benchmarks/fidelity.py [--table engines] [--write benchmarks/README.md]
"""

import argparse
import contextlib
import copy
import dataclasses
import tempfile
from pathlib import Path
from typing import Any, NamedTuple

import common
import mujoco
import numpy as np
from common import DURATION, POLICY, Row

from mjx_balance.quiet import quiet_imports

with quiet_imports("torch", "warp"):
    import jax
    import jax.numpy as jnp
    from flax import linen as nn

    from mjx_balance.envs.balance import BalanceEnv
    from mjx_balance.training import sizing
from mjx_balance.config import Config, RandomizationConfig, preset
from mjx_balance.envs.batch import Episodes
from mjx_balance.evaluation.controllers import Controller, View
from mjx_balance.evaluation.rollout import policy_scene, roll_out, summarize
from mjx_balance.evaluation.suites import SEEDS, draw_suite
from mjx_balance.policy.file import load_policy, save_policy
from mjx_balance.policy.manifest import make_manifest
from mjx_balance.policy.network import Policy
from mjx_balance.sim.scene import Scene
from mjx_balance.task.randomization import DRAWS, draw_params

TILTS = ("mean", "p95", "max")
ENGINES = ("mjx", "mujoco")
SUITES = ("paper", "corner", "payload", "friction", "gains", "latency")
PYRAMIDAL = {"cone": float(mujoco.mjtCone.mjCONE_PYRAMIDAL)}
SETTINGS: dict[str, dict[str, float]] = {
    "as shipped: elliptic cones": {},
    "4 Newton iterations (training)": {"iterations": 4},
    "2 Newton iterations": {"iterations": 2},
    "1 Newton iteration": {"iterations": 1},
    "contact time 20 ms": {"contact_time": 0.02},
    "foot friction 0.4": {"friction": 0.4},
    "pyramidal cones": PYRAMIDAL,
    "pyramidal cones, impratio 2": PYRAMIDAL | {"impratio": 2},
    "pyramidal cones, impratio 2, foot friction 0.4": PYRAMIDAL | {"impratio": 2, "friction": 0.4},
}
MANTISSA = {"float32": 23, "TF32": 10, "bfloat16": 7}
"""Bits that a factor keeps; its exponent stays."""
TRAININGS = (("float32", 256), ("TF32", 256), ("bfloat16", 256), ("float32", 2_048))


class Course(NamedTuple):
    """What happened in n scenarios."""

    tilt: np.ndarray
    """(decisions, n) mean of each decision, deg."""
    imu: np.ndarray
    """(decisions, n, sim_steps, 6) samples of each decision."""
    action: np.ndarray
    """(decisions, n)"""


def evaluation_course(policy: Policy, episodes: Episodes, duration: float) -> Course:
    """The course in the evaluation; its IMU samples lack the last decision's.

    Raises:
      SystemExit: if a robot falls.
    """
    imu, actions = [], []

    def act(view: View) -> np.ndarray:
        imu.append(view.imu)
        actions.append(policy(view.obs))
        return actions[-1]

    rollout = roll_out(policy_scene(policy), act, episodes, duration)
    if rollout.fell.any():
        raise SystemExit("a robot fell: there is nothing to compare")
    tilt = rollout.tilt.reshape(*rollout.action_mm.shape, -1).mean(axis=-1).T
    return Course(tilt, np.asarray(imu[1:]), np.asarray(actions))


def env_courses(
    policy: Policy, engine: Any, cases: list[tuple[Episodes, np.ndarray]]
) -> list[tuple[Course, Course]]:
    """The courses in the training env, closed and open loop, for each case and its actions."""
    # Whatever it is, randomisation makes the env take domain parameters, which are then given.
    randomization = RandomizationConfig(payload=1.0)
    config = dataclasses.replace(policy.config, engine=engine, randomization=randomization)
    env = BalanceEnv(config, "discrete")
    count, sim_steps = len(cases[0][0].scenario.phase), env.config.task.sim_steps
    first = jax.jit(jax.vmap(env.reset))(jax.random.split(jax.random.PRNGKey(0), count))
    step = jax.jit(jax.vmap(env.step))

    def course(given: Any, actions: np.ndarray, replay: bool) -> Course:
        state, seen = first.replace(pipeline_state=first.pipeline_state._replace(**given)), []
        for action in actions:
            chosen = action if replay else policy(np.asarray(state.obs))
            state = step(state, jnp.asarray(chosen))
            imu = state.pipeline_state.memory.imu[:, -sim_steps:]
            seen.append((state.metrics["tilt_deg"], imu, chosen))
        return Course(*(np.asarray(x) for x in zip(*seen, strict=True)))

    courses = []
    nominal = draw_params(RandomizationConfig(), env.scene.robot, np.zeros((count, DRAWS)))
    for episodes, actions in cases:
        given = {"scenario": episodes.scenario, "params": episodes.params or nominal}
        given = jax.tree.map(lambda x: jnp.asarray(x, jnp.float32), given)
        courses.append((course(given, actions, False), course(given, actions, True)))
    return courses


def statistics(tilt: np.ndarray) -> Row:
    """Mean, 95th percentile and maximum, deg, of robots that stand."""
    p95 = float(np.percentile(tilt, 95))
    return {"mean": float(tilt.mean()), "p95": p95, "max": float(tilt.max()), "falls": 0}


def engines(args: argparse.Namespace) -> None:
    """Table `engines`."""
    policy = load_policy(args.policy)
    duration = args.periods * policy.config.task.target_period
    cases, plain = [], []
    for suite in SUITES:
        drawn = draw_suite(
            policy.config.task, policy.robot, suite, args.scenarios, duration, SEEDS.held_out
        )
        plain.append(evaluation_course(policy, drawn, duration))
        cases.append((drawn, plain[-1].action))
    courses = {engine: env_courses(policy, engine, cases) for engine in ENGINES}
    rows: list[Row] = []
    for k, suite in enumerate(SUITES):
        reference, spread = statistics(plain[k].tilt), plain[k].imu.std(axis=(0, 1, 2))
        row: Row = {"suite": suite, "plain MuJoCo": reference}
        for engine in ENGINES:
            closed, opened = courses[engine][k]
            own, off = statistics(closed.tilt), np.abs(opened.imu[:-1] - plain[k].imu)
            worst = np.percentile(off, 99, axis=(0, 1, 2)) / spread
            row[engine] = own
            row[f"{engine} off by"] = max(abs(own[x] / reference[x] - 1) for x in TILTS)
            row[f"{engine} IMU off by"] = float(worst.max())
        rows.append(row)
    forms = {f"{engine} {x}off by": "{:.1%}" for engine in ENGINES for x in ("", "IMU ")}
    note = (
        f"{args.scenarios} held-out scenarios of {duration:g} s; mean / p95 / max of the tilt of "
        "decisions, deg; the largest relative difference of the three; and open loop the 99th "
        "percentile of the IMU samples' difference, over their deviation, of the worst channel."
    )
    common.report(args, "fidelity engines", rows, note, forms)


def with_settings(scene: Scene, settings: dict[str, float]) -> Scene:
    """A copy of the scene with other solver settings."""
    model = copy.copy(scene.model)
    for name, value in settings.items():
        if name == "iterations":
            model.opt.iterations = int(value)
            model.opt.ls_iterations = Config.line_search_iterations
        elif name == "cone":
            model.opt.cone = int(value)
        elif name == "impratio":
            model.opt.impratio = value
        elif name == "friction":
            model.pair_friction[:, :2] = value
        else:
            model.pair_solref[:, 0] = value
    return dataclasses.replace(scene, model=model)


def exploring(policy: Policy, share: float) -> Controller:
    """The policy, with a share of its actions random."""
    rng = np.random.default_rng(0)

    def act(view: View) -> np.ndarray:
        random = rng.integers(len(policy.actions), size=len(view.ids))
        return np.where(rng.uniform(size=len(view.ids)) < share, random, policy(view.obs))

    return act


def contact(args: argparse.Namespace) -> None:
    """Table `contact`."""
    policy = load_policy(args.policy)
    scene, rows = policy_scene(policy), []
    trunk = scene.trunk_quat[0] - np.asarray((3, 2))
    drawn = draw_suite(scene.task, scene.robot, "corner", args.scenarios, DURATION, 0)
    for name, settings in SETTINGS.items():
        controller = exploring(policy, 0.1)
        varied = with_settings(scene, settings)
        rollout = roll_out(varied, controller, drawn, DURATION, record=True)
        assert rollout.qpos is not None
        end = rollout.qpos[~rollout.fell, -1][:, trunk]
        creep = 100 * np.linalg.norm(end, axis=-1).mean() if len(end) else None
        result = common.pooled([summarize(rollout, "corner", DURATION, 0)])
        rows.append({"settings": name, "corner": result, "creep of the standing robots": creep})
    note = f"{args.scenarios} scenarios of {DURATION:g} s; {common.TILTS}."
    forms = {"creep of the standing robots": "{:.1f} cm"}
    common.report(args, "fidelity contact", rows, note, forms)


def rounded_product(bits: int) -> Any:
    """(..., n) @ (n, m) of factors with so many bits, and so its gradients."""

    def rounded(x: jax.Array) -> jax.Array:
        return jax.lax.reduce_precision(x, exponent_bits=8, mantissa_bits=bits)

    @jax.custom_vjp
    def product(x: jax.Array, kernel: jax.Array) -> jax.Array:
        return rounded(x) @ rounded(kernel)

    def backward(factors: Any, slope: jax.Array) -> tuple[jax.Array, jax.Array]:
        x, kernel, slope = *map(rounded, factors), rounded(slope)
        return slope @ kernel.T, jnp.einsum("...i,...j->ij", x, slope)

    product.defvjp(lambda x, kernel: (product(x, kernel), (x, kernel)), backward)
    return product


def with_products_of(bits: int) -> Any:
    """A context in which dense layers are traced with rounded factors."""
    product = rounded_product(bits)

    def layer(next_one: Any, args: Any, kwargs: Any, context: Any) -> Any:
        if isinstance(context.module, nn.Dense) and context.method_name == "__call__":
            how = lambda x, kernel, *_, **__: product(x, kernel)  # noqa: E731
            object.__setattr__(context.module, "dot_general", how)
        return next_one(*args, **kwargs)

    return nn.intercept_methods(layer) if bits < 23 else contextlib.nullcontext()


def trained_policy(products: str, num_envs: int, seed: int, decisions: int | None) -> Policy:
    """Preset `default`, trained over MuJoCo's C engine."""
    config = dataclasses.replace(preset("default"), engine="mujoco")
    config = sizing.size_to_device(sizing.scale_sizes(config, num_envs))
    env = BalanceEnv(config)
    learner = sizing.make_learner(config, env)
    with with_products_of(MANTISSA[products]):
        program, state = learner.train_program(8), learner.init(seed)
        for _ in range(-(-(decisions or config.num_env_steps) // (8 * num_envs))):
            state, _ = jax.block_until_ready(program(state))
    params = jax.device_get(learner.export_params(state))
    with tempfile.TemporaryDirectory() as folder:
        manifest = make_manifest(config, env.scene.hash, {})
        return save_policy(Path(folder) / "policy.safetensors", params, manifest)


def precision(args: argparse.Namespace) -> None:
    """Table `precision`."""
    sizing.configure_jax(common.log)
    rows = []
    for products, num_envs in TRAININGS:
        policies = [trained_policy(products, num_envs, s, args.decisions) for s in args.seeds]
        results = common.evaluated_policies(policies, args.scenarios)
        rows.append({"products": products, "envs": num_envs, **results})
    note = (
        f"Preset default, engine mujoco, {common.machine()}, seeds {args.seeds}; {args.scenarios} "
        f"held-out scenarios of {DURATION:g} s per suite and seed; {common.TILTS}: means over the "
        "seeds, greatest max."
    )
    common.report(args, "fidelity precision", rows, note, {"envs": "{:,}"})


TABLES = {x.__name__: x for x in (engines, contact, precision)}


def main() -> None:
    """Measures one table."""
    parser = common.arguments(__doc__, TABLES)
    parser.add_argument("--policy", type=Path, default=POLICY, help="of engines and contact")
    parser.add_argument("--scenarios", type=int, default=64)
    parser.add_argument("--periods", type=int, default=3, help="of 10 s, of table engines")
    parser.add_argument("--seeds", type=int, nargs="+", default=[0, 1], help="of table precision")
    parser.add_argument("--decisions", type=int, help="of table precision; none: the preset's")
    args = parser.parse_args()
    TABLES[args.table](args)


if __name__ == "__main__":
    main()
