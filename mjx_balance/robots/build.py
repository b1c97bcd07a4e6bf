"""Builds a robot's body from its file, ready to attach to the scene.

Actuators, sensors, contacts, keyframes and surroundings of the maker's model are removed, and
position servos, an IMU and four foot spheres are added.
"""

import importlib.util
import math
from pathlib import Path
from typing import Any, NamedTuple

import mujoco
import numpy as np

from mjx_balance.files.text import MESSAGE, quote, shorten
from mjx_balance.robots.measure import Pose, check_joints, measure
from mjx_balance.robots.robot import Robot
from mjx_balance.robots.schema import Foot, RobotError, RobotFile

VISUAL_GROUP, FOOT_GROUP = 2, 3
GYRO, ACCELEROMETER = "gyro", "accelerometer"
IMU = "balance_imu"
BOARD_SIZE = "board_size"
"""Name of the model's numeric element with `RobotFile.board_size`."""
RADIUS_TOLERANCE = 1e-4
"""Greatest difference between the radii of the feet, m."""


def scene_dir() -> Path:
    """Returns the folder of our MJCF files, in the package or, in a checkout, beside it."""
    package = Path(__file__).resolve().parent.parent
    installed = package / "scenes"
    return installed if installed.is_dir() else package.parent / "scenes"


def model_path(model: str, folder: Path) -> Path:
    """Finds a model file.

    Args:
      model: `RobotFile.model`.
      folder: folder that a relative path starts from.

    Raises:
      RobotError: if there is none.
    """
    where, colon, inside = model.partition(":")
    if not colon or len(where) == 1:  # no prefix, or the letter of a Windows drive
        path = folder / model
    elif where == "scenes":
        path = scene_dir() / inside
    elif where == "menagerie":
        path = _menagerie(inside)
    else:
        path = _package(where, model) / inside
    if "\0" in model or not path.is_file():
        raise RobotError(f"model is {quote(model)}, but there is no file {path}")
    return path


def _package(name: str, model: str) -> Path:
    """Folder of an installed Python package."""
    try:
        spec = importlib.util.find_spec(name)
    except (ImportError, ValueError):  # its parent package is missing; it is no package name
        spec = None
    if spec is None or not spec.submodule_search_locations:
        raise RobotError(
            f"model is {quote(model)}, but the Python package {quote(name)} is not installed; "
            "before a colon stands a package, and a file's path has none"
        )
    return Path(spec.submodule_search_locations[0])


def _menagerie(name: str) -> Path:
    try:
        import mujoco_menagerie
    except ImportError:
        raise RobotError(
            f"robot menagerie:{name} needs the package mujoco-menagerie; the extra robots brings "
            "it: `pip install -e '.[robots]'` in a checkout, or `pip install 'WHEEL[robots]'`"
        ) from None
    try:
        robot = mujoco_menagerie.get(name)
        return robot.xml(robot.default_model)
    except (mujoco_menagerie.MenagerieError, OSError) as error:
        raise RobotError(f"robot menagerie:{name} cannot be had: {error}") from error


def read_model(path: Path) -> mujoco.MjSpec:
    """Reads a model file; no visual geom is discarded and no static body is fused.

    The root of a URDF gets a free joint if it has no joint.

    Raises:
      RobotError: with MuJoCo's message.
    """
    try:
        spec = mujoco.MjSpec.from_file(str(path))
    except ValueError as error:
        raise RobotError(f"{path} cannot be read: {mujoco_message(error)}") from error
    spec.compiler.discardvisual = spec.compiler.fusestatic = False  # True by default for URDF
    if path.suffix.lower() == ".urdf":
        for root in spec.worldbody.bodies:
            if not root.joints:
                root.add_freejoint()
    return spec


def mujoco_message(error: Exception) -> str:
    """MuJoCo's error message in one line; its later lines name the element."""
    lines = (line.strip() for line in str(error).splitlines())
    return shorten("; ".join(line for line in lines if line), MESSAGE)


