"""From a robot's file to its body, ready to stand on the board, and to its numbers.

Whatever a maker's model brings of actuators, sensors, contacts, keyframes and surroundings is
left out; in their place come position servos, an IMU and four spheres as feet.
"""

import dataclasses
import importlib.util
import math
from pathlib import Path
from typing import NamedTuple

import mujoco
import numpy as np

from mjx_balance.robots.file import Foot, LegFile, RobotError, RobotFile
from mjx_balance.robots.record import OUR_LEVER, OUR_MASS, Leg, Robot

VISUAL_GROUP, FOOT_GROUP = 2, 3
GYRO, ACCELEROMETER = "gyro", "accelerometer"
IMU = "balance_imu"
LEVEL = math.cos(math.radians(1.0))
"""Cosine of what an axis may be off the one that the kinematics take it for."""

# Our own robot's (robots/quadruped.toml), which is chosen; others' follow from it.
OUR_LEG, OUR_HALF_TRACK, OUR_HEIGHT = 0.426, 0.142, 0.35
OUR_STIFFNESS, OUR_DAMPING, OUR_ARMATURE = 400.0, 16.0, 0.02
OUR_ACTION = 0.003  # paper Eq. 3
STRETCH = 0.77
"""Of the legs' length that they stand at: 0.35 m for ours (paper 3.1)."""
INCLINE = 7.0
"""On both axes at once, deg, that the legs must be able to follow (paper 3.1)."""


def scene_dir() -> Path:
    """Folder of our MJCF files: in the installed package, or beside it in a checkout."""
    package = Path(__file__).resolve().parent.parent
    installed = package / "scenes"
    return installed if installed.is_dir() else package.parent / "scenes"


def model_path(model: str, folder: Path) -> Path:
    """Finds a model file; see `RobotFile.model`.

    Raises:
      RobotError: if there is none.
    """
    where, colon, inside = model.partition(":")
    if not colon or len(where) == 1:  # a drive's letter
        path = folder / model
    elif where == "scenes":
        path = scene_dir() / inside
    elif where == "menagerie":
        path = _menagerie(inside)
    else:
        spec = importlib.util.find_spec(where)
        if spec is None or not spec.submodule_search_locations:
            raise RobotError(
                f"model is {model!r}, but the Python package {where!r} is not installed"
            )
        path = Path(spec.submodule_search_locations[0]) / inside
    if not path.is_file():
        raise RobotError(f"model is {model!r}, but there is no file {path}")
    return path


def _menagerie(name: str) -> Path:
    try:
        import mujoco_menagerie
    except ImportError:
        raise RobotError(
            f"robot menagerie:{name} needs the package mujoco-menagerie; "
            "`pip install mjx-balance[robots]` brings it"
        ) from None
    try:
        robot = mujoco_menagerie.get(name)
        return robot.xml(robot.default_model)
    except (mujoco_menagerie.MenagerieError, OSError) as error:
        raise RobotError(f"robot menagerie:{name} cannot be had: {error}") from error


def read_model(path: Path) -> mujoco.MjSpec:
    """Reads a model file; raises `RobotError` with MuJoCo's own words."""
    try:
        return mujoco.MjSpec.from_file(str(path))
    except ValueError as error:
        raise RobotError(f"{path} cannot be read: {_first_line(error)}") from error


def build(file: RobotFile, visual: bool = False) -> tuple[mujoco.MjSpec, Robot]:
    """The robot's body, its trunk's frame at the origin with x forward, and its numbers.

    Args:
      file: what is known of it.
      visual: whether to keep the geoms that are only looked at.

    Raises:
      RobotError: if file and model do not fit together, or make no robot of this kind.
    """
    try:
        return _build(file, visual)
    except RobotError as error:
        raise RobotError(f"robot {file.name}: {error}") from error


