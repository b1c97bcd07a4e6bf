"""Drafts a robot's TOML file from its model; legs are recognised by their kinematic structure."""

import itertools
import json
import re
from collections.abc import Iterable, Iterator, Sequence
from pathlib import Path
from typing import NamedTuple

import mujoco
import numpy as np

from mjx_balance.errors import quote, shorten
from mjx_balance.robots.build import RADIUS_TOLERANCE, strip_elements
from mjx_balance.robots.measure import ancestors
from mjx_balance.robots.model import compile_model, naming, read_model
from mjx_balance.robots.schema import RobotError, parse_robot_file

HEADER = """\
# Drafted from the model's structure; a corner's letters say front or rear, left or right.
# `mjx-balance robot check FILE` builds it, says what it found, and draws a picture.
"""
USUAL_RADIUS = 0.02  #: radius of a foot that is no sphere, m
CALF_RADII = 8  #: least length of a calf, in radii of its foot
MIN_REACH = 0.85
"""Least distance of a foot from the knee, as a share of the calf's length; a sphere or site that
is nearer is no foot."""
SIZES = {mujoco.mjtJoint.mjJNT_FREE: 7, mujoco.mjtJoint.mjJNT_BALL: 4}  #: positions of a joint
NAMELESS, MISSING = "?", ('["ABDUCTION", "HIP", "KNEE"]', '"FOOT"')
GIVE = "give it one in its model, for the file to use"
ENDS = {"front": "front|fore|f[lr]|[lr]f", "hind": "rear|hind|back|[rhb][lr]|[lr][hb]"}
"""What names of joints call the ends of a robot, as words of their own."""
CORNERS = {"FL": "front left", "FR": "front right", "RL": "rear left", "RR": "rear right"}


class _Foot(NamedTuple):
    text: str  #: value of `foot` in the file, TOML
    place: np.ndarray  #: in the world, (3,) m
    radius: float  #: m
    sphere: bool = False  #: whether `text` names a sphere geom, which gives the radius


class _Leg(NamedTuple):
    """Three hinges on three nested bodies, with no other joint on them, and a foot."""

    joints: list[int]
    foot: _Foot
    length: float  #: of thigh and calf, m
    like_a_leg: bool  #: whether the axes of hip and knee are parallel, and across the first


def draft(model: str, path: Path) -> str:
    """Returns the text of a robot file.

    Args:
      model: value of `model` in the file.
      path: path of the model.

    Raises:
      RobotError: if the model cannot be read, its trunk is not free, a corner has no leg or two,
        or a joint has no name.
    """
    text, problems = sketch(model, path)
    if problems:
        raise RobotError(problems[0])
    parse_robot_file(text, path)
    return text


def sketch(model: str, path: Path, strip: Sequence[str] = ()) -> tuple[str, list[str]]:
    """Drafts a robot file, as far as the model allows.

    Args:
      model: value of `model` in the file.
      path: path of the model.
      strip: bodies to leave out, and joints to fix.

    Returns:
      The text, and what the user has to complete, one sentence each; the text names it as well,
      with incomplete lines as comments.

    Raises:
      RobotError: if the model cannot be read, or has nothing that could be a leg.
    """
    with naming(f"{path.name} cannot be drafted from"):
        return _sketch(model, path, strip)


def _sketch(model: str, path: Path, strip: Sequence[str]) -> tuple[str, list[str]]:
    places: dict[str, float] = {}

    def take_out(spec: mujoco.MjSpec) -> None:
        places.update(_places(spec))
        strip_elements(spec, strip)

    spec = read_model(path, strip=take_out).spec
    problems = []
    if not any(joint.type == mujoco.mjtJoint.mjJNT_FREE for joint in spec.joints):
        roots = spec.worldbody.bodies
        root = max(roots, key=lambda x: len(x.find_all("body")), default=None)
        if root is None:
            raise RobotError(f"{path.name} has no body")
        inside = f"write <freejoint/> into its body {quote(root.name)}, in place of joints it has"
        if root.joints and path.suffix.lower() == ".urdf":
            name = root.joints[0].name.removesuffix("_TX")  # MuJoCo's for a planar joint's first
            inside = f"leave out its joint {quote(name)}, or make it floating"
        elif sum(bool(x.joints) for x in roots) > 3:
            inside = f"put its bodies, such as {quote(root.name)}, into one with a <freejoint/>"
        problems.append(f"{path.name} has no free joint; its trunk must be free to move: {inside}")
        for joint in root.joints:
            spec.delete(joint)
        root.add_freejoint()
    compiled = compile_model(spec, path.name)
    data = mujoco.MjData(compiled)
    mujoco.mj_kinematics(compiled, data)
    free = compiled.jnt_bodyid[compiled.jnt_type == mujoco.mjtJoint.mjJNT_FREE]
    trunk = max(free.tolist(), key=lambda body: _legs_and_mass(compiled, body))
    legs = _legs(compiled, data, trunk, path, problems)
    text = _render(compiled, data, model, trunk, legs, strip, places, problems)
    mend = "".join(f"# To mend: {problem}.\n" for problem in problems)
    return HEADER + mend + text, problems


