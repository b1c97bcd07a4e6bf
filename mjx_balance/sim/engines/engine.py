"""What an environment needs of a physics engine.

The state holds only what a physics step reads, so that it is cheap to carry, to reset and to
save, and so that the environment need not know the engine behind it.
"""

from collections.abc import Callable
from typing import NamedTuple

import jax
import jax.numpy as jnp

from mjx_balance.sim.scene import Scene
from mjx_balance.task.randomization import Conditions


class PhysicsState(NamedTuple):
    """State of one env between physics steps."""

    qpos: jax.Array
    """(nq,)"""
    qvel: jax.Array
    """(nv,)"""
    qacc_warmstart: jax.Array
    """(nv,)"""


class Motion(NamedTuple):
    """What happened in one decision; not finite where the simulation has diverged."""

    imu: jax.Array
    """(sim_steps, 6) gyro in rad/s and accelerometer in m/s^2, before each step."""
    tilt: jax.Array
    """(sim_steps,) body tilt after each step, deg."""


Engine = Callable[[PhysicsState, jax.Array, Conditions | None], tuple[PhysicsState, Motion]]
"""Advances one env by one decision: (state, ctrl (sim_steps, nu), circumstances; nominal if none)
-> (state, motion)."""


def settled(scene: Scene) -> PhysicsState:
    """The state of the settled stance."""
    stance = scene.stance
    parts = (stance.qpos, stance.qvel, stance.qacc_warmstart)
    return PhysicsState(*(jnp.asarray(part, jnp.float32) for part in parts))
