"""A physics engine inside a jitted program, for one env: `jax.vmap` it over thousands."""

import dataclasses
from collections.abc import Callable
from typing import NamedTuple

import jax
import jax.numpy as jnp
from jaxtyping import Float

from mjx_balance.sim.scene import Scene
from mjx_balance.task.randomization import DomainParams
from mjx_balance.task.step import Motion, Targets


class PhysicsState(NamedTuple):
    """What a physics step of one env reads: cheap to carry, to reset and to save."""

    qpos: Float[jax.Array, " nq"]
    qvel: Float[jax.Array, " nv"]
    qacc_warmstart: Float[jax.Array, " nv"]


@dataclasses.dataclass(frozen=True, eq=False)
class JaxEngine:
    """`task.step.Engine` over a function of MuJoCo's own arrays."""

    scene: Scene
    physics: Callable[[PhysicsState, jax.Array, DomainParams | None], tuple[PhysicsState, Motion]]
    """State, ctrl (sim_steps, nu) in the scene's order of servos, params -> state, motion."""

    def initial(self, qpos: Float[jax.Array, " nq"] | None = None) -> PhysicsState:
        """At rest in the settled stance, or elsewhere."""
        stance = self.scene.stance
        start = stance.qpos if qpos is None else qpos
        parts = (start, stance.qvel, stance.qacc_warmstart)
        return PhysicsState(*(jnp.asarray(part, jnp.float32) for part in parts))

    def push(self, physics: PhysicsState, velocity: Float[jax.Array, "2"]) -> PhysicsState:
        """Adds m/s along the world's x and y to the trunk's velocity."""
        return physics._replace(qvel=physics.qvel.at[self.scene.trunk_velocity].add(velocity))

    def advance(
        self, physics: PhysicsState, targets: Targets, params: DomainParams | None
    ) -> tuple[PhysicsState, Motion]:
        """Moves the physics by one decision."""
        with jax.named_scope("physics"):
            return self.physics(physics, self.scene.ctrl(targets, params), params)