def _legs_and_mass(model: mujoco.MjModel, body: int) -> tuple[int, float]:
    """What tells a robot from what lies about: the number of its legs, four at most, then mass."""
    chains = sum(limb.chain for limb in _limbs(model, body))
    return min(chains, 4), float(model.body_subtreemass[body])


def _places(spec: mujoco.MjSpec) -> dict[str, float]:
    """Positions of hinges and slides, by name, in keyframe `home`, or the first; rad or m."""
    keys = list(spec.keys)
    if not keys:
        return {}
    qpos = list(next((key for key in keys if key.name == "home"), keys[0]).qpos)
    places, start = {}, 0
    for joint in spec.worldbody.find_all(mujoco.mjtObj.mjOBJ_JOINT):  # as they are compiled
        size = SIZES.get(joint.type, 1)
        if size == 1:
            places[joint.name] = start
        start += size
    if start != len(qpos):  # a keyframe need not say any
        return {}
    return {name: qpos[at] for name, at in places.items()}


def _legs(
    model: mujoco.MjModel, data: mujoco.MjData, trunk: int, path: Path, problems: list[str]
) -> list[_Leg]:
    """The four lowest chains of three hinges; says where others could be legs as well."""
    limbs = list(_limbs(model, trunk))
    chains = [limb for limb in limbs if limb.chain]
    legs = [_leg(model, data, limb.joints, limb.calf) for limb in chains]
    legs = sorted(legs, key=lambda leg: leg.foot.place[2])
    first = legs[:4]
    if len(first) < 4:
        names = _names(model, [leg.joints[0] for leg in legs]) or "none"
        problem = f"{path.name} has {len(legs)} chains of three hinges below its trunk ({names})"
        if not limbs:
            raise RobotError(f"{problem}, and no other joint; it is no legged robot")
        other = max((x.joints for x in limbs if not x.chain), key=len, default=[])
        remedy = "a robot of this kind has four legs of three: abduction, hip, knee"
        if sum(len(x.joints) >= 3 for x in limbs) >= 4:
            remedy = "fix joints, or leave bodies out, by `robot new --strip NAME`"
        limb = f", and a limb of {_names(model, other)}" if other else ""
        problems.append(f"{problem}{limb}; {remedy}")
        return first
    hips = [data.xanchor[leg.joints[0], 2] for leg in first]
    length = max(leg.length for leg in first)
    if np.ptp(hips) > length / 2:
        problems.append(
            f"{path.name} has chains of three hinges that begin {np.ptp(hips):.2f} m above others; "
            "they are arms, and a robot of this kind has four legs"
        )
    lowest = max(leg.foot.place[2] for leg in first)
    low = [x for x in legs if x.like_a_leg and x.foot.place[2] < lowest + length / 2]
    if len(low) > 4:
        names = _names(model, [leg.joints[0] for leg in low])
        problems.append(
            f"{path.name} has {len(low)} chains that could be legs ({names}); a robot of this kind "
            "has four: leave the bodies of others out by `robot new --strip NAME`"
        )
    return first


class _Limb(NamedTuple):
    """The joints below a body on which none above moves but the trunk's."""

    joints: list[int]
    calf: list[int]  #: the last joint's body, with the bodies fixed to it
    chain: bool  #: whether these are three hinges on three nested bodies, with no other joint


def _names(model: mujoco.MjModel, joints: list[int]) -> str:
    return shorten(", ".join(model.joint(k).name or "(no name)" for k in joints), 120)


def _limbs(model: mujoco.MjModel, trunk: int) -> Iterator[_Limb]:
    above = [ancestors(model, body) for body in range(model.nbody)]
    moving = [b for b in range(model.nbody) if model.body_jntnum[b] and trunk in above[b]]
    for start in moving:
        if not set(moving).isdisjoint(above[start]):
            continue
        links = [b for b in moving if start in (b, *above[b])]
        joints = [k for k in range(model.njnt) if model.jnt_bodyid[k] in links]
        hinges = all(model.jnt_type[k] == mujoco.mjtJoint.mjJNT_HINGE for k in joints)
        nested = all(a in above[b] for a, b in itertools.pairwise(links))
        calf = [b for b in range(model.nbody) if links[-1] in (b, *above[b])]
        yield _Limb(joints, calf, len(joints) == len(links) == 3 and hinges and nested)


