"""Builds a robot's body from its file, ready to attach to the scene.

Actuators, sensors, contacts, keyframes and surroundings of the maker's model are removed, and
position servos, an IMU and four foot spheres are added.
"""

import functools
import importlib.util
import math
from pathlib import Path
from typing import NamedTuple

import mujoco
import numpy as np

from mjx_balance.errors import how_to_install
from mjx_balance.files.text import MESSAGE, quote, shorten
from mjx_balance.robots.measure import JOINT_ACTUATORS, check_joints, measure, pose
from mjx_balance.robots.robot import Robot
from mjx_balance.robots.schema import Foot, LegFile, RobotError, RobotFile

FRESH = mujoco.MjSpec()  #: MuJoCo's own defaults, for elements that we add to a maker's model
VISUAL_GROUP, FOOT_GROUP = 2, 3
GYRO, ACCELEROMETER = "gyro", "accelerometer"
BOARD_SIZE = "board_size"  #: name of the model's numeric element with `RobotFile.board_size`
REMOVED = (
    *("keys", "sensors", "excludes", "pairs", "equalities", "tuples", "numerics", "texts"),
    *("tendons", "skins", "flexes", "lights", "cameras"),
)
"""Elements of the maker's model that are removed; what refers to others goes before those."""
RADIUS_TOLERANCE = 1e-4  #: greatest difference between the radii of the feet, m


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
            f"robot menagerie:{name} needs the package mujoco-menagerie; {how_to_install('robots')}"
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
        raise RobotError(f"{path} cannot be read: {_mujoco_message(error)}") from error
    spec.compiler.discardvisual = spec.compiler.fusestatic = False  # True by default for URDF
    if path.suffix.lower() == ".urdf":
        for root in spec.worldbody.bodies:
            if not root.joints:
                root.add_freejoint()
    return spec


def compile_model(spec: mujoco.MjSpec, subject: str = "its model") -> mujoco.MjModel:
    """Compiles a model; raises `RobotError` with MuJoCo's message about `subject`."""
    try:
        return spec.compile()
    except ValueError as error:
        raise RobotError(f"{subject} cannot be compiled: {_mujoco_message(error)}") from error


def _mujoco_message(error: Exception) -> str:
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
    feet = {leg.name: _foot(spec, leg) for leg in file.legs}
    radius = _foot_radius(file, feet)
    spheres = _spheres(spec, feet, radius)
    names = [sphere.name for sphere in spheres]
    _leave_geoms(spec, spheres, visual)
    # MuJoCo scales the softness of friction with the weight of the body in contact. A foot on a
    # light body of its own, without a joint, would slide more than one on the calf.
    spec.fuse_static()
    bare = compile_model(spec)
    check_joints(bare, file)
    if _align(spec, trunk, bare, file):
        bare = compile_model(spec)
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


def _find(elements: list, name: str, what: str, kind: str):
    for element in elements:
        if element.name == name:
            return element
    names = shorten(", ".join(x.name for x in elements if x.name), MESSAGE)
    raise RobotError(f"{what} is {quote(name)}, which its model does not have; its {kind}: {names}")


def _strip(spec: mujoco.MjSpec, trunk: mujoco.MjsBody, file: RobotFile) -> None:
    """Removes what the file strips, and everything but the robot's bodies, joints and geoms."""
    for kind in REMOVED:
        for element in list(getattr(spec, kind)):
            spec.delete(element)
    _strip_elements(spec, trunk, file)
    for actuator in list(spec.actuators):
        if actuator.trntype not in JOINT_ACTUATORS or spec.joint(actuator.target) is None:
            spec.delete(actuator)
    world = spec.worldbody
    around = [body for body in world.bodies if body.name != trunk.name]
    for element in (*around, *world.geoms, *world.sites):
        spec.delete(element)
    for size in ("nkey", "nconmax", "njmax", "nuserdata", "memory"):
        setattr(spec, size, getattr(FRESH, size))


def _strip_elements(spec: mujoco.MjSpec, trunk: mujoco.MjsBody, file: RobotFile) -> None:
    """Removes the bodies and joints that the file strips, with all that refers to them."""
    joints = {joint.name for joint in spec.joints}
    names = joints | {body.name for body in spec.bodies}
    for name in file.strip:
        if name not in names:
            raise RobotError(
                f"strip names {quote(name)}, which is no body and no joint of its model"
            )
        if name in [joint.name for joint in trunk.joints]:
            raise RobotError(f"strip names {quote(name)}, by which the trunk is free; it must be")
        for find in (spec.body, spec.joint):  # a body takes its joints along
            element = find(name)
            if element is not None and name != "world":
                spec.delete(element)
        if name == "world" or spec.body(file.trunk) is None:
            raise RobotError(f"strip names {quote(name)}, which is, or carries, the trunk")
    gone = joints - {joint.name for joint in spec.joints}
    for leg in file.legs:
        for joint in [x for x in leg.joints if x in gone]:
            raise RobotError(
                f"strip takes joint {quote(joint)} of leg {leg.name}, which the leg needs"
            )


