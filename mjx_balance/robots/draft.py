"""A first TOML file for a robot, from its model alone: legs are found by their structure."""

import itertools
from pathlib import Path
from typing import NamedTuple

import mujoco
import numpy as np

from mjx_balance.robots.building import read_model, words
from mjx_balance.robots.file import RobotError
from mjx_balance.robots.measuring import ancestors

HEADER = """\
# Drafted from the model's structure; a corner's letters say front or rear, left or right.
# `mjx-balance robot check FILE` builds it, says what it found, and draws a picture.
"""
USUAL_RADIUS = 0.02
"""Of a foot that is no sphere, m."""


class _Chain(NamedTuple):
    """Three hinges, one below the other, and nothing else that moves."""

    joints: tuple[int, int, int]
    calf: list[int]
    """The body that the last of them moves, and what is fixed to it."""


class _Foot(NamedTuple):
    """Where a chain ends."""

    text: str
    """As the file says it."""
    place: np.ndarray
    """(3,) in the world, m."""
    radius: float | None
    """m; none: the file need not say it."""


def draft(model: str, path: Path) -> str:
    """A robot file's text.

    Args:
      model: what the file calls the model.
      path: where the model is.

    Raises:
      RobotError: if it cannot be read, or has no free trunk, or not four legs.
    """
    spec = read_model(path)
    try:
        compiled = spec.compile()
    except ValueError as error:
        raise RobotError(f"{path} cannot be compiled: {words(error)}") from error
    data = mujoco.MjData(compiled)
    mujoco.mj_kinematics(compiled, data)
    trunk = _trunk(compiled, path)
    found = [(chain, _foot(compiled, data, chain)) for chain in _chains(compiled, trunk)]
    legs = sorted(found, key=lambda leg: leg[1].place[2])[:4]
    if len(legs) < 4:
        names = ", ".join(compiled.joint(chain.joints[0]).name for chain, _ in legs) or "none"
        raise RobotError(
            f"{path} has {len(legs)} chains of three hinges below its trunk ({names}); a robot of "
            "this kind has four legs"
        )
    return _written(compiled, data, model, trunk, legs)


def _trunk(model: mujoco.MjModel, path: Path) -> int:
    free = np.flatnonzero(model.jnt_type == mujoco.mjtJoint.mjJNT_FREE)
    if not len(free):
        raise RobotError(f"{path} has no free joint; its trunk must be free to move")
    bodies = model.jnt_bodyid[free]
    return int(bodies[np.argmax(model.body_subtreemass[bodies])])


def _chains(model: mujoco.MjModel, trunk: int) -> list[_Chain]:
    chains = []
    for start in range(1, model.nbody):
        above = ancestors(model, start)
        if trunk not in above or not model.body_jntnum[start]:
            continue
        if any(model.body_jntnum[body] for body in above[: above.index(trunk)]):
            continue
        below = [b for b in range(model.nbody) if b == start or start in ancestors(model, b)]
        moving = [body for body in below if model.body_jntnum[body]]
        joints = [k for k in range(model.njnt) if model.jnt_bodyid[k] in below]
        hinges = all(model.jnt_type[k] == mujoco.mjtJoint.mjJNT_HINGE for k in joints)
        in_line = all(a in ancestors(model, b) for a, b in itertools.pairwise(moving))
        if len(joints) == len(moving) == 3 and hinges and in_line:
            calf = [b for b in below if b == moving[-1] or moving[-1] in ancestors(model, b)]
            chains.append(_Chain((joints[0], joints[1], joints[2]), calf))
    return chains


