"""Drafts a robot's TOML file from its model; legs are recognised by their kinematic structure."""

import itertools
import json
from collections.abc import Iterable
from pathlib import Path
from typing import NamedTuple

import mujoco
import numpy as np

from mjx_balance.files.text import quote
from mjx_balance.robots.build import RADIUS_TOLERANCE, mujoco_message, read_model
from mjx_balance.robots.measure import ancestors
from mjx_balance.robots.schema import RobotError, parse_robot_file

HEADER = """\
# Drafted from the model's structure; a corner's letters say front or rear, left or right.
# `mjx-balance robot check FILE` builds it, says what it found, and draws a picture.
"""
USUAL_RADIUS = 0.02
"""Radius of a foot that is no sphere, m."""
MIN_REACH = 0.85
"""Least distance of a foot from the knee, as a share of the calf's length; a sphere or site that
is nearer is no foot."""
CORNERS = {"FL": "front left", "FR": "front right", "RL": "rear left", "RR": "rear right"}


class _Chain(NamedTuple):
    """Three hinges on three nested bodies, with no other joint on them."""

    joints: tuple[int, int, int]
    calf: list[int]
    """The body of the last joint, and the bodies fixed to it."""


class _Foot(NamedTuple):
    """The foot of a chain."""

    text: str
    """Value of `foot` in the file, TOML."""
    place: np.ndarray
    """(3,) in the world, m."""
    radius: float
    """m"""
    sphere: bool = False
    """Whether `text` names a sphere geom, which gives the radius."""


def draft(model: str, path: Path) -> str:
    """Returns the text of a robot file.

    Args:
      model: value of `model` in the file.
      path: path of the model.

    Raises:
      RobotError: if the model cannot be read, its trunk is not free, a corner has no leg or two,
        or a joint has no name.
    """
    spec = read_model(path)
    try:
        compiled = spec.compile()
    except ValueError as error:
        raise RobotError(f"{path} cannot be compiled: {mujoco_message(error)}") from error
    data = mujoco.MjData(compiled)
    mujoco.mj_kinematics(compiled, data)
    trunk = _trunk(compiled, path)
    candidates = [(chain, _foot(compiled, data, chain)) for chain in _chains(compiled, trunk)]
    legs = sorted(candidates, key=lambda leg: leg[1].place[2])[:4]
    if len(legs) < 4:
        names = ", ".join(compiled.joint(chain.joints[0]).name for chain, _ in legs) or "none"
        raise RobotError(
            f"{path} has {len(legs)} chains of three hinges below its trunk ({names}); a robot of "
            "this kind has four legs"
        )
    text = _render(compiled, data, model, trunk, legs)
    parse_robot_file(text, path)
    return text


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
    """The sphere furthest from the knee, else the furthest site, else the furthest geom point."""
    knee = data.xanchor[chain.joints[2]]

    def distance(place: np.ndarray) -> float:
        return float(np.linalg.norm(place - knee))

    geoms = [g for g in range(model.ngeom) if model.geom_bodyid[g] in chain.calf]
    points = [p for g in geoms for p in _points(model, data, g)]
    furthest = max(points or [data.xpos[chain.calf[-1]]], key=distance)
    enough = MIN_REACH * distance(furthest)
    spheres = [g for g in geoms if model.geom_type[g] == mujoco.mjtGeom.mjGEOM_SPHERE]
    spheres = [g for g in spheres if distance(data.geom_xpos[g]) >= enough]
    if spheres:
        one = max(spheres, key=lambda g: distance(data.geom_xpos[g]))
        radius, place = float(model.geom_size[one, 0]), data.geom_xpos[one]
        if model.geom(one).name:
            return _Foot(json.dumps(model.geom(one).name, ensure_ascii=False), place, radius, True)
        return _Foot(_offset(model, data, int(model.geom_bodyid[one]), place), place, radius)
    sites = [s for s in range(model.nsite) if model.site_bodyid[s] in chain.calf]
    sites = [s for s in sites if model.site(s).name and distance(data.site_xpos[s]) >= enough]
    if sites:
        one = max(sites, key=lambda s: distance(data.site_xpos[s]))
        name = json.dumps(model.site(one).name, ensure_ascii=False)
        return _Foot(name, data.site_xpos[one], USUAL_RADIUS)
    place = furthest - USUAL_RADIUS * (furthest - knee) / max(distance(furthest), USUAL_RADIUS)
    return _Foot(_offset(model, data, chain.calf[0], place), place, USUAL_RADIUS)