class _FootPlace(NamedTuple):
    """Where the model has a foot."""

    body: mujoco.MjsBody
    element: mujoco.MjsGeom | mujoco.MjsSite | None = None  #: the geom or site that the file names
    offset: tuple[float, float, float] = (0.0, 0.0, 0.0)  #: in the body's frame, m

    @property
    def sphere(self) -> mujoco.MjsGeom | None:
        geom = self.element if isinstance(self.element, mujoco.MjsGeom) else None
        return geom if geom and geom.type == mujoco.mjtGeom.mjGEOM_SPHERE else None


def _foot(spec: mujoco.MjSpec, leg: LegFile) -> _FootPlace:
    foot = leg.foot
    if isinstance(foot, Foot):
        body = _find(spec.bodies[1:], foot.body, f"foot of leg {leg.name}", "bodies")
        return _FootPlace(body, offset=foot.offset)
    element = spec.geom(foot) or spec.site(foot)
    if element is not None:
        return _FootPlace(element.parent, element)
    body = spec.body(foot)
    if body is None:
        raise RobotError(
            f"foot of leg {leg.name} is {quote(foot)}, which is no geom, site or body of its model"
        )
    return _FootPlace(body)


def _foot_radius(file: RobotFile, feet: dict[str, _FootPlace]) -> float:
    if file.foot_radius is not None:
        return file.foot_radius
    sizes: dict[str, float] = {}
    for name, foot in feet.items():
        if foot.sphere is None:
            raise RobotError(f"foot of leg {name} is not a sphere geom; say foot_radius, in m")
        sizes[name] = float(foot.sphere.size[0])
    if max(sizes.values()) - min(sizes.values()) > RADIUS_TOLERANCE:
        listed = ", ".join(f"{name} {size:.4g}" for name, size in sizes.items())
        raise RobotError(f"the feet have different radii, {listed}; say foot_radius, in m")
    return next(iter(sizes.values()))


def _keep_inertia(spec: mujoco.MjSpec, trunk: mujoco.MjsBody) -> None:
    """Makes explicit the inertia from geoms, which may be deleted later, and compiler options."""
    bodies = [trunk, *trunk.find_all(mujoco.mjtObj.mjOBJ_BODY)]
    compiler = spec.compiler
    by_geoms = compiler.inertiafromgeom == mujoco.mjtInertiaFromGeom.mjINERTIAFROMGEOM_TRUE
    bounds = compiler.boundmass > 0 or compiler.boundinertia > 0
    changed = compiler.settotalmass > 0 or bounds or compiler.balanceinertia
    asked = [b for b in bodies if by_geoms or changed or not b.explicitinertial]
    if changed or any(geom.mass != 0 for body in asked for geom in body.geoms):
        model = compile_model(spec)
        for body in asked:
            if model.body_mass[body.id]:
                _set_inertia(body, model)
    compiler.inertiafromgeom = mujoco.mjtInertiaFromGeom.mjINERTIAFROMGEOM_AUTO
    compiler.settotalmass, compiler.boundmass, compiler.boundinertia = -1, 0, 0
    compiler.balanceinertia = False


def _set_inertia(body: mujoco.MjsBody, model: mujoco.MjModel) -> None:
    """Gives a body the inertia that it has in the compiled model."""
    compiled = model.body(body.id)
    body.mass, body.inertia = compiled.mass[0], compiled.inertia
    body.ipos, body.iquat = compiled.ipos, compiled.iquat
    body.fullinertia = [np.nan, 0, 0, 0, 0, 0]
    body.explicitinertial = True


def _spheres(
    spec: mujoco.MjSpec, feet: dict[str, _FootPlace], radius: float
) -> list[mujoco.MjsGeom]:
    """The sphere of each foot: the model's if its radius fits, else a new one."""
    compiled = functools.cache(lambda: compile_model(spec))  # only it knows where an element is
    spheres = []
    for name, foot in feet.items():
        sphere = foot.sphere
        if sphere is None or abs(sphere.size[0] - radius) >= 1e-6:
            element = foot.element
            sphere = foot.body.add_geom(
                FRESH.default,
                name=_free_name(spec.geoms, f"{name}_contact"),
                type=mujoco.mjtGeom.mjGEOM_SPHERE,
                size=[radius, 0, 0],
                pos=foot.offset if element is None else _place(compiled(), element),
                mass=0,
                rgba=[0, 0, 0, 0],
            )
        spheres.append(sphere)
    return spheres


