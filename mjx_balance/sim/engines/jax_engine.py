"""A physics engine inside a jitted program, for one env: `jax.vmap` it over thousands."""

from collections.abc import Callable
from typing import NamedTuple

import jax
import jax.numpy as jnp

from mjx_balance.sim.scene import Scene
from mjx_balance.task.randomization import DomainParams
from mjx_balance.task.step import Motion, Targets


class PhysicsState(NamedTuple):
    """State of one env between physics steps.

    Holds only what a physics step reads, so that it is cheap to carry, to reset and to save.
    """

    qpos: jax.Array
    """(nq,)"""
    qvel: jax.Array
    """(nv,)"""
    qacc_warmstart: jax.Array
    """(nv,)"""


Physics = Callable[
    [PhysicsState, jax.Array, DomainParams | None],
    tuple[PhysicsState, Motion],
]
"""Moves one env by one decision: (state, ctrl (sim_steps, nu), params) -> (state, motion)."""


class JaxEngine:
    """`task.step.Engine` over a function of MuJoCo's own arrays."""

    def __init__(self, scene: Scene, physics: Physics):
        """Of a scene, whose order of servos the function takes."""
        self.scene, self.physics = scene, physics

    def initial(self) -> PhysicsState:
        """The settled stance."""
        stance = self.scene.stance
        parts = (stance.qpos, stance.qvel, stance.qacc_warmstart)
        return PhysicsState(*(jnp.asarray(part, jnp.float32) for part in parts))

    def push(self, physics: PhysicsState, velocity: jax.Array) -> PhysicsState:
        """Adds (2,) m/s along the world's x and y to the trunk's velocity."""
        return physics._replace(qvel=physics.qvel.at[self.scene.trunk_velocity].add(velocity))

    def advance(
        self, physics: PhysicsState, targets: Targets, params: DomainParams | None
    ) -> tuple[PhysicsState, Motion]:
        """Moves the physics by one decision."""
        with jax.named_scope("physics"):
            return self.physics(physics, self.scene.ctrl(targets), params)