def build(file: RobotFile, visual: bool = False) -> tuple[mujoco.MjSpec, Robot]:
    """Builds a robot.

    Args:
      file: the robot's file.
      visual: whether to keep the visual geoms.

    Returns:
      The body, its trunk's frame at the origin with x forward, and the robot's numbers.

    Raises:
      RobotError: if file and model do not match, or the model is no four-legged robot.
    """
    try:
        return _build(file, visual)
    except RobotError as error:
        raise RobotError(f"robot {file.name}: {error}") from error


def _build(file: RobotFile, visual: bool) -> tuple[mujoco.MjSpec, Robot]:
    spec = read_model(model_path(file.model, file.folder))
    trunk = _find(spec.bodies[1:], file.trunk, "trunk", "bodies")
    free = [j for j in trunk.joints if j.type == mujoco.mjtJoint.mjJNT_FREE]
    if not free:
        raise RobotError(f"trunk {quote(file.trunk)} has no free joint; {_remedy(trunk)}")
    _keep_inertia(spec, trunk)
    _strip(spec, trunk, file)
    feet = {leg.name: _foot(spec, leg.foot, leg.name) for leg in file.legs}
    radius = _foot_radius(file, feet)
    spheres = _spheres(spec, feet, radius)
    names = [sphere.name for sphere in spheres]
    _leave_geoms(spec, trunk, spheres, visual)
    # MuJoCo scales the softness of friction with the weight of the body in contact. A foot on a
    # light body of its own, without a joint, would slide more than one on the calf.
    spec.fuse_static()
    bare = _compiled(spec)
    check_joints(bare, file)
    if _align(spec, trunk, bare, file):
        bare = _compiled(spec)
    robot = measure(file, bare, names, radius)
    _equip(spec, robot, _imu(spec, trunk, bare, file))
    if file.board_size is not None:
        spec.add_numeric(name=BOARD_SIZE, data=[file.board_size])
    return spec, robot


def _remedy(trunk: mujoco.MjsBody) -> str:
    """The end of the message that the trunk has no free joint."""
    root = trunk
    while root.parent.name != "world":
        root = root.parent
    if any(j.type == mujoco.mjtJoint.mjJNT_FREE for j in root.joints):
        return f"it hangs on body {quote(root.name)}, which has one and is the trunk"
    return "it must be free to move; give it a <freejoint/> in its model"


def _compiled(spec: mujoco.MjSpec) -> mujoco.MjModel:
    try:
        return spec.compile()
    except ValueError as error:
        raise RobotError(f"its model cannot be compiled: {mujoco_message(error)}") from error


def _find(elements: list, name: str, what: str, kind: str):
    for element in elements:
        if element.name == name:
            return element
    names = shorten(", ".join(x.name for x in elements if x.name), MESSAGE)
    raise RobotError(f"{what} is {quote(name)}, which its model does not have; its {kind}: {names}")


def _strip(spec: mujoco.MjSpec, trunk: mujoco.MjsBody, file: RobotFile) -> None:
    """Removes what the file strips, and everything but the robot's bodies, joints and geoms."""
    bodies, joints = _strip_elements(spec, trunk, file)
    gone = {joint.name for body in bodies for joint in _joints_below(body)}
    gone |= {joint.name for joint in joints}
    for leg in file.legs:
        for joint in [x for x in leg.joints if x in gone]:
            raise RobotError(
                f"strip takes joint {quote(joint)} of leg {leg.name}, which the leg needs"
            )
    usual = (mujoco.mjtTrn.mjTRN_JOINT, mujoco.mjtTrn.mjTRN_JOINTINPARENT)
    for actuator in [a for a in spec.actuators if a.trntype not in usual or a.target in gone]:
        spec.delete(actuator)
    # Elements that refer to others are deleted before those.
    refer = [*spec.keys, *spec.sensors, *spec.excludes, *spec.pairs, *spec.equalities]
    refer += [*spec.tuples, *spec.numerics, *spec.texts, *spec.tendons, *spec.skins, *spec.flexes]
    for element in (*refer, *joints):
        spec.delete(element)
    for body in bodies:
        spec.delete(body)
    world = spec.worldbody
    around = [b for b in world.bodies if b.name != trunk.name]
    around += [*world.geoms, *world.sites, *spec.lights, *spec.cameras]
    for element in around:
        spec.delete(element)
    fresh = mujoco.MjSpec()
    for size in ("nkey", "nconmax", "njmax", "nuserdata", "memory"):
        setattr(spec, size, getattr(fresh, size))