def _place(model: mujoco.MjModel, element: mujoco.MjsGeom | mujoco.MjsSite) -> np.ndarray:
    """Place of a geom or site in its body's frame, (3,) m."""
    named = model.geom if isinstance(element, mujoco.MjsGeom) else model.site
    return named(element.name).pos


def _free_name(elements: list, name: str) -> str:
    """`name`, with underscores added until no element has it."""
    names = {element.name for element in elements}
    while name in names:
        name += "_"
    return name


def _leave_geoms(spec: mujoco.MjSpec, feet: list[mujoco.MjsGeom], visual: bool) -> None:
    """Deletes all geoms but the feet and, with `visual`, those that show the robot.

    No geom that is left collides by itself: contact pairs join the feet and the board.
    """
    names = {foot.name for foot in feet}
    others = [geom for geom in spec.geoms if geom.name not in names]
    solid = [geom for geom in others if geom.contype or geom.conaffinity]
    hidden = others if not visual else solid if len(solid) < len(others) else []
    for geom in hidden:
        spec.delete(geom)
    for geom in spec.geoms:
        geom.contype = geom.conaffinity = geom.mass = 0
        geom.group = FOOT_GROUP if geom.name in names else VISUAL_GROUP
    if not visual:
        for element in (*feet, *spec.sites):
            element.material = ""
        for asset in (*spec.meshes, *spec.materials, *spec.textures, *spec.hfields):
            spec.delete(asset)


def _align(
    spec: mujoco.MjSpec, trunk: mujoco.MjsBody, model: mujoco.MjModel, file: RobotFile
) -> bool:
    """Moves the trunk to the origin, and turns its contents by quarter turns to make x forward.

    Returns:
      Whether anything was turned.
    """
    forward = _forward(file, pose(model, file.trunk))
    quarters = round(math.degrees(math.atan2(forward[1], forward[0])) / 90)
    trunk.pos, trunk.quat = [0, 0, 0], [1, 0, 0, 0]
    trunk.alt.type = mujoco.mjtOrientation.mjORIENTATION_QUAT
    if not quarters % 4:
        return False
    half = -quarters * math.pi / 4
    turn = np.asarray([math.cos(half), 0, 0, math.sin(half)])
    _set_inertia(trunk, model)
    centre, quat = np.zeros(3), np.zeros(4)
    mujoco.mju_rotVecQuat(centre, trunk.ipos, turn)
    mujoco.mju_mulQuat(quat, turn, trunk.iquat)
    trunk.ipos, trunk.iquat = centre, quat
    contents = [*trunk.frames, *trunk.bodies, *trunk.geoms, *trunk.sites]
    turned = trunk.add_frame(quat=turn)
    for element in contents:
        if element.frame is None:
            element.set_frame(turned)
    return True


def _forward(file: RobotFile, data: mujoco.MjData) -> np.ndarray:
    """Direction from hind to front hips, (2,); their longer side if the file names no ends."""
    abductions = [data.joint(leg.joints[0]) for leg in file.legs]
    hips = np.asarray([joint.xanchor[:2] for joint in abductions])
    ends = [leg.end for leg in file.legs]
    if not any(ends):
        return np.eye(2)[np.argmax(np.ptp(hips, axis=0))]
    if None in ends:
        raise RobotError("end is said of some legs only; say it of all, or of none")
    if ends.count("front") != 2:
        raise RobotError(f"{ends.count('front')} legs have end front; two must, and two hind")
    front = np.asarray(ends) == "front"
    along = np.argmax(np.sum([np.abs(joint.xaxis[:2]) for joint in abductions], axis=0))
    ahead = hips[front, along] > hips[:, along].mean()
    if ahead[0] != ahead[1]:
        names = " and ".join(leg.name for leg in file.legs if leg.end == "front")
        raise RobotError(
            f"legs {names} are said to be front, but they stand at different ends of the trunk; "
            "correct end of one of them, and of a hind leg"
        )
    return hips[front].mean(axis=0) - hips[~front].mean(axis=0)


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
            servo = spec.add_actuator(
                FRESH.default,
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
    """Name of the IMU's site on the trunk, with x forward, y left, z up; adds it if needed."""
    place = file.imu if isinstance(file.imu, tuple) else (0.0, 0.0, 0.0)
    if isinstance(file.imu, str):
        _find(spec.sites, file.imu, "imu", "sites")
        site = model.site(file.imu)
        holder = model.body(int(site.bodyid[0])).name
        if holder != trunk.name:
            raise RobotError(f"imu {quote(file.imu)} is on body {quote(holder)}, not on the trunk")
        if np.allclose(site.quat, (1, 0, 0, 0)):
            return site.name
        place = site.pos
    return trunk.add_site(FRESH.default, name=_free_name(spec.sites, "balance_imu"), pos=place).name
