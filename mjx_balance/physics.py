"""Advances one world by one decision in MJX.

An engine is an `Advance`. The state holds only what a physics step reads, so that it
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
from mjx_balance.task.reward import body_tilt

SOLVER_ITERATIONS = 4
"""Newton iterations in training. A batch waits for its slowest world, but fewer do not
converge when a random policy lifts a foot: with one, robots jump (benchmarks/README.md)."""
LINE_SEARCH_ITERATIONS = 6


class PhysicsState(NamedTuple):
    """State of one world between physics steps."""

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
"""(state, ctrl (sim_steps, nu), model fields that differ in this world) -> (state, motion)."""


def initial_state(scene: Scene) -> PhysicsState:
    """The standing state as float32 device arrays."""
    stance = scene.stance
    return PhysicsState(
        jnp.asarray(stance.qpos, jnp.float32),
        jnp.asarray(stance.qvel, jnp.float32),
        jnp.asarray(stance.qacc_warmstart, jnp.float32),
    )


def mjx_advance(scene: Scene) -> Advance:
    """Puts the scene's model on the device and returns its `Advance` for one world."""
    training_model = copy.copy(scene.model)
    training_model.opt.iterations = SOLVER_ITERATIONS
    training_model.opt.ls_iterations = LINE_SEARCH_ITERATIONS
    with jax.ensure_compile_time_eval():  # constants, even where this runs inside a trace
        model = mjx.put_model(training_model)
        blank = mjx.make_data(training_model)

    def advance(
        state: PhysicsState, ctrl: jax.Array, fields: dict[str, jax.Array]
    ) -> tuple[PhysicsState, Motion]:
        world = model.replace(**fields)

        def physics_step(state: PhysicsState, ctrl: jax.Array) -> tuple[PhysicsState, Motion]:
            data = blank.replace(**state._asdict(), ctrl=ctrl)
            # TF32 matrix products, the default on recent GPUs, are too coarse for contacts.
            with jax.default_matmul_precision("highest"):
                data = mjx.step(world, data)
            state = PhysicsState(data.qpos, data.qvel, data.qacc_warmstart)
            tilt = body_tilt(data.qpos[scene.trunk_quat])
            return state, Motion(data.sensordata[scene.imu], tilt)

        return jax.lax.scan(physics_step, state, ctrl)

    return advance