def _build(file: RobotFile, visual: bool) -> tuple[mujoco.MjSpec, Robot]:
    spec = read_model(model_path(file.model, file.folder))
    trunk = _find(spec.bodies, file.trunk, "trunk", "bodies")
    free = [j for j in trunk.joints if j.type == mujoco.mjtJoint.mjJNT_FREE]
    if not free:
        raise RobotError(f"trunk {file.trunk!r} has no free joint; it must be free to move")
    _strip(spec, trunk, file)
    feet = {leg.name: _foot(spec, leg.foot, leg.name) for leg in file.legs}
    radius = _foot_radius(file, feet)
    _keep_inertia(spec, trunk)
    spheres = [_sphere(foot, name, radius) for name, foot in feet.items()]
    names = [sphere.name for sphere in spheres]
    _leave_geoms(spec, trunk, spheres, visual)
    # A foot on a body of its own, with no joint, would slide more: MuJoCo sets friction's softness
    # by what it takes a contact's body for, the light tip of a leg or all of its calf.
    spec.fuse_static()
    bare = _compiled(spec)
    _check_joints(bare, file)
    if _align(spec, trunk, bare, file):
        bare = _compiled(spec)
    robot = _measured(file, bare, names, radius)
    _equip(spec, robot, _imu(spec, trunk, bare, file))
    return spec, robot


def _compiled(spec: mujoco.MjSpec) -> mujoco.MjModel:
    try:
        return spec.compile()
    except ValueError as error:
        raise RobotError(f"its model cannot be compiled: {_first_line(error)}") from error


def _first_line(error: Exception) -> str:
    return (str(error).strip().splitlines() or ["no reason given"])[0]


def _find(elements: list, name: str, what: str, kind: str):
    for element in elements:
        if element.name == name:
            return element
    names = [x.name for x in elements if x.name and x.name != "world"]
    shown = ", ".join(names[:20]) + (", ..." if len(names) > 20 else "")
    raise RobotError(f"{what} is {name!r}, which its model does not have; its {kind}: {shown}")


def _strip(spec: mujoco.MjSpec, trunk: mujoco.MjsBody, file: RobotFile) -> None:
    """Removes what the file asks for, and everything around the robot."""
    for name in file.strip:
        bodies = [b for b in spec.bodies if b.name == name]
        joints = [j for j in spec.joints if j.name == name]
        if not bodies and not joints:
            raise RobotError(f"strip names {name!r}, which is no body and no joint of its model")
        _forget_moved(spec, name)
        for element in (*bodies, *joints):
            spec.delete(element)
    world = spec.worldbody
    around = [b for b in world.bodies if b.name != trunk.name]
    around += [*world.geoms, *world.sites, *spec.lights, *spec.cameras]
    around += [*spec.keys, *spec.sensors, *spec.excludes, *spec.pairs, *spec.equalities]
    for element in around:
        spec.delete(element)
    usual = mujoco.MjSpec()
    for size in ("nkey", "nconmax", "njmax", "nuserdata", "memory"):
        setattr(spec, size, getattr(usual, size))


def _forget_moved(spec: mujoco.MjSpec, name: str) -> None:
    """Drops the actuators of a joint, or of all joints of a body and below it."""
    joints = {name}
    for body in spec.bodies:
        if body.name == name:
            below = [body, *body.find_all(mujoco.mjtObj.mjOBJ_BODY)]
            joints |= {j.name for x in below for j in x.joints}
    for actuator in [a for a in spec.actuators if a.target in joints]:
        spec.delete(actuator)


class _Found(NamedTuple):
    """A foot in its model."""

    body: mujoco.MjsBody
    pos: np.ndarray
    """(3,) in the body's frame, m."""
    sphere: mujoco.MjsGeom | None
    """The geom, if it is one."""


def _foot(spec: mujoco.MjSpec, foot: Foot, leg: str) -> _Found:
    if foot.offset is not None:
        body = _find(spec.bodies, foot.name, f"foot of leg {leg}", "bodies")
        return _Found(body, np.asarray(foot.offset), None)
    for geom in spec.geoms:
        if geom.name == foot.name:
            sphere = geom if geom.type == mujoco.mjtGeom.mjGEOM_SPHERE else None
            return _Found(geom.parent, np.array(geom.pos), sphere)
    for site in spec.sites:
        if site.name == foot.name:
            return _Found(site.parent, np.array(site.pos), None)
    for body in spec.bodies:
        if body.name == foot.name:
            return _Found(body, np.zeros(3), None)
    raise RobotError(
        f"foot of leg {leg} is {foot.name!r}, which is no geom, site or body of its model"
    )


