"""Drafts a robot's TOML file from its model; legs are recognised by their kinematic structure."""

import itertools
import json
from collections.abc import Iterable, Iterator
from pathlib import Path
from typing import NamedTuple

import mujoco
import numpy as np

from mjx_balance.files.text import quote
from mjx_balance.robots.build import RADIUS_TOLERANCE, compile_model, read_model
from mjx_balance.robots.measure import ancestors
from mjx_balance.robots.schema import RobotError, parse_robot_file

HEADER = """\
# Drafted from the model's structure; a corner's letters say front or rear, left or right.
# `mjx-balance robot check FILE` builds it, says what it found, and draws a picture.
"""
USUAL_RADIUS = 0.02  #: radius of a foot that is no sphere, m
MIN_REACH = 0.85
"""Least distance of a foot from the knee, as a share of the calf's length; a sphere or site that
is nearer is no foot."""
CORNERS = {"FL": "front left", "FR": "front right", "RL": "rear left", "RR": "rear right"}


class _Leg(NamedTuple):
    """Three hinges on three nested bodies, with no other joint on them, and a foot."""

    joints: list[int]
    foot: str  #: value of `foot` in the file, TOML
    place: np.ndarray  #: of the foot in the world, (3,) m
    radius: float  #: of the foot, m
    sphere: bool = False  #: whether `foot` names a sphere geom, which gives the radius


def draft(model: str, path: Path) -> str:
    """Returns the text of a robot file.

    Args:
      model: value of `model` in the file.
      path: path of the model.

    Raises:
      RobotError: if the model cannot be read, its trunk is not free, a corner has no leg or two,
        or a joint has no name.
    """
    compiled = compile_model(read_model(path), str(path))
    data = mujoco.MjData(compiled)
    mujoco.mj_kinematics(compiled, data)
    trunk = _trunk(compiled, path)
    legs = [_leg(compiled, data, *chain) for chain in _chains(compiled, trunk)]
    legs = sorted(legs, key=lambda leg: leg.place[2])[:4]
    if len(legs) < 4:
        names = ", ".join(compiled.joint(leg.joints[0]).name for leg in legs) or "none"
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


def _chains(model: mujoco.MjModel, trunk: int) -> Iterator[tuple[list[int], list[int]]]:
    """The joints of every leg, and the last one's body with the bodies fixed to it."""
    above = [ancestors(model, body) for body in range(model.nbody)]
    moving = [b for b in range(model.nbody) if model.body_jntnum[b] and trunk in above[b]]
    for start in moving:
        if not set(moving).isdisjoint(above[start]):
            continue
        links = [b for b in moving if start in (b, *above[b])]
        joints = [k for k in range(model.njnt) if model.jnt_bodyid[k] in links]
        hinges = all(model.jnt_type[k] == mujoco.mjtJoint.mjJNT_HINGE for k in joints)
        nested = all(a in above[b] for a, b in itertools.pairwise(links))
        if len(joints) == len(links) == 3 and hinges and nested:
            calf = [b for b in range(model.nbody) if links[-1] in (b, *above[b])]
            yield joints, calf


def _leg(model: mujoco.MjModel, data: mujoco.MjData, joints: list[int], calf: list[int]) -> _Leg:
    """Its foot is the sphere furthest from the knee, else the furthest site or geom point."""
    knee = data.xanchor[joints[2]]

    def distance(place: np.ndarray) -> float:
        return float(np.linalg.norm(place - knee))

    geoms = [g for g in range(model.ngeom) if model.geom_bodyid[g] in calf]
    points = [p for g in geoms for p in _points(model, data, g)]
    furthest = max(points or [data.xpos[calf[-1]]], key=distance)

    def select(ids: list[int], places: np.ndarray) -> int | None:
        """The furthest one that is far enough to be a foot."""
        far = [k for k in ids if distance(places[k]) >= MIN_REACH * distance(furthest)]
        return max(far, key=lambda k: distance(places[k]), default=None)

    spheres = [g for g in geoms if model.geom_type[g] == mujoco.mjtGeom.mjGEOM_SPHERE]
    sphere = select(spheres, data.geom_xpos)
    if sphere is not None:
        geom, place, radius = model.geom(sphere), data.geom_xpos[sphere], model.geom_size[sphere, 0]
        if geom.name:
            return _Leg(joints, _toml(geom.name), place, radius, True)
        return _Leg(joints, _offset(model, data, int(geom.bodyid[0]), place), place, radius)
    sites = [s for s in range(model.nsite) if model.site_bodyid[s] in calf]
    site = select([s for s in sites if model.site(s).name], data.site_xpos)
    if site is not None:
        return _Leg(joints, _toml(model.site(site).name), data.site_xpos[site], USUAL_RADIUS)
    place = furthest - USUAL_RADIUS * (furthest - knee) / max(distance(furthest), USUAL_RADIUS)
    return _Leg(joints, _offset(model, data, calf[0], place), place, USUAL_RADIUS)