def _strip_elements(
    spec: mujoco.MjSpec, trunk: mujoco.MjsBody, file: RobotFile
) -> tuple[list[mujoco.MjsBody], list[mujoco.MjsJoint]]:
    """The outermost bodies that the file strips, and the joints that none of them carries."""
    carries, body = {"world"}, trunk
    while body.name != "world":
        carries.add(body.name)
        body = body.parent
    bodies = {b.name: b for b in spec.bodies if b.name in file.strip}
    joints = {j.name: j for j in spec.joints if j.name in file.strip}
    for name in file.strip:
        if name not in bodies and name not in joints:
            raise RobotError(
                f"strip names {quote(name)}, which is no body and no joint of its model"
            )
        if name in carries:
            raise RobotError(f"strip names {quote(name)}, which is, or carries, the trunk")
        if name in [j.name for j in trunk.joints]:
            raise RobotError(f"strip names {quote(name)}, by which the trunk is free; it must be")
    below = {x.name for b in bodies.values() for x in b.find_all(mujoco.mjtObj.mjOBJ_BODY)}
    outer = [b for b in bodies.values() if b.name not in below]
    gone = {j.name for b in outer for j in _joints_below(b)}
    return outer, [j for j in joints.values() if j.name not in gone]


def _joints_below(body: mujoco.MjsBody) -> list[mujoco.MjsJoint]:
    """Joints of a body and of its descendants."""
    return [j for x in (body, *body.find_all(mujoco.mjtObj.mjOBJ_BODY)) for j in x.joints]


class _FootPlace(NamedTuple):
    """Where the model has a foot."""

    body: mujoco.MjsBody
    pos: tuple[float, float, float]
    """In the body's frame, m; unused with `element`, whose place the compiled model knows."""
    element: mujoco.MjsGeom | mujoco.MjsSite | None
    """The geom or site that the file names."""

    @property
    def sphere(self) -> mujoco.MjsGeom | None:
        geom = self.element if isinstance(self.element, mujoco.MjsGeom) else None
        return geom if geom and geom.type == mujoco.mjtGeom.mjGEOM_SPHERE else None


def _foot(spec: mujoco.MjSpec, foot: str | Foot, leg: str) -> _FootPlace:
    origin = (0.0, 0.0, 0.0)
    if isinstance(foot, Foot):
        body = _find(spec.bodies[1:], foot.body, f"foot of leg {leg}", "bodies")
        return _FootPlace(body, foot.offset, None)
    for element in (*spec.geoms, *spec.sites):
        if element.name == foot:
            return _FootPlace(element.parent, origin, element)
    for body in spec.bodies:
        if body.name == foot:
            return _FootPlace(body, origin, None)
    raise RobotError(
        f"foot of leg {leg} is {quote(foot)}, which is no geom, site or body of its model"
    )


def _foot_radius(file: RobotFile, feet: dict[str, _FootPlace]) -> float:
    if file.foot_radius is not None:
        return file.foot_radius
    sizes = {name: float(x.sphere.size[0]) for name, x in feet.items() if x.sphere is not None}
    missing = [name for name in feet if name not in sizes]
    if missing:
        raise RobotError(f"foot of leg {missing[0]} is not a sphere geom; say foot_radius, in m")
    if max(sizes.values()) - min(sizes.values()) > RADIUS_TOLERANCE:
        listed = ", ".join(f"{name} {size:.4g}" for name, size in sizes.items())
        raise RobotError(f"the feet have different radii, {listed}; say foot_radius, in m")
    return next(iter(sizes.values()))


