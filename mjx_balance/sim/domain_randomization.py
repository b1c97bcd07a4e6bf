"""Domain randomisation of a compiled model: payload, friction and servo gains."""

import functools
from typing import Any, NamedTuple

import mujoco
import numpy as np
from jaxtyping import Float

from mjx_balance.sim.scene import Scene, leg_dofs, soft_factors
from mjx_balance.task import Array
from mjx_balance.task.randomization import DomainParams

MODEL_PARAMS = ("payload", "payload_at", "friction", "gain", "softness")
"""Parameters that change the model."""


def randomized_fields(scene: Scene, params: DomainParams) -> dict[str, Array]:
    """The model's fields under domain parameters, for `mjx.Model.replace` or `Batch.expand`.

    The payload is a point mass; its products of inertia about the trunk's principal axes are
    left out. Fields have the leading axes of the parameters.
    """
    model, trunk, xp = scene.model, scene.trunk, params.payload.__array_namespace__()
    legs, feet = scene.leg_ctrl.ravel(), scene.foot_pairs
    load, at = params.payload[..., None], params.payload_at
    mass, centre = model.body_mass[trunk], model.body_ipos[trunk]
    moved = (mass * centre + load * at) / (mass + load)
    arm = (at - centre) @ _principal(model, trunk)
    spread = xp.sum(arm**2, axis=-1, keepdims=True) - arm**2
    inertia = model.body_inertia[trunk] + mass * load / (mass + load) * spread
    friction = params.friction[..., None] * np.ones(2)

    def flat(values: Array) -> Array:
        return values.reshape(*params.payload.shape, -1)

    softness, dofs = params.softness[..., None, None], leg_dofs(model, scene.leg_ctrl).ravel()
    softer, damped = (factor**softness for factor in soft_factors(scene.robot))
    stiffness = model.actuator_gainprm[legs, 0] * flat(params.gain * softer)
    damping = model.dof_damping[dofs] * flat(np.ones(scene.leg_ctrl.shape) * damped)

    def put(field: np.ndarray, where: tuple[Any, ...], value: Array) -> Array:
        base = xp.zeros((*value.shape[: params.payload.ndim], *field.shape)) + field
        if hasattr(base, "at"):  # JAX arrays are immutable
            return base.at[(..., *where)].set(value)
        base[(..., *where)] = value
        return base

    of_bodies, of_dofs = inverse_weights(scene, (mass + load)[..., 0], moved, inertia)
    return {
        "body_mass": put(model.body_mass, (trunk,), (mass + load)[..., 0]),
        "body_ipos": put(model.body_ipos, (trunk, slice(None)), moved),
        "body_inertia": put(model.body_inertia, (trunk, slice(None)), inertia),
        "dof_damping": put(model.dof_damping, (dofs,), damping),
        "body_invweight0": of_bodies,
        "dof_invweight0": of_dofs,
        "actuator_gainprm": put(model.actuator_gainprm, (legs, 0), stiffness),
        "actuator_biasprm": put(model.actuator_biasprm, (legs, 1), -stiffness),
        "pair_friction": put(model.pair_friction, (feet, slice(0, 2)), friction),
    }


def _principal(model: mujoco.MjModel, body: int) -> Float[np.ndarray, "3 3"]:
    """A body's principal axes, as columns, in its frame."""
    axes = np.zeros(9)
    mujoco.mju_quat2Mat(axes, model.body_iquat[body])
    return axes.reshape(3, 3)


class _AtRest(NamedTuple):
    """Jacobians and inertia of the nominal model at qpos0."""

    inertia: Float[np.ndarray, "nv nv"]  #: without the trunk's part
    centres: Float[np.ndarray, "nbody 3 nv"]  #: of centres of mass; the trunk's: of its frame
    turns: Float[np.ndarray, "nbody 3 nv"]  #: rotational
    trunk_turns: Float[np.ndarray, "3 nv"]  #: the trunk's, about its principal axes


@functools.lru_cache(maxsize=8)
def _at_rest(model: mujoco.MjModel, trunk: int) -> _AtRest:
    data = mujoco.MjData(model)
    mujoco.mj_kinematics(model, data)
    mujoco.mj_comPos(model, data)
    mujoco.mj_makeM(model, data)
    whole = np.zeros((model.nv, model.nv))
    mujoco.mj_fullM(model, data, whole)
    centres, turns = np.zeros((2, model.nbody, 3, model.nv))
    for body in range(model.nbody):
        mujoco.mj_jacBodyCom(model, data, centres[body], turns[body], body)
    principal = _principal(model, trunk).T @ turns[trunk]
    part = _spatial_inertia(
        centres[trunk], principal, model.body_mass[trunk], model.body_inertia[trunk]
    )
    mujoco.mj_jacBody(model, data, centres[trunk], None, trunk)
    return _AtRest(whole - part, centres, turns, principal)


def _spatial_inertia(
    centre: Array, turn: Array, mass: Array, inertia: Array
) -> Float[Array, "*batch nv nv"]:
    """Joint-space inertia of a body, `turn` about its principal axes."""
    xp = centre.__array_namespace__()
    moving = xp.asarray(mass)[..., None, None] * (xp.matrix_transpose(centre) @ centre)
    return moving + turn.T @ (xp.asarray(inertia)[..., None] * turn)


def inverse_weights(
    scene: Scene,
    mass: Float[Array, "*batch"],
    centre: Float[Array, "*batch 3"],
    inertia: Float[Array, "*batch 3"],
) -> tuple[Float[Array, "*batch nbody 2"], Float[Array, "*batch nv"]]:
    """Body and dof inverse weights, which scale the constraints, for another trunk.

    What `mj_setConst` computes: the mean diagonal of J M^-1 J^T at qpos0, of the centre of
    mass for bodies, of the joint's own directions for dofs. At qpos0 all frames are aligned
    with the world's.

    Args:
      scene: the nominal model.
      mass: of the trunk, kg.
      centre: its centre of mass in its frame, m.
      inertia: its principal inertia, kg m^2.
    """
    model, trunk, xp = scene.model, scene.trunk, mass.__array_namespace__()
    rest = _at_rest(model, trunk)
    # v(centre) = v(origin) + omega x centre
    lever = -xp.cross(centre[..., None, :], rest.turns[trunk].T, axis=-1)
    moved = rest.centres[trunk] + xp.matrix_transpose(lever)
    whole = rest.inertia + _spatial_inertia(moved, rest.trunk_turns, mass, inertia)
    inverse = xp.linalg.inv(whole)

    def mean_diagonal(jacobian: Array) -> Array:
        product = xp.einsum("...iv,...vw,...iw->...i", jacobian, inverse[..., None, :, :], jacobian)
        return product.mean(axis=-1)

    others = np.arange(model.nbody) != trunk
    centres = xp.where(others[:, None, None], rest.centres, moved[..., None, :, :])
    weights = xp.stack((mean_diagonal(centres), mean_diagonal(rest.turns)), axis=-1)
    diagonal = xp.diagonal(inverse, axis1=-2, axis2=-1)
    return weights, diagonal @ _joint_means(model)


def _joint_means(model: mujoco.MjModel) -> Float[np.ndarray, "nv nv"]:
    """Averages over the three dofs of a free joint's halves."""
    means = np.eye(model.nv)
    for joint in np.flatnonzero(model.jnt_type == mujoco.mjtJoint.mjJNT_FREE):
        for half in range(2):
            start = model.jnt_dofadr[joint] + 3 * half
            means[start : start + 3, start : start + 3] = 1 / 3
    return means