def _leg(model: mujoco.MjModel, data: mujoco.MjData, joints: list[int], calf: list[int]) -> _Leg:
    foot = _foot(model, data, data.xanchor[joints[2]], calf)
    points = [*data.xanchor[joints[1:]], foot.place]
    abduction, hip, knee = data.xaxis[joints]
    return _Leg(
        joints,
        foot,
        length=sum(float(np.linalg.norm(b - a)) for a, b in itertools.pairwise(points)),
        like_a_leg=bool(abs(hip @ knee) > 0.9 and abs(abduction @ hip) < 0.5),
    )


def _foot(model: mujoco.MjModel, data: mujoco.MjData, knee: np.ndarray, calf: list[int]) -> _Foot:
    """The sphere furthest from the knee, else the furthest site or geom point."""

    def distance(place: np.ndarray) -> float:
        return float(np.linalg.norm(place - knee))

    geoms = [g for g in range(model.ngeom) if model.geom_bodyid[g] in calf]
    points = np.concatenate([_points(model, data, g) for g in geoms] or [data.xpos[calf[-1:]]])
    furthest = points[np.argmax(np.linalg.norm(points - knee, axis=1))]

    def select(ids: list[int], places: np.ndarray) -> int | None:
        """The furthest one that is far enough to be a foot."""
        far = [k for k in ids if distance(places[k]) >= MIN_REACH * distance(furthest)]
        return max(far, key=lambda k: distance(places[k]), default=None)

    spheres = [g for g in geoms if model.geom_type[g] == mujoco.mjtGeom.mjGEOM_SPHERE]
    sphere = select(spheres, data.geom_xpos)
    if sphere is not None:
        geom, place, radius = model.geom(sphere), data.geom_xpos[sphere], model.geom_size[sphere, 0]
        if geom.name:
            return _Foot(_toml(geom.name), place, radius, True)
        return _Foot(_offset(model, data, int(geom.bodyid[0]), place), place, radius)
    sites = [s for s in range(model.nsite) if model.site_bodyid[s] in calf]
    site = select([s for s in sites if model.site(s).name], data.site_xpos)
    radius = min(USUAL_RADIUS, distance(furthest) / CALF_RADII)
    if site is not None:
        return _Foot(_toml(model.site(site).name), data.site_xpos[site], radius)
    place = furthest - radius * (furthest - knee) / max(distance(furthest), radius, 1e-9)
    return _Foot(_offset(model, data, calf[0], place), place, radius)


def _points(model: mujoco.MjModel, data: mujoco.MjData, geom: int) -> np.ndarray:
    """A mesh's vertices, or face centres of another geom's box, in the world, (points, 3) m."""
    turn, centre = data.geom_xmat[geom].reshape(3, 3), data.geom_xpos[geom]
    if model.geom_type[geom] == mujoco.mjtGeom.mjGEOM_MESH:
        mesh = model.geom_dataid[geom]
        first = model.mesh_vertadr[mesh]
        points = model.mesh_vert[first : first + model.mesh_vertnum[mesh]]
    else:
        middle, half = model.geom_aabb[geom, :3], model.geom_aabb[geom, 3:]
        points = middle + np.concatenate((np.diag(half), -np.diag(half)))
    return centre + points @ turn.T


def _offset(model: mujoco.MjModel, data: mujoco.MjData, body: int, place: np.ndarray) -> str:
    at = data.xmat[body].reshape(3, 3).T @ (place - data.xpos[body])
    numbers = ", ".join(f"{x + 0.0:.4g}" for x in at)
    return f"{{ body = {_toml(model.body(body).name)}, offset = [{numbers}] }}"


def _toml(name: str) -> str:
    text = json.dumps(name or NAMELESS, ensure_ascii=False)
    return "".join(x if x.isprintable() else f"\\U{ord(x):08x}" for x in text)


def _joints(model: mujoco.MjModel, joints: Iterable[int]) -> str:
    """Names of joints as a TOML array."""
    return f"[{', '.join(_toml(model.joint(k).name) for k in joints)}]"


class _Corners(NamedTuple):
    legs: dict[str, _Leg]  #: the leg of each corner
    along_y: bool  #: whether the model looks along its y, as its abductions turn
    backward: bool  #: whether it looks against that axis, as its joints' names say


def _said_end(name: str) -> str | None:
    """The end of the robot that a joint's name tells."""
    words = [
        end for end, words in ENDS.items() if re.search(f"(?<![a-z])({words})(?![a-z])", name, re.I)
    ]
    return words[0] if len(words) == 1 else None