def _keep_inertia(spec: mujoco.MjSpec, trunk: mujoco.MjsBody) -> None:
    """Makes explicit the inertia that bodies get from their geoms and from compiler options.

    The geoms may be deleted later.
    """
    bodies = [trunk, *trunk.find_all(mujoco.mjtObj.mjOBJ_BODY)]
    compiler = spec.compiler
    by_geoms = compiler.inertiafromgeom == mujoco.mjtInertiaFromGeom.mjINERTIAFROMGEOM_TRUE
    bounds = compiler.boundmass > 0 or compiler.boundinertia > 0
    changed = compiler.settotalmass > 0 or bounds or compiler.balanceinertia
    asked = [b for b in bodies if by_geoms or changed or not b.explicitinertial]
    if changed or any(geom.mass != 0 for body in asked for geom in body.geoms):
        model = _compiled(spec)
        for body in asked:
            if model.body_mass[body.id]:
                body.mass, body.inertia = model.body_mass[body.id], model.body_inertia[body.id]
                body.ipos, body.iquat = model.body_ipos[body.id], model.body_iquat[body.id]
                body.fullinertia = [np.nan, 0, 0, 0, 0, 0]
                body.explicitinertial = True
    compiler.inertiafromgeom = mujoco.mjtInertiaFromGeom.mjINERTIAFROMGEOM_AUTO
    compiler.settotalmass, compiler.boundmass, compiler.boundinertia = -1, 0, 0
    compiler.balanceinertia = False


def _spheres(
    spec: mujoco.MjSpec, feet: dict[str, _FootPlace], radius: float
) -> list[mujoco.MjsGeom]:
    """The sphere of each foot: the model's if its radius fits, else a new one."""
    own = {
        name: foot.sphere
        for name, foot in feet.items()
        if foot.sphere is not None and abs(foot.sphere.size[0] - radius) < 1e-6
    }
    places = {name: foot.pos for name, foot in feet.items()}
    drawn = {name: x.element for name, x in feet.items() if x.element and name not in own}
    if drawn:  # only the compiled model knows where these are
        model = _compiled(spec)
        for name, element in drawn.items():
            geom = isinstance(element, mujoco.MjsGeom)
            places[name] = (model.geom_pos if geom else model.site_pos)[element.id]
    spheres = []
    for name, foot in feet.items():
        sphere = own.get(name)
        if sphere is None:
            sphere = foot.body.add_geom(name=_free_name(spec.geoms, f"{name}_contact"))
            _reset_defaults(sphere, mujoco.MjSpec().worldbody.add_geom())
            sphere.type = mujoco.mjtGeom.mjGEOM_SPHERE
            sphere.pos, sphere.size, sphere.mass = places[name], [radius, 0, 0], 0
            sphere.rgba = [0, 0, 0, 0]
        spheres.append(sphere)
    return spheres


def _free_name(elements: list, name: str) -> str:
    """`name`, with underscores added until no element has it."""
    names = {element.name for element in elements}
    while name in names:
        name += "_"
    return name


def _reset_defaults(element: Any, fresh: Any) -> None:
    """Replaces the values that a new element took from the model's default class.

    Args:
      element: a new geom, site or actuator.
      fresh: a new one of an empty model, with MuJoCo's defaults.
    """
    for field in dir(fresh):
        value = getattr(fresh, field)
        ours = field.startswith("_") or field in ("id", "signature", "name")
        if not ours and (isinstance(value, str) or hasattr(value, "__int__")):
            setattr(element, field, value)
    if hasattr(fresh, "alt"):
        element.alt.type = mujoco.mjtOrientation.mjORIENTATION_QUAT


def _leave_geoms(
    spec: mujoco.MjSpec, trunk: mujoco.MjsBody, feet: list[mujoco.MjsGeom], visual: bool
) -> None:
    """Deletes all geoms but the feet and, with `visual`, those that show the robot.

    Without visual geoms in the model, the collision geoms show it. No geom that is left collides by
    itself: contact pairs join the feet and the board.
    """
    own = {x.name for x in feet}
    others = [g for g in spec.geoms if g.name not in own]
    solid = [g for g in others if g.contype or g.conaffinity]
    looks = [g for g in others if not (g.contype or g.conaffinity)]
    visible = (looks or solid) if visual else []
    for geom in (*looks, *solid) if not visual else solid if looks else ():
        spec.delete(geom)
    for geom in (*visible, *feet):
        geom.contype = geom.conaffinity = 0
        geom.mass = 0
    for geom in feet:
        geom.group = FOOT_GROUP
    for geom in visible:
        geom.group = VISUAL_GROUP
    if not visual:
        for element in (*feet, *spec.sites):
            element.material = ""
        for asset in (*spec.meshes, *spec.materials, *spec.textures, *spec.hfields):
            spec.delete(asset)