def _foot_radius(file: RobotFile, feet: dict[str, _Found]) -> float:
    if file.foot_radius is not None:
        return file.foot_radius
    sizes = {name: foot.sphere.size[0] for name, foot in feet.items() if foot.sphere is not None}
    missing = [name for name in feet if name not in sizes]
    if missing:
        raise RobotError(f"foot of leg {missing[0]} is not a sphere geom; say foot_radius, in m")
    if max(sizes.values()) - min(sizes.values()) > 1e-4:
        raise RobotError(f"the feet have different radii, {sizes}; say foot_radius, in m")
    return float(next(iter(sizes.values())))


def _keep_inertia(spec: mujoco.MjSpec, trunk: mujoco.MjsBody) -> None:
    """Writes down what bodies get from geoms, which may go."""
    bodies = [trunk, *trunk.find_all(mujoco.mjtObj.mjOBJ_BODY)]
    by_geoms = spec.compiler.inertiafromgeom == mujoco.mjtInertiaFromGeom.mjINERTIAFROMGEOM_TRUE
    asked = [b for b in bodies if by_geoms or not b.explicitinertial]
    if any(geom.mass != 0 for body in asked for geom in body.geoms):
        model = _compiled(spec)
        for body in asked:
            if model.body_mass[body.id]:
                body.mass, body.inertia = model.body_mass[body.id], model.body_inertia[body.id]
                body.ipos, body.iquat = model.body_ipos[body.id], model.body_iquat[body.id]
                body.fullinertia = [np.nan, 0, 0, 0, 0, 0]
                body.explicitinertial = True
    spec.compiler.inertiafromgeom = mujoco.mjtInertiaFromGeom.mjINERTIAFROMGEOM_AUTO


def _sphere(foot: _Found, leg: str, radius: float) -> mujoco.MjsGeom:
    """The foot's own sphere, or a new one in its place."""
    if foot.sphere is not None and abs(foot.sphere.size[0] - radius) < 1e-6:
        return foot.sphere
    size = [radius, 0, 0]
    return foot.body.add_geom(
        name=f"{leg}_contact",
        type=mujoco.mjtGeom.mjGEOM_SPHERE,
        pos=foot.pos,
        size=size,
        rgba=[0, 0, 0, 0],
        mass=0,
    )


def _leave_geoms(
    spec: mujoco.MjSpec, trunk: mujoco.MjsBody, feet: list[mujoco.MjsGeom], visual: bool
) -> None:
    """Leaves the feet, which only the board touches, and what is looked at, if wanted."""
    kept = {x.name for x in feet}
    others = [g for g in spec.geoms if g.name not in kept]
    solid = [g for g in others if g.contype or g.conaffinity]
    looks = [g for g in others if not (g.contype or g.conaffinity)]
    shown = (looks or solid) if visual else []
    for geom in (*looks, *solid) if not visual else solid if looks else ():
        spec.delete(geom)
    for geom in (*shown, *feet):
        geom.contype = geom.conaffinity = 0
        geom.mass = 0
    for geom in feet:
        geom.group = FOOT_GROUP
    for geom in shown:
        geom.group = VISUAL_GROUP
    if not visual:
        for geom in feet:
            geom.material = ""
        for asset in (*spec.meshes, *spec.materials, *spec.textures, *spec.hfields):
            spec.delete(asset)


def _check_joints(model: mujoco.MjModel, file: RobotFile) -> None:
    """Every hinge belongs to a leg, and every leg is a chain that ends in its foot."""
    moving = [model.joint(k).name for k in range(model.njnt) if model.jnt_type[k] != 0]
    for leg in file.legs:
        name, above = leg.name, model.body(file.trunk).id
        for joint in leg.joints:
            if joint not in moving:
                raise RobotError(
                    f"joint {joint!r} of leg {name} is none of its model's; they are: "
                    f"{', '.join(moving)}"
                )
            if model.joint(joint).type[0] != mujoco.mjtJoint.mjJNT_HINGE:
                raise RobotError(f"joint {joint!r} of leg {name} is no hinge")
            body = int(model.jnt_bodyid[model.joint(joint).id])
            if above not in ancestors(model, body):
                raise RobotError(
                    f"joint {joint!r} of leg {name} does not hang on {model.body(above).name!r}; "
                    "joints go from the trunk down: abduction, hip, knee"
                )
            above = body
    listed = {joint for leg in file.legs for joint in leg.joints}
    extra = [name for name in moving if name not in listed]
    if extra:
        raise RobotError(f"joint {extra[0]!r} is in no leg; strip it, and it is fixed")