def _points(model: mujoco.MjModel, data: mujoco.MjData, geom: int) -> list[np.ndarray]:
    """A mesh's vertices, or the face centres of another geom's bounding box, in the world, m."""
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
    name = _name(model.body(body).name, f"body {body}, which holds a foot,")
    return f"{{ body = {name}, offset = [{numbers}] }}"


def _name(name: str, what: str) -> str:
    """A name as a TOML string."""
    if not name:
        raise RobotError(f"{what} has no name; give it one in its model, for the file to use")
    return json.dumps(name, ensure_ascii=False)


def _joints(model: mujoco.MjModel, joints: Iterable[int]) -> str:
    """Names of joints as a TOML array."""
    holders = {k: model.body(int(model.jnt_bodyid[k])).name for k in joints}
    names = [_name(model.joint(k).name, f"a joint of body {quote(holders[k])}") for k in holders]
    return f"[{', '.join(names)}]"


def _render(
    model: mujoco.MjModel,
    data: mujoco.MjData,
    name: str,
    trunk: int,
    legs: list[tuple[_Chain, _Foot]],
) -> str:
    turn = data.xmat[trunk].reshape(3, 3).T
    hips = [turn @ (data.xanchor[chain.joints[0]] - data.xpos[trunk]) for chain, _ in legs]
    forward = int(np.argmax(np.ptp(hips, axis=0)[:2]))
    corners: dict[str, tuple[_Chain, _Foot]] = {}
    for hip, leg in zip(hips - np.mean(hips, axis=0), legs, strict=True):
        ahead, left = hip[forward], hip[1] if forward == 0 else -hip[0]
        corner = ("F" if ahead > 0 else "R") + ("L" if left > 0 else "R")
        if corner in corners:
            both = _joints(model, (corners[corner][0].joints[0], leg[0].joints[0]))
            raise RobotError(
                f"the legs of joints {both} both stand {CORNERS[corner]}; each corner has one"
            )
        corners[corner] = leg
    trunks = _name(model.body(trunk).name, "the body of the free joint, the trunk,")
    lines = [f"{HEADER}model = {_name(name, 'the model')}", f"trunk = {trunks}"]
    if forward == 1:
        lines.append(
            '# Looks along its y, it seems; if not, say end = "front" or "hind" of all legs.'
        )
    imus = [model.site(s).name for s in range(model.nsite) if model.site_bodyid[s] == trunk]
    lines += [f"imu = {_name(imu, 'imu')}" for imu in imus if "imu" in imu.lower()][:1]
    used = {joint for chain, _ in legs for joint in chain.joints}
    hinges = [k for k in range(model.njnt) if model.jnt_type[k] != mujoco.mjtJoint.mjJNT_FREE]
    fixed = [k for k in hinges if k not in used]
    if fixed:
        lines.append(
            f"strip = {_joints(model, fixed)}  # fixed; a body's name instead leaves it out"
        )
    radii = [foot.radius for _, foot in legs]
    if max(radii) - min(radii) > RADIUS_TOLERANCE or not all(foot.sphere for _, foot in legs):
        lines.append(f"foot_radius = {max(radii):.4g}")
    for corner in CORNERS:
        chain, foot = corners[corner]
        joints = _joints(model, chain.joints)
        lines += ["", f"[legs.{corner}]", f"joints = {joints}", f"foot = {foot.text}"]
    return "\n".join(lines) + "\n"