def _align(
    spec: mujoco.MjSpec, trunk: mujoco.MjsBody, model: mujoco.MjModel, file: RobotFile
) -> bool:
    """Moves the trunk to the origin, and turns its contents by quarter turns to make x forward.

    Forward is from the hind hips to the front ones. If the file does not name the ends, it is the
    longer side of the hips' rectangle, toward positive x or y.

    Returns:
      Whether anything was turned.
    """
    pose = Pose(model, file.trunk, {})
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
        _check_ends(file, hips, pose)
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


def _check_ends(file: RobotFile, hips: dict[str, np.ndarray], pose: Pose) -> None:
    """Checks that the front legs stand at one end of the trunk, along the abductions' axis."""
    turns = [np.abs(pose.axis(leg.joints[0])[:2]) for leg in file.legs]
    along = int(np.argmax(np.sum(turns, axis=0)))
    middle = np.mean(list(hips.values()), axis=0)[along]
    front = [leg.name for leg in file.legs if leg.end == "front"]
    if len({bool(hips[name][along] > middle) for name in front}) == 2:
        raise RobotError(
            f"legs {' and '.join(front)} are said to be front, but they stand at different ends of "
            "the trunk; correct end of one of them, and of a hind leg"
        )


def _equip(spec: mujoco.MjSpec, robot: Robot, site: str) -> None:
    """Adds servos and IMU, and removes passive joint forces other than the servos' damping."""
    for element in [*spec.actuators]:
        spec.delete(element)
    for body in spec.bodies:
        body.gravcomp = 0
    for joint in spec.joints:
        driven = joint.type != mujoco.mjtJoint.mjJNT_FREE
        joint.damping = [robot.servo_damping * driven, 0, 0]
        joint.armature = robot.servo_armature * driven
        joint.stiffness, joint.frictionloss = [0, 0, 0], 0
        joint.springdamper, joint.actgravcomp = [0, 0], False
        joint.actfrclimited = mujoco.mjtLimited.mjLIMITED_FALSE
    for leg in robot.legs:
        torques = (robot.hip_torque, robot.hip_torque, robot.knee_torque)
        for name, torque in zip(leg.joints, torques, strict=True):
            servo = spec.add_actuator(name=name)
            _reset_defaults(servo, mujoco.MjSpec().add_actuator())
            servo.target, servo.trntype = name, mujoco.mjtTrn.mjTRN_JOINT
            servo.forcelimited = mujoco.mjtLimited.mjLIMITED_TRUE
            servo.forcerange = [-torque, torque]
            servo.set_to_position(kp=robot.servo_stiffness)
    for name, kind in (
        (GYRO, mujoco.mjtSensor.mjSENS_GYRO),
        (ACCELEROMETER, mujoco.mjtSensor.mjSENS_ACCELEROMETER),
    ):
        spec.add_sensor(name=name, type=kind, objtype=mujoco.mjtObj.mjOBJ_SITE, objname=site)


def _imu(spec: mujoco.MjSpec, trunk: mujoco.MjsBody, model: mujoco.MjModel, file: RobotFile) -> str:
    """Name of the IMU's site on the trunk, with x forward, y left, z up; adds it if needed."""
    place = np.asarray(file.imu if isinstance(file.imu, tuple) else (0.0, 0.0, 0.0))
    if isinstance(file.imu, str):
        _find(spec.sites, file.imu, "imu", "sites")
        site = model.site(file.imu)
        holder = model.body(int(site.bodyid[0])).name
        if holder != trunk.name:
            raise RobotError(f"imu {quote(file.imu)} is on body {quote(holder)}, not on the trunk")
        if np.allclose(site.quat, (1, 0, 0, 0)):
            return site.name
        place = site.pos
    new = trunk.add_site(name=_free_name(spec.sites, IMU))
    _reset_defaults(new, mujoco.MjSpec().worldbody.add_site())
    new.pos = place
    return new.name
