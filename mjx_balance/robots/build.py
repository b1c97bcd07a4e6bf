"""Builds a robot's body from its file, ready to attach to the scene.

Actuators, sensors, contacts, keyframes and surroundings of the maker's model are removed, and
position servos, an IMU and four foot spheres are added.
"""

import functools
import math
from collections.abc import Iterable
from typing import NamedTuple

import mujoco
import numpy as np

from mjx_balance.errors import MESSAGE, quote, shorten
from mjx_balance.robots.measure import check_joints, measure, pose
from mjx_balance.robots.model import FRESH, Coupling, compile_model, model_path, naming, read_model
from mjx_balance.robots.robot import Robot, per_joint
from mjx_balance.robots.schema import FixedJoint, Foot, LegFile, RobotError, RobotFile

VISUAL_GROUP, FOOT_GROUP = 2, 3
GYRO, ACCELEROMETER = "gyro", "accelerometer"
BOARD_SIZE = "board_size"  #: name of the model's numeric element with `RobotFile.board_size`
RADIUS_TOLERANCE = 1e-4  #: greatest difference between the radii of the feet, m


class Build(NamedTuple):
    """A robot's body and numbers."""

    spec: mujoco.MjSpec  #: the body, its trunk's frame at the origin with x forward
    robot: Robot
    notes: list[str]
    """What was mended, left out or is odd in its maker's model, one sentence each."""


def build(file: RobotFile, visual: bool = False) -> Build:
    """Builds a robot.

    Args:
      file: the robot's file.
      visual: whether to keep the visual geoms.

    Raises:
      RobotError: if file and model do not match, or the model is no four-legged robot.
    """
    try:
        with naming("its model cannot be built"):
            return _build(file, visual)
    except RobotError as error:
        raise RobotError(f"robot {file.name}: {error}") from error


def _build(file: RobotFile, visual: bool) -> Build:
    def strip_early(spec: mujoco.MjSpec) -> None:
        if spec.compiler.settotalmass <= 0:
            _strip_file(spec, file)

    path = model_path(file.model, file.folder)
    spec, couplings, notes = read_model(path, visual, strip_early)
    shares = spec.compiler.settotalmass > 0  # a body's mass is a share of the whole model's
    trunk = _find(spec.bodies[1:], file.trunk, "trunk", "bodies")
    free = [j for j in trunk.joints if j.type == mujoco.mjtJoint.mjJNT_FREE]
    if not free:
        raise RobotError(f"trunk {quote(file.trunk)} has no free joint; {_remedy(trunk)}")
    notes += _keep_inertia(spec, trunk)
    if shares:
        _strip_file(spec, file)
    _leave_robot(spec, trunk)
    notes += _left_out(spec, couplings, file)
    masses = _masses(compile_model(spec)) if notes else ""
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
    calves = [sphere.parent for sphere in spheres]
    if visual and all(geom.parent in calves for geom in spec.geoms):
        _draw_sticks(spec, bare, file, spheres)
    robot = measure(file, bare, names, radius, notes)
    if masses:
        notes.append(masses)
    _equip(spec, robot, _imu(spec, trunk, bare, file))
    if file.board_size is not None:
        spec.add_numeric(name=BOARD_SIZE, data=[file.board_size])
    return Build(spec, robot, notes)


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


def _leave_robot(spec: mujoco.MjSpec, trunk: mujoco.MjsBody) -> None:
    """Removes everything but the robot's bodies, joints and geoms."""
    world = spec.worldbody
    around = [body for body in world.bodies if body.name != trunk.name]
    for element in (*around, *world.geoms, *world.sites):
        spec.delete(element)
    _drop_idle(spec)


def _drop_idle(spec: mujoco.MjSpec) -> None:
    """Removes the actuators of joints that were removed."""
    for actuator in [x for x in spec.actuators if spec.joint(x.target) is None]:
        spec.delete(actuator)


def strip_elements(spec: mujoco.MjSpec, strip: Iterable[str | FixedJoint], trunk: str = "") -> None:
    """Removes bodies and joints with all that refers to them, and all keyframes.

    Args:
      spec: the model.
      strip: `RobotFile.strip`.
      trunk: name of the body that must stay, and stay free; none: any that is free.

    Raises:
      RobotError: if a name is no body or joint, or takes the trunk or its freedom.
    """

    def free_joints() -> list[str]:
        free = [x for x in spec.joints if x.type == mujoco.mjtJoint.mjJNT_FREE]
        return [x.name for x in free if trunk in ("", x.parent.name)]

    for key in list(spec.keys):  # they have no place for other joints
        spec.delete(key)
    names = {element.name for element in (*spec.joints, *spec.bodies)}
    fixed = not free_joints()
    for entry in strip:
        name = entry.joint if isinstance(entry, FixedJoint) else entry
        if not name or name not in names:
            raise RobotError(
                f"strip names {quote(name)}, which is no body and no joint of its model"
            )
        if name in free_joints():
            raise RobotError(f"strip names {quote(name)}, by which the trunk is free; it must be")
        if isinstance(entry, FixedJoint):
            _move(spec, entry)
        finds = (spec.joint,) if isinstance(entry, FixedJoint) else (spec.body, spec.joint)
        for find in finds:  # a body takes its joints along
            element = find(name)
            if element is not None and name != "world":
                spec.delete(element)
        if name == "world" or not (fixed or free_joints()):
            raise RobotError(f"strip names {quote(name)}, which is, or carries, the trunk")
    _drop_idle(spec)