def ancestors(model: mujoco.MjModel, body: int) -> list[int]:
    """The bodies that a body hangs on, without itself, up to the world."""
    found = []
    while body:
        body = int(model.body_parentid[body])
        found.append(body)
    return found


class _Pose:
    """The bare robot with given joint angles, seen from its trunk's frame."""

    def __init__(self, model: mujoco.MjModel, trunk: str, angles: dict[str, float]):
        self.model, self.data = model, mujoco.MjData(model)
        free = model.body(trunk).jntadr[0]
        self.data.qpos[:] = 0
        self.data.qpos[model.jnt_qposadr[free] + 3] = 1
        for name, angle in angles.items():
            self.data.joint(name).qpos = angle
        mujoco.mj_kinematics(model, self.data)

    def anchor(self, joint: str) -> np.ndarray:
        """Where it is, (3,) m."""
        return self.data.joint(joint).xanchor.copy()

    def axis(self, joint: str) -> np.ndarray:
        """Its direction, (3,) unit."""
        return self.data.joint(joint).xaxis.copy()

    def foot(self, geom: str) -> np.ndarray:
        """Where it is, (3,) m."""
        return self.data.geom(geom).xpos.copy()


def _align(
    spec: mujoco.MjSpec, trunk: mujoco.MjsBody, model: mujoco.MjModel, file: RobotFile
) -> bool:
    """Puts the trunk at the origin and turns what it carries, so that x is forward.

    Forward is from the hind hips to the front ones; where the file does not tell them apart,
    the longer side of the hips' rectangle, toward positive x or y.

    Returns:
      Whether anything was turned.
    """
    pose = _Pose(model, file.trunk, {})
    hips = {leg.name: pose.anchor(leg.joints[0])[:2] for leg in file.legs}
    ends = {leg.end for leg in file.legs}
    if None in ends:
        if len(ends) > 1:
            raise RobotError("end is said of some legs only; say it of all, or of none")
        spread = np.ptp(list(hips.values()), axis=0)
        forward = np.eye(2)[np.argmax(spread)]
    else:
        front = [hips[leg.name] for leg in file.legs if leg.end == "front"]
        hind = [hips[leg.name] for leg in file.legs if leg.end == "hind"]
        if len(front) != 2:
            raise RobotError(f"{len(front)} legs have end front; two must, and two hind")
        forward = np.mean(front, axis=0) - np.mean(hind, axis=0)
    quarters = round(math.degrees(math.atan2(forward[1], forward[0])) / 90)
    trunk.pos, trunk.quat = [0, 0, 0], [1, 0, 0, 0]
    trunk.alt.type = mujoco.mjtOrientation.mjORIENTATION_QUAT
    if not quarters % 4:
        return False
    half = -quarters * math.pi / 4
    turn = np.asarray([math.cos(half), 0, 0, math.sin(half)])
    body = model.body(file.trunk)
    centre, quat = np.zeros(3), np.zeros(4)
    mujoco.mju_rotVecQuat(centre, body.ipos, turn)
    mujoco.mju_mulQuat(quat, turn, body.iquat)
    trunk.ipos, trunk.iquat, trunk.inertia = centre, quat, body.inertia
    trunk.mass, trunk.fullinertia = body.mass[0], [np.nan, 0, 0, 0, 0, 0]
    trunk.explicitinertial = True
    frames = list(trunk.frames)
    carried = [*trunk.bodies, *trunk.geoms, *trunk.sites]
    turned = trunk.add_frame(quat=turn)
    for element in (*frames, *carried):
        if element.frame is None:
            element.set_frame(turned)
    return True