def _foot(model: mujoco.MjModel, data: mujoco.MjData, chain: _Chain) -> _Foot:
    """The sphere, or else the site, or else the point of a geom, that is furthest from the knee."""
    knee = data.xanchor[chain.joints[2]]

    def distance(place: np.ndarray) -> float:
        return float(np.linalg.norm(place - knee))

    geoms = [g for g in range(model.ngeom) if model.geom_bodyid[g] in chain.calf]
    spheres = [g for g in geoms if model.geom_type[g] == mujoco.mjtGeom.mjGEOM_SPHERE]
    if spheres:
        one = max(spheres, key=lambda g: distance(data.geom_xpos[g]))
        radius, place = float(model.geom_size[one, 0]), data.geom_xpos[one]
        if model.geom(one).name:
            return _Foot(f'"{model.geom(one).name}"', place, None)
        return _Foot(_offset(model, data, int(model.geom_bodyid[one]), place), place, radius)
    sites = [s for s in range(model.nsite) if model.site_bodyid[s] in chain.calf]
    named = [s for s in sites if model.site(s).name]
    if named:
        one = max(named, key=lambda s: distance(data.site_xpos[s]))
        return _Foot(f'"{model.site(one).name}"', data.site_xpos[one], USUAL_RADIUS)
    corners = [p for g in geoms for p in _corners(model, data, g)]
    corners = corners or [data.xpos[chain.calf[-1]]]
    place = max(corners, key=distance)
    place = place - USUAL_RADIUS * (place - knee) / max(distance(place), USUAL_RADIUS)
    return _Foot(_offset(model, data, chain.calf[0], place), place, USUAL_RADIUS)


def _corners(model: mujoco.MjModel, data: mujoco.MjData, geom: int) -> list[np.ndarray]:
    """Points in the world, m: a mesh's vertices, or else of the box around a geom its faces'."""
    turn, centre = data.geom_xmat[geom].reshape(3, 3), data.geom_xpos[geom]
    mesh = int(model.geom_dataid[geom])
    if model.geom_type[geom] == mujoco.mjtGeom.mjGEOM_MESH and mesh >= 0:
        first = model.mesh_vertadr[mesh]
        points = model.mesh_vert[first : first + model.mesh_vertnum[mesh]]
    else:
        middle, half = model.geom_aabb[geom, :3], model.geom_aabb[geom, 3:]
        points = middle + np.concatenate((np.diag(half), -np.diag(half)))
    return list(centre + points @ turn.T)


def _offset(model: mujoco.MjModel, data: mujoco.MjData, body: int, place: np.ndarray) -> str:
    at = data.xmat[body].reshape(3, 3).T @ (place - data.xpos[body])
    numbers = ", ".join(f"{x + 0.0:.4g}" for x in at)
    return f'{{ body = "{model.body(body).name}", offset = [{numbers}] }}'


def _written(
    model: mujoco.MjModel,
    data: mujoco.MjData,
    name: str,
    trunk: int,
    legs: list[tuple[_Chain, _Foot]],
) -> str:
    turn = data.xmat[trunk].reshape(3, 3).T
    hips = [turn @ (data.xanchor[chain.joints[0]] - data.xpos[trunk]) for chain, _ in legs]
    forward = int(np.argmax(np.ptp(hips, axis=0)[:2]))
    corners = {}
    for hip, leg in zip(hips, legs, strict=True):
        ahead, left = hip[forward], hip[1] if forward == 0 else -hip[0]
        corners[("F" if ahead > 0 else "R") + ("L" if left > 0 else "R")] = leg
    lines = [HEADER + f'model = "{name}"', f'trunk = "{model.body(trunk).name}"']
    if forward == 1:
        lines.append(
            '# Looks along its y, it seems; if not, say end = "front" or "hind" of all legs.'
        )
    imus = [s for s in range(model.nsite) if model.site_bodyid[s] == trunk]
    imus = [model.site(s).name for s in imus if "imu" in model.site(s).name.lower()]
    lines += [f'imu = "{imu}"' for imu in imus[:1]]
    used = {joint for chain, _ in legs for joint in chain.joints}
    fixed = [
        model.joint(k).name
        for k in range(model.njnt)
        if k not in used and model.jnt_type[k] != mujoco.mjtJoint.mjJNT_FREE
    ]
    if fixed:
        lines.append(f"strip = {_list(fixed)}  # fixed; a body's name instead leaves it out")
    radii = [foot.radius for _, foot in legs if foot.radius is not None]
    lines += [f"foot_radius = {radius:.4g}" for radius in radii[:1]]
    for corner in ("FL", "FR", "RL", "RR"):
        if corner in corners:
            chain, foot = corners[corner]
            joints = _list([model.joint(k).name for k in chain.joints])
            lines += ["", f"[legs.{corner}]", f"joints = {joints}", f"foot = {foot.text}"]
    return "\n".join(lines) + "\n"


def _list(names: list[str]) -> str:
    return "[" + ", ".join(f'"{name}"' for name in names) + "]"
