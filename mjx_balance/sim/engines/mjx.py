"""MJX: physics inside a jitted program, on any device."""

import copy
import functools

import jax
import mujoco
from mujoco import mjx

from mjx_balance.sim.domain_randomization import model_fields
from mjx_balance.sim.engines.engine import Engine, Motion, PhysicsState
from mjx_balance.sim.scene import Scene
from mjx_balance.task.attitude import body_tilt
from mjx_balance.task.randomization import Conditions


def trained_model(scene: Scene) -> mujoco.MjModel:
    """The scene's model with the solver of its config."""
    model = copy.copy(scene.model)
    model.opt.iterations = scene.config.solver_iterations
    model.opt.ls_iterations = scene.config.line_search_iterations
    # Rows that MJX would solve at every step, and that never push: heights are clipped.
    model.jnt_limited[:] = False
    return model


def mjx_engine(scene: Scene) -> Engine:
    """Solves as the scene's config says; the model is put on the device when it is first traced."""

    @functools.cache
    def on_device() -> tuple[mjx.Model, mjx.Data]:
        model, own = trained_model(scene), jax.local_devices()[0]  # not another process's
        with jax.ensure_compile_time_eval():  # constants, though this runs inside a trace
            return mjx.put_model(model, own), mjx.make_data(model, own)

    def advance(
        state: PhysicsState, ctrl: jax.Array, conditions: Conditions | None
    ) -> tuple[PhysicsState, Motion]:
        fields = {} if conditions is None else model_fields(scene, conditions)
        model, blank = on_device()
        env_model = model.replace(**fields)

        def physics_step(state: PhysicsState, ctrl: jax.Array) -> tuple[PhysicsState, Motion]:
            data = blank.replace(**state._asdict(), ctrl=ctrl)
            # TF32 matrix products, the default on recent GPUs, are too coarse for contacts.
            with jax.default_matmul_precision("highest"):
                data = mjx.step(env_model, data)
            state = PhysicsState(data.qpos, data.qvel, data.qacc_warmstart)
            tilt = body_tilt(data.qpos[scene.trunk_quat])
            return state, Motion(data.sensordata[scene.imu], tilt)

        return jax.lax.scan(physics_step, state, ctrl)

    return advance