def _measured(file: RobotFile, model: mujoco.MjModel, feet: list[str], radius: float) -> Robot:
    legs = tuple(_leg(file, model, leg, foot) for leg, foot in zip(file.legs, feet, strict=True))
    _check_corners(file, legs)
    trunk = model.body(file.trunk)
    mass = _clean(trunk.subtreemass[0])
    hips = [joint for leg in legs for joint in leg.joints[:2]]
    hip_torque = file.hip_torque or min(_torque(model, x) for x in hips)
    knee_torque = file.knee_torque or min(_torque(model, leg.joints[2]) for leg in legs)
    robot = Robot(
        name=file.name,
        legs=legs,
        trunk=file.trunk,
        foot_radius=radius,
        trunk_mass=_clean(trunk.mass[0]),
        total_mass=mass,
        hip_torque=hip_torque,
        knee_torque=knee_torque,
        foot_friction=file.foot_friction,
        # What follows takes their place.
        servo_stiffness=0.0,
        servo_damping=0.0,
        servo_armature=0.0,
        body_height=0.0,
        action_max=0.0,
    )
    sized = {"body_height": file.body_height or _body_height(robot)}
    sized["action_max"] = _digits(OUR_ACTION * robot.lever / OUR_LEVER)
    stiffer = _stiffer(robot, sized["body_height"])
    sized["servo_stiffness"] = _digits(OUR_STIFFNESS * stiffer)
    sized["servo_damping"] = _digits(OUR_DAMPING * stiffer)
    sized["servo_armature"] = _digits(OUR_ARMATURE * stiffer)
    said = {name: getattr(file, name) or value for name, value in sized.items()}
    return dataclasses.replace(robot, **said)


def _body_height(robot: Robot) -> float:
    """Where its legs are at `STRETCH` of their length, m.

    Or as near to it as the joints and a board at `INCLINE` on both axes allow.
    """
    room = math.tan(math.radians(INCLINE)) * (robot.half_length + robot.half_track)
    low, high = robot.height_range
    if high - low < 2 * room:
        raise RobotError(
            f"too short for the board: its legs reach from {low:.3f} to {high:.3f} m, but "
            f"{INCLINE:g} deg on both axes at once take {room:.3f} m up and down"
        )
    stretched = [
        leg.drop - leg.axis_height + STRETCH * (leg.thigh + leg.calf) for leg in robot.legs
    ]
    wanted = robot.foot_radius + float(np.mean(stretched))
    return round(min(max(wanted, low + room), high - room), 3)


def _stiffer(robot: Robot, height: float) -> float:
    """Servo gains against our own robot's.

    Rolling is the softest of its motions: a mass m at a height h, on legs of a length l whose
    feet are a half-track y from the middle, held by joints of a stiffness k, does so at a
    frequency that goes with sqrt(k / m) * y / (l * h). It must have died out as early in a
    decision as ours, whatever the size, for the gyro to read the board's own rate then.
    """
    leg = float(np.mean([leg.thigh + leg.calf for leg in robot.legs]))
    longer = (leg * height / robot.half_track) / (OUR_LEG * OUR_HEIGHT / OUR_HALF_TRACK)
    return robot.total_mass / OUR_MASS * longer**2


def _digits(value: float) -> float:
    """To three significant digits: what follows from a rule is no more exact than the rule."""
    return float(f"{value:.3g}")


