"""MJX: advances one env by one decision inside a jitted program.

An engine is an `Engine`. The state holds only what a physics step reads, so that it
is cheap to carry, to reset and to save, and so that the environment need not know the
engine behind it.
"""

import copy
from collections.abc import Callable
from typing import NamedTuple

import jax
import jax.numpy as jnp
from mujoco import mjx

from mjx_balance.scene import Scene
from mjx_balance.task.attitude import body_tilt


class PhysicsState(NamedTuple):
    """State of one env between physics steps."""

    qpos: jax.Array
    """(nq,)"""
    qvel: jax.Array
    """(nv,)"""
    qacc_warmstart: jax.Array
    """(nv,)"""


class Motion(NamedTuple):
    """What happened in one decision."""

    imu: jax.Array
    """(sim_steps, 6) gyro in rad/s and accelerometer in m/s^2, before each step."""
    tilt: jax.Array
    """(sim_steps,) body tilt after each step, deg."""


Advance = Callable[[PhysicsState, jax.Array, dict[str, jax.Array]], tuple[PhysicsState, Motion]]
"""(state, ctrl (sim_steps, nu), model fields that differ in this env) -> (state, motion)."""


class Engine(NamedTuple):
    """What an environment needs of a physics engine."""

    initial: PhysicsState
    """The settled stance."""
    advance: Advance
    """By one decision."""


def mjx_engine(scene: Scene) -> Engine:
    """Puts the scene's model on the device, with the solver settings of its config."""
    training_model = copy.copy(scene.model)
    training_model.opt.iterations = scene.config.solver_iterations
    training_model.opt.ls_iterations = scene.config.line_search_iterations
    with jax.ensure_compile_time_eval():  # constants, even where this runs inside a trace
        model = mjx.put_model(training_model)
        blank = mjx.make_data(training_model)
        stance = scene.stance
        initial = PhysicsState(
            jnp.asarray(stance.qpos, jnp.float32),
            jnp.asarray(stance.qvel, jnp.float32),
            jnp.asarray(stance.qacc_warmstart, jnp.float32),
        )

    def advance(
        state: PhysicsState, ctrl: jax.Array, fields: dict[str, jax.Array]
    ) -> tuple[PhysicsState, Motion]:
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

    return Engine(initial, advance)