def _points(model: mujoco.MjModel, data: mujoco.MjData, geom: int) -> list[np.ndarray]:
    """A mesh's vertices, or the face centres of another geom's bounding box, in the world, m."""
    turn, centre = data.geom_xmat[geom].reshape(3, 3), data.geom_xpos[geom]
    if model.geom_type[geom] == mujoco.mjtGeom.mjGEOM_MESH:
        mesh = model.geom_dataid[geom]
        first = model.mesh_vertadr[mesh]
        points = model.mesh_vert[first : first + model.mesh_vertnum[mesh]]
    else:
        middle, half = model.geom_aabb[geom, :3], model.geom_aabb[geom, 3:]
        points = middle + np.concatenate((np.diag(half), -np.diag(half)))
    return list(centre + points @ turn.T)


def _offset(model: mujoco.MjModel, data: mujoco.MjData, body: int, place: np.ndarray) -> str:
    at = data.xmat[body].reshape(3, 3).T @ (place - data.xpos[body])
    numbers = ", ".join(f"{x + 0.0:.4g}" for x in at)
    name = _toml(model.body(body).name, f"body {body}, which holds a foot,")
    return f"{{ body = {name}, offset = [{numbers}] }}"


def _toml(name: str, what: str = "") -> str:
    """The name of `what` as a TOML string."""
    if not name:
        raise RobotError(f"{what} has no name; give it one in its model, for the file to use")
    return json.dumps(name, ensure_ascii=False)


def _joints(model: mujoco.MjModel, joints: Iterable[int]) -> str:
    """Names of joints as a TOML array."""
    holders = {k: model.body(int(model.jnt_bodyid[k])).name for k in joints}
    names = [_toml(model.joint(k).name, f"a joint of body {quote(holders[k])}") for k in holders]
    return f"[{', '.join(names)}]"


def _render(
    model: mujoco.MjModel, data: mujoco.MjData, name: str, trunk: int, legs: list[_Leg]
) -> str:
    turn = data.xmat[trunk].reshape(3, 3).T
    hips = [turn @ (data.xanchor[leg.joints[0]] - data.xpos[trunk]) for leg in legs]
    forward = int(np.argmax(np.ptp(hips, axis=0)[:2]))
    corners: dict[str, _Leg] = {}
    for hip, leg in zip(hips - np.mean(hips, axis=0), legs, strict=True):
        ahead, left = hip[forward], hip[1] if forward == 0 else -hip[0]
        corner = ("F" if ahead > 0 else "R") + ("L" if left > 0 else "R")
        other = corners.setdefault(corner, leg)
        if other is not leg:
            both = _joints(model, (other.joints[0], leg.joints[0]))
            raise RobotError(
                f"the legs of joints {both} both stand {CORNERS[corner]}; each corner has one"
            )
    trunks = _toml(model.body(trunk).name, "the body of the free joint, the trunk,")
    lines = [f"{HEADER}model = {_toml(name, 'the model')}", f"trunk = {trunks}"]
    if forward == 1:
        lines.append(
            '# Looks along its y, it seems; if not, say end = "front" or "hind" of all legs.'
        )
    imus = [model.site(s).name for s in range(model.nsite) if model.site_bodyid[s] == trunk]
    lines += [f"imu = {_toml(imu)}" for imu in imus if "imu" in imu.lower()][:1]
    used = {joint for leg in legs for joint in leg.joints}
    hinges = np.flatnonzero(model.jnt_type != mujoco.mjtJoint.mjJNT_FREE)
    fixed = [int(k) for k in hinges if k not in used]
    if fixed:
        lines.append(
            f"strip = {_joints(model, fixed)}  # fixed; a body's name instead leaves it out"
        )
    radii = [leg.radius for leg in legs]
    if np.ptp(radii) > RADIUS_TOLERANCE or not all(leg.sphere for leg in legs):
        lines.append(f"foot_radius = {max(radii):.4g}")
    for corner in CORNERS:
        leg = corners[corner]
        joints = _joints(model, leg.joints)
        lines += ["", f"[legs.{corner}]", f"joints = {joints}", f"foot = {leg.foot}"]
    return "\n".join(lines) + "\n"