def _move(spec: mujoco.MjSpec, fixed: FixedJoint) -> None:
    """Moves a body to where its joint is to be fixed."""
    joint = spec.joint(fixed.joint)
    slides = joint is not None and joint.type == mujoco.mjtJoint.mjJNT_SLIDE
    if joint is None or not (slides or joint.type == mujoco.mjtJoint.mjJNT_HINGE):
        raise RobotError(
            f"strip fixes {quote(fixed.joint)} at {fixed.at:g}; it is no hinge or slide"
        )
    body, axis = joint.parent, joint.axis / np.linalg.norm(joint.axis)
    quat, moved = body.quat.copy(), np.zeros(3)
    if body.alt.type != mujoco.mjtOrientation.mjORIENTATION_QUAT:
        quat = np.asarray(
            spec.resolve_orientation(
                degree=joint.compiler.degree,
                sequence=joint.compiler.eulerseq,
                orientation=body.alt,
            )
        )
    if slides:
        shift = (fixed.at - joint.ref) * axis
        mujoco.mju_rotVecQuat(moved, shift, quat)
        body.pos = body.pos + moved
        return
    ref = math.radians(joint.ref) if joint.compiler.degree else joint.ref
    turn, turned, anchor = np.zeros(4), np.zeros(4), np.zeros(3)
    mujoco.mju_axisAngle2Quat(turn, axis, fixed.at - ref)
    mujoco.mju_mulQuat(turned, quat, turn)
    mujoco.mju_rotVecQuat(anchor, joint.pos, quat)
    mujoco.mju_rotVecQuat(moved, joint.pos, turned)
    body.pos, body.quat = body.pos + anchor - moved, turned
    body.alt.type = mujoco.mjtOrientation.mjORIENTATION_QUAT


def _strip_file(spec: mujoco.MjSpec, file: RobotFile) -> None:
    """Removes the bodies and joints that the file strips; checks that its legs are left."""
    joints = {joint.name for joint in spec.joints}
    strip_elements(spec, file.strip, file.trunk)
    gone = joints - {joint.name for joint in spec.joints}
    for leg in file.legs:
        for joint in [x for x in leg.joints if x in gone]:
            raise RobotError(
                f"strip takes joint {quote(joint)} of leg {leg.name}, which the leg needs"
            )


def _left_out(spec: mujoco.MjSpec, couplings: Iterable[Coupling], file: RobotFile) -> list[str]:
    """Names the constraints that the robot goes without, and refuses those of its legs."""
    roots = [spec.joint(leg.joints[0]) for leg in file.legs]
    hips = [joint.parent for joint in roots if joint is not None]
    legs = [x for hip in hips for x in (hip, *hip.find_all(mujoco.mjtObj.mjOBJ_BODY))]
    notes = []
    for coupling in couplings:
        ends = [getattr(spec, kind)(name) for kind, name in coupling.ends]
        if None in ends:  # stripped
            continue
        names = " and ".join(quote(name) for _, name in coupling.ends)
        constraint = f"the {coupling.kind} constraint of {names}"
        if any((x if isinstance(x, mujoco.MjsBody) else x.parent) in legs for x in ends):
            raise RobotError(
                f"{constraint} couples what a leg moves, and the joints of a leg must be free of "
                "each other; strip the rods that it closes, or take it out of the model"
            )
        notes.append(f"{constraint} is left out")
    return notes


def _masses(model: mujoco.MjModel) -> str:
    """The mass of every body, in one line."""
    bodies = [model.body(k) for k in range(1, model.nbody)]
    return f"masses in kg: {', '.join(f'{x.name} {x.mass[0]:.4g}' for x in bodies)}"


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