def _leg(file: RobotFile, model: mujoco.MjModel, said: LegFile, foot: str) -> Leg:
    """Measures a leg, first as the model draws it, then with the hip's axis level."""
    name, joints = said.name, said.joints
    calf = int(model.jnt_bodyid[model.joint(joints[2]).id])
    holder = int(model.geom(foot).bodyid[0])
    if calf not in (holder, *ancestors(model, holder)):
        raise RobotError(
            f"foot of leg {name} hangs on body {model.body(holder).name!r}; it must hang on what "
            f"joint {joints[2]!r} moves, {model.body(calf).name!r}"
        )
    pose = _Pose(model, file.trunk, {})
    abduction = pose.axis(joints[0])
    if abs(abduction[0]) < LEVEL:
        raise RobotError(
            f"joint {joints[0]!r} of leg {name} turns about {_vector(abduction)} of the trunk; an "
            "abduction turns about forward, (1, 0, 0) or (-1, 0, 0)"
        )
    hip = pose.axis(joints[1])
    hip = hip * np.sign(hip[1] or 1.0)
    tilt = math.atan2(hip[2], hip[1])
    sign = float(np.sign(abduction[0]))
    pose = _Pose(model, file.trunk, {joints[0]: -sign * tilt})
    signs = [sign]
    for joint, what in zip(joints[1:], ("hip", "knee"), strict=True):
        axis = pose.axis(joint)
        if abs(axis[1]) < LEVEL:
            raise RobotError(
                f"joint {joint!r} of leg {name} turns about {_vector(axis)} of the trunk; a "
                f"{what} turns about the left, (0, 1, 0) or (0, -1, 0)"
            )
        signs.append(float(np.sign(axis[1])))
    at, hip, knee = (pose.anchor(joint) for joint in joints)
    end = pose.foot(foot)
    thigh, shank = knee - hip, end - knee
    leaning = [math.atan2(-v[0], -v[2]) for v in (thigh, shank)]
    zeros = (_clean(tilt), _clean(leaning[0]), _clean(_wrapped(leaning[1] - leaning[0])))
    return Leg(
        name=name,
        left=bool(end[1] > 0),
        front=bool(hip[0] > 0),
        joints=joints,
        foot=foot,
        x=_clean(hip[0]),
        y=_clean(end[1]),
        axis_height=_clean(at[2]),
        drop=_clean(at[2] - hip[2]),
        offset=_clean(end[1] - at[1]),
        thigh=_clean(math.hypot(thigh[0], thigh[2])),
        calf=_clean(math.hypot(shank[0], shank[2])),
        signs=(signs[0], signs[1], signs[2]),
        zeros=zeros,
        knee=_knee_range(model, joints, signs, zeros, thigh, shank),
    )


FREE_KNEE = (-2.7, -0.1)
"""Turns of a knee without limits, rad: backward, short of straight and of the thigh."""


def _knee_range(
    model: mujoco.MjModel,
    joints: tuple[str, str, str],
    signs: list[float],
    zeros: tuple[float, float, float],
    thigh: np.ndarray,
    shank: np.ndarray,
) -> tuple[float, float]:
    """Turns of the knee within its limits and the hip's, on the side that has more of them."""
    a, b = (math.hypot(v[0], v[2]) for v in (thigh, shank))
    limits = []
    for joint, sign, zero in zip(joints[1:], signs[1:], zeros[1:], strict=True):
        one = model.joint(joint)
        free = not model.jnt_limited[one.id]
        ends = (-math.inf, math.inf) if free else sorted(sign * one.range + zero)
        limits.append(ends)
    (hip_low, hip_high), (low, high) = limits
    if math.isinf(low):
        low, high = FREE_KNEE
    elif -low > high:
        high = min(high, FREE_KNEE[1]) if high > 0 else high
    else:
        low = max(low, -FREE_KNEE[1]) if low < 0 else low
    turns = np.linspace(low, high, 2001)
    leans = -np.arctan2(b * np.sin(turns), a + b * np.cos(turns))
    good = turns[(leans >= hip_low) & (leans <= hip_high)]
    if not len(good):
        raise RobotError(
            f"joint {joints[1]!r} cannot turn far enough to keep its foot under the hip"
        )
    return _clean(good[0]), _clean(good[-1])


def _clean(value: float) -> float:
    """Without the last digits, which differ from machine to machine."""
    return round(float(value), 9) + 0.0


def _wrapped(angle: float) -> float:
    """To -pi .. pi."""
    return math.remainder(angle, 2 * math.pi)


def _vector(v: np.ndarray) -> str:
    return "(" + ", ".join(f"{x + 0:.2f}" for x in v) + ")"