def _corners(
    model: mujoco.MjModel, data: mujoco.MjData, trunk: int, legs: list[_Leg], problems: list[str]
) -> _Corners:
    if not legs:
        return _Corners({}, False, False)
    turn = data.xmat[trunk].reshape(3, 3).T
    hips = np.array([turn @ (data.xanchor[leg.joints[0]] - data.xpos[trunk]) for leg in legs])
    axes = [turn @ data.xaxis[leg.joints[0]] for leg in legs]
    forward = int(np.argmax(np.abs(axes).sum(axis=0)[:2]))
    hips -= np.mean(hips, axis=0)
    by_name = [_said_end(model.joint(leg.joints[0]).name) for leg in legs]
    by_place = ["hind" if hip[forward] > 0 else "front" for hip in hips]
    backward = by_name == by_place
    if backward:
        hips[:, :2] *= -1
    corners: dict[str, _Leg] = {}
    for hip, leg in zip(hips, legs, strict=True):
        ahead, left = hip[forward], hip[1] if forward == 0 else -hip[0]
        corner = ("F" if ahead > 0 else "R") + ("L" if left > 0 else "R")
        other = corners.setdefault(corner, leg)
        if other is not leg:
            both = _joints(model, (other.joints[0], leg.joints[0]))
            problems.append(
                f"the legs of joints {both} both stand {CORNERS[corner]}; each corner has one"
            )
    return _Corners(corners, forward == 1, backward)


def _fixed(model: mujoco.MjModel, joint: int, places: dict[str, float]) -> str:
    """Entry of `strip` that fixes a joint at its place of `_places`."""
    name, zero = model.joint(joint).name, model.qpos0[model.jnt_qposadr[joint]]
    at = places.get(name, zero)
    return _toml(name) if at == zero else f"{{ joint = {_toml(name)}, at = {at:.6g} }}"


def _render(
    model: mujoco.MjModel,
    data: mujoco.MjData,
    name: str,
    trunk: int,
    legs: list[_Leg],
    strip: Sequence[str],
    places: dict[str, float],
    problems: list[str],
) -> str:
    corners, along_y, backward = _corners(model, data, trunk, legs, problems)
    if not model.body(trunk).name:
        problems.append(f"the body of the free joint, the trunk, has no name; {GIVE}")
    lines = [f"model = {_toml(name)}", f"trunk = {_toml(model.body(trunk).name)}"]
    if along_y or backward:
        axis = f"{'-' if backward else ''}{'y' if along_y else 'x'}"
        lines.append(
            f'# Looks along its {axis}, it seems; if not, say end = "front" or "hind" of all legs.'
        )
    imus = [model.site(s).name for s in range(model.nsite) if model.site_bodyid[s] == trunk]
    lines += [f"imu = {_toml(imu)}" for imu in imus if "imu" in imu.lower()][:1]
    used = {joint for leg in legs for joint in leg.joints}
    hinges = np.flatnonzero(model.jnt_type != mujoco.mjtJoint.mjJNT_FREE)
    fixed = [_fixed(model, int(k), places) for k in hinges if k not in used]
    if fixed or strip:
        entries = ", ".join((*map(_toml, strip), *fixed))
        line = f"strip = [{entries}]  # fixed; a body's name instead leaves it out"
        lines.append(f"# {line}" if problems else line)
    feet = [leg.foot for leg in legs]
    radii = [foot.radius for foot in feet]
    if feet and (np.ptp(radii) > RADIUS_TOLERANCE or not all(foot.sphere for foot in feet)):
        lines.append(f"foot_radius = {max(radii):.4g}")
    for corner in CORNERS:
        leg = corners.get(corner)
        joints, foot = MISSING if leg is None else (_joints(model, leg.joints), leg.foot.text)
        lines += ["", f"[legs.{corner}]", f"joints = {joints}", f"foot = {foot}"]
        if backward:
            lines.append(f'end = "{"front" if corner[0] == "F" else "hind"}"')
        for k in leg.joints if leg else ():
            if not model.joint(k).name:
                holder = quote(model.body(int(model.jnt_bodyid[k])).name)
                problems.append(f"a joint of body {holder} has no name; {GIVE}")
        if leg and NAMELESS in leg.foot.text:
            problems.append(f"the body that holds the foot of leg {corner} has no name; {GIVE}")
    mend = (*MISSING, _toml(NAMELESS))
    lines = [f"# {line}" if any(x in line for x in mend) else line for line in lines]
    return "\n".join(lines) + "\n"