def _keep_inertia(spec: mujoco.MjSpec, trunk: mujoco.MjsBody) -> list[str]:
    """Makes explicit the inertia from geoms, which may be deleted later, and compiler options.

    Returns:
      A note of the bodies that are weighed by the volume of their geoms.
    """
    bodies = [trunk, *trunk.find_all(mujoco.mjtObj.mjOBJ_BODY)]
    compiler = spec.compiler
    by_geoms = compiler.inertiafromgeom == mujoco.mjtInertiaFromGeom.mjINERTIAFROMGEOM_TRUE
    bounds = compiler.boundmass > 0 or compiler.boundinertia > 0
    changed = compiler.settotalmass > 0 or bounds or compiler.balanceinertia
    derived = [b for b in bodies if by_geoms or changed or not b.explicitinertial]
    by_volume = ""
    if changed or any(geom.mass != 0 for body in derived for geom in body.geoms):
        model = compile_model(spec)
        weighed = [body for body in derived if model.body_mass[body.id]]
        by_volume = ", ".join(
            body.name
            for body in weighed
            if any(np.isnan(geom.mass) and geom.density > 0 for geom in body.geoms)
        )
        for body in weighed:
            _set_inertia(body, model)
    compiler.inertiafromgeom = mujoco.mjtInertiaFromGeom.mjINERTIAFROMGEOM_AUTO
    compiler.settotalmass, compiler.boundmass, compiler.boundinertia = -1, 0, 0
    compiler.balanceinertia = False
    return [f"weighed by the volume of their geoms: {by_volume}"] if by_volume else []


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


def _draw_sticks(
    spec: mujoco.MjSpec, model: mujoco.MjModel, file: RobotFile, feet: list[mujoco.MjsGeom]
) -> None:
    """Draws a stick figure, from joint to joint and to the feet."""
    for leg, foot in zip(file.legs, feet, strict=True):
        bodies = [spec.body(file.trunk), *(spec.joint(joint).parent for joint in leg.joints)]
        ends = [model.body(body.name).pos for body in bodies[1:]] + [model.geom(foot.name).pos]
        for body, end in zip(bodies, ends, strict=True):
            if np.linalg.norm(end) > model.geom(foot.name).size[0]:
                body.add_geom(
                    FRESH.default,
                    type=mujoco.mjtGeom.mjGEOM_CAPSULE,
                    fromto=[0, 0, 0, *end],
                    size=[model.geom(foot.name).size[0] / 2, 0, 0],
                    mass=0,
                    contype=0,
                    conaffinity=0,
                    group=VISUAL_GROUP,
                )


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
    """Direction from hind to front hips, (2,); that of the abductions' axes without ends."""
    abductions = [data.joint(leg.joints[0]) for leg in file.legs]
    hips = np.asarray([joint.xanchor[:2] for joint in abductions])
    ends = [leg.end for leg in file.legs]
    along = np.argmax(np.sum([np.abs(joint.xaxis[:2]) for joint in abductions], axis=0))
    if not any(ends):
        return np.eye(2)[along]
    if None in ends:
        raise RobotError("end is said of some legs only; say it of all, or of none")
    if ends.count("front") != 2:
        raise RobotError(f"{ends.count('front')} legs have end front; two must, and two hind")
    front = np.asarray(ends) == "front"
    ahead = hips[front, along] > hips[:, along].mean()
    if ahead[0] != ahead[1]:
        names = " and ".join(leg.name for leg in file.legs if leg.end == "front")
        raise RobotError(
            f"legs {names} are said to be front, but they stand at different ends of the trunk; "
            "correct end of one of them, and of a hind leg"
        )
    return hips[front].mean(axis=0) - hips[~front].mean(axis=0)


def _equip(spec: mujoco.MjSpec, robot: Robot, site: str) -> None:
    """Adds servos and IMU, and removes all passive joint forces but the servos' own."""
    for element in [*spec.actuators]:
        spec.delete(element)
    for body in spec.bodies:
        body.gravcomp = 0
    for joint in spec.joints:
        joint.damping, joint.armature = [0, 0, 0], 0
        joint.stiffness, joint.frictionloss = [0, 0, 0], 0
        joint.springdamper, joint.actgravcomp = [0, 0], False
        joint.actfrclimited = mujoco.mjtLimited.mjLIMITED_FALSE
    torques = (robot.hip_torque, robot.hip_torque, robot.knee_torque)
    fields = ("servo_stiffness", "servo_damping", "servo_armature", "servo_friction")
    numbers = [*zip(torques, *(per_joint(getattr(robot, x)) for x in fields), strict=True)]
    for leg in robot.legs:
        for name, (torque, stiffness, *passive) in zip(leg.joints, numbers, strict=True):
            joint, (damping, armature, friction) = spec.joint(name), passive
            joint.damping = [damping, 0, 0]
            joint.armature, joint.frictionloss = armature, friction
            servo = spec.add_actuator(
                FRESH.default,
                name=name,
                target=name,
                trntype=mujoco.mjtTrn.mjTRN_JOINT,
                forcelimited=mujoco.mjtLimited.mjLIMITED_TRUE,
                forcerange=[-torque, torque],
            )
            servo.set_to_position(kp=stiffness)
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