def _check_corners(file: RobotFile, legs: tuple[Leg, ...]) -> None:
    corners: dict[tuple[bool, bool], str] = {}
    for said, leg in zip(file.legs, legs, strict=True):
        for word, found, options in (
            (said.side, leg.left, ("left", "right")),
            (said.end, leg.front, ("front", "hind")),
        ):
            placed = options[0] if found else options[1]
            if word not in (None, placed):
                raise RobotError(f"leg {leg.name} is said to be {word}, but it stands {placed}")
        corner = (leg.left, leg.front)
        if corner in corners:
            place = f"{'front' if leg.front else 'hind'} {'left' if leg.left else 'right'}"
            raise RobotError(
                f"legs {corners[corner]} and {leg.name} both stand {place}; each corner has one"
            )
        corners[corner] = leg.name


UNLIMITED = 1e4
"""Torque of servos that neither file nor model limit, N m."""


def _torque(model: mujoco.MjModel, joint: str) -> float:
    """What the model's own actuators can do at a joint, N m."""
    number = model.joint(joint).id
    limits = []
    if model.jnt_actfrclimited[number]:
        limits.append(np.abs(model.jnt_actfrcrange[number]).max())
    for k in range(model.nu):
        moves = model.actuator_trntype[k] == mujoco.mjtTrn.mjTRN_JOINT
        if not moves or model.actuator_trnid[k, 0] != number:
            continue
        gear = abs(model.actuator_gear[k, 0])
        if model.actuator_forcelimited[k]:
            limits.append(gear * np.abs(model.actuator_forcerange[k]).max())
        motor = (
            model.actuator_gaintype[k] == mujoco.mjtGain.mjGAIN_FIXED
            and model.actuator_biastype[k] == mujoco.mjtBias.mjBIAS_NONE
        )
        if motor and model.actuator_ctrllimited[k]:
            gain = model.actuator_gainprm[k, 0]
            limits.append(gear * gain * np.abs(model.actuator_ctrlrange[k]).max())
    return float(min(limits, default=UNLIMITED))


def _equip(spec: mujoco.MjSpec, robot: Robot, site: str) -> None:
    """Gives the robot its servos and its IMU."""
    for element in [*spec.actuators, *spec.tendons]:
        spec.delete(element)
    for joint in spec.joints:
        driven = joint.type != mujoco.mjtJoint.mjJNT_FREE
        joint.damping = [robot.servo_damping * driven, 0, 0]
        joint.armature = robot.servo_armature * driven
        joint.stiffness, joint.frictionloss = [0, 0, 0], 0
        joint.actfrclimited = mujoco.mjtLimited.mjLIMITED_FALSE
    for leg in robot.legs:
        torques = (robot.hip_torque, robot.hip_torque, robot.knee_torque)
        for name, torque in zip(leg.joints, torques, strict=True):
            servo = spec.add_actuator(
                name=name,
                target=name,
                trntype=mujoco.mjtTrn.mjTRN_JOINT,
                forcelimited=mujoco.mjtLimited.mjLIMITED_TRUE,
                forcerange=[-torque, torque],
            )
            servo.set_to_position(kp=robot.servo_stiffness)
    for name, kind in (
        (GYRO, mujoco.mjtSensor.mjSENS_GYRO),
        (ACCELEROMETER, mujoco.mjtSensor.mjSENS_ACCELEROMETER),
    ):
        spec.add_sensor(name=name, type=kind, objtype=mujoco.mjtObj.mjOBJ_SITE, objname=site)


def _imu(spec: mujoco.MjSpec, trunk: mujoco.MjsBody, model: mujoco.MjModel, file: RobotFile) -> str:
    """Name of a site on the trunk with x forward, y left, z up."""
    place = np.asarray(file.imu if isinstance(file.imu, tuple) else (0.0, 0.0, 0.0))
    if isinstance(file.imu, str):
        _find(spec.sites, file.imu, "imu", "sites")
        site = model.site(file.imu)
        holder = model.body(int(site.bodyid[0])).name
        if holder != trunk.name:
            raise RobotError(f"imu {file.imu!r} is on body {holder!r}, not on the trunk")
        if np.allclose(site.quat, (1, 0, 0, 0)):
            return site.name
        place = site.pos
    trunk.add_site(name=IMU, pos=place)
    return IMU
