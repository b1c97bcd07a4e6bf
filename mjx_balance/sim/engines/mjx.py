"""MJX: physics inside a jitted program, on any device."""

import copy
import functools

import jax
import mujoco
from jaxtyping import Float
from mujoco import mjx

from mjx_balance.sim.domain_randomization import randomized_fields
from mjx_balance.sim.engines.jax_engine import JaxEngine, PhysicsState
from mjx_balance.sim.engines.table import Options
from mjx_balance.sim.measurement import RECORDED, measure
from mjx_balance.sim.scene import Scene
from mjx_balance.task.randomization import DomainParams
from mjx_balance.task.step import Motion


def training_model(scene: Scene, options: Options) -> mujoco.MjModel:
    """The scene's model with the solver of the options."""
    model = copy.copy(scene.model)
    model.opt.iterations = options.solver_iterations
    model.opt.ls_iterations = options.line_search_iterations
    # Rows that MJX would solve at every step, and that never push: heights are clipped.
    model.jnt_limited[:] = False
    return model


def physics_step(
    scene: Scene,
    model: mjx.Model,
    blank: mjx.Data,
    state: PhysicsState,
    ctrl: Float[jax.Array, " nu"],
) -> tuple[PhysicsState, Motion, mjx.Data]:
    """Steps one env in `blank` data; returns its state, its motion and all of MJX's data."""
    data = blank.replace(**state._asdict(), ctrl=ctrl)
    # TF32 matrix products, the default on recent GPUs, are too coarse for contacts.
    with jax.default_matmul_precision("highest"):
        data = mjx.step(model, data)
    motion = measure(scene, **{name: getattr(data, name) for name in RECORDED})
    return PhysicsState(data.qpos, data.qvel, data.qacc_warmstart), motion, data


def mjx_engine(scene: Scene, options: Options) -> JaxEngine:
    """Puts the model on the device when it is first traced."""

    @functools.cache
    def on_device() -> tuple[mjx.Model, mjx.Data]:
        model, own = training_model(scene, options), jax.local_devices()[0]  # not another process's
        with jax.ensure_compile_time_eval():  # constants, though this runs inside a trace
            return mjx.put_model(model, own), mjx.make_data(model, own)

    def physics(
        state: PhysicsState, ctrl: jax.Array, params: DomainParams | None
    ) -> tuple[PhysicsState, Motion]:
        with jax.enable_x64(False):  # MJX computes in JAX's default precision
            fields = {} if params is None else randomized_fields(scene, params)
            model, blank = on_device()
            own = model.replace(**fields)
            step = lambda state, ctrl: physics_step(scene, own, blank, state, ctrl)[:2]  # noqa: E731
            return jax.lax.scan(step, state, ctrl)

    return JaxEngine(scene, physics)
