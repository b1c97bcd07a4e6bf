"""Builds the MuJoCo model from `scenes/*.xml`, a task and a robot; finds the standing state."""

import copy
import dataclasses
import functools
import hashlib
import math
from collections.abc import Sequence
from typing import NamedTuple

import mujoco
import numpy as np
from jaxtyping import Float, Int

from mjx_balance.config import Config, ConfigError, TaskConfig
from mjx_balance.robots.build import ACCELEROMETER, BOARD_SIZE, GYRO, VISUAL_GROUP
from mjx_balance.robots.catalogue import Robot, find_robot, robot_file, robot_spec
from mjx_balance.robots.limits import check_robot
from mjx_balance.robots.measure import OUR_LEG, OUR_STIFFNESS
from mjx_balance.robots.model import scene_dir
from mjx_balance.robots.robot import gain_text, per_joint
from mjx_balance.task import Array
from mjx_balance.task.attitude import body_tilt
from mjx_balance.task.kinematics import joint_angles
from mjx_balance.task.randomization import DomainParams
from mjx_balance.task.step import Targets

ROBOT, BOARD, PLATFORM = "robot/", "board/", "platform/"
SLIDES = ("surge", "sway", "heave")
CONTACT_TIME = 0.01  #: of the foot contacts, s: near the shortest that 4 ms steps carry
SETTLE_STEPS = 750
SETTLE_ROUNDS = 4
TRIM_ERROR = 1e-3  #: greatest distance of a joint from its target, rad
NUDGE = 0.05  #: along both axes, m/s; a robot on too soft servos does not come to rest after it
NUDGE_STEPS = 7_500
WARNING_STEPS = 50  #: from one look for a warning of MuJoCo to the next
LEAST_STEP = 1.05  #: precision of the least stiffness in an error, as a factor


@dataclasses.dataclass(frozen=True)
class Stance:
    """The settled standing state, the start of every episode."""

    qpos: Float[np.ndarray, " nq"]
    qvel: Float[np.ndarray, " nv"]
    qacc_warmstart: Float[np.ndarray, " nv"]
    leg_trim: Float[np.ndarray, "legs 3"]
    """Added to the joint angles so that the servos reach them under load, rad: the robot's own
    weight would otherwise bend the legs by millimetres."""
    imu: Float[np.ndarray, "6"]  #: gyro in rad/s and accelerometer in m/s^2 at rest


class Start(NamedTuple):
    """Where an episode starts."""

    qpos: Float[Array, "*batch nq"]
    imu: Float[Array, "*batch 6"]  #: rad/s and m/s^2
    tilt: Float[Array, "*batch"]  #: of the body, deg


@dataclasses.dataclass(frozen=True)
class Layout:
    """A compiled model and the addresses everything else needs, looked up once by name."""

    task: TaskConfig
    robot: Robot
    robot_source: str  #: as `Config.robot`
    model: mujoco.MjModel
    trunk: int  #: id of the trunk's body
    leg_qpos: Int[np.ndarray, "legs 3"]  #: of the leg joints in qpos
    leg_ctrl: Int[np.ndarray, "legs 3"]  #: of the leg servos in ctrl
    foot_pairs: Int[np.ndarray, " legs"]  #: contact pairs of the feet
    board_qpos: Int[np.ndarray, "2"]  #: of the board hinges, X and Y, in qpos
    board_ctrl: Int[np.ndarray, "2"]  #: of the board servos in ctrl
    platform_qpos: Int[np.ndarray, " slides"]  #: of surge, sway and heave in qpos, if there are any
    platform_ctrl: Int[np.ndarray, " slides"]  #: of their servos in ctrl
    trunk_quat: Int[np.ndarray, "4"]  #: of the trunk's orientation in qpos
    trunk_velocity: Int[np.ndarray, "2"]  #: of its velocity along the world's x, y in qvel
    imu: Int[np.ndarray, "6"]  #: of gyro and accelerometer in sensordata


@dataclasses.dataclass(frozen=True)
class Scene(Layout):
    """A model, its addresses, and the state in which episodes start."""

    stance: Stance

    def ctrl(
        self, targets: Targets, params: DomainParams | None = None
    ) -> Float[Array, "*batch sim_steps nu"]:
        """Servo targets in the model's order, rad, and m of a platform.

        Softer servos need more trim for the same torque.
        """
        trim: Array = self.stance.leg_trim.astype(targets.joints.dtype)
        if params is not None:
            stiffness, _ = soft_factors(self.robot).astype(trim.dtype)
            trim = trim / stiffness ** params.softness[..., None, None, None]
        joints = targets.joints + trim
        xp = joints.__array_namespace__()
        flat = (targets.board, joints.reshape(*joints.shape[:-2], -1))
        servos = (self.board_ctrl, self.platform_ctrl, self.leg_ctrl.ravel())
        order = np.argsort(np.concatenate(servos))
        return xp.concatenate(flat, axis=-1)[..., order]

    def start(self, tilt: Float[Array, "*batch 2"] | None) -> Start:
        """The stance, on a board at rest at angles about X and Y, deg, robot and board as one."""
        stance = self.stance
        if tilt is None:
            return Start(stance.qpos, stance.imu, np.zeros(()))
        xp = tilt.__array_namespace__()
        angle = tilt * (np.pi / 180)
        (ca, cb), (sa, sb) = (np.moveaxis(f(angle), -1, 0) for f in (xp.cos, xp.sin))
        qpos = [xp.zeros_like(ca) + value for value in stance.qpos]
        for k, address in enumerate(self.board_qpos):
            qpos[address] = angle[..., k]
        # X is the outer hinge: the turn is that about X times that about Y.
        root = self.trunk_quat[0] - 3
        x, y, z = stance.qpos[root : root + 3]
        x, z = cb * x + sb * z, cb * z - sb * x
        qpos[root : root + 3] = x, ca * y - sa * z, sa * y + ca * z
        cosines, sines = xp.cos(angle / 2), xp.sin(angle / 2)
        about_x = [cosines[..., 0], sines[..., 0], 0, 0]
        about_y = [cosines[..., 1], 0, sines[..., 1], 0]
        turned = _times(_times(about_x, about_y), stance.qpos[self.trunk_quat].tolist())
        qpos[root + 3 : root + 7] = turned
        x, y, z = stance.imu[3:]
        y, z = ca * y + sa * z, ca * z - sa * y
        still = [xp.zeros_like(ca) + value for value in stance.imu[:3]]
        imu = xp.stack((*still, cb * x - sb * z, y, cb * z + sb * x), axis=-1)
        return Start(xp.stack(qpos, axis=-1), imu, body_tilt(xp.stack(turned, axis=-1)))

    @property
    def hash(self) -> str:
        """Fingerprint of the physics: equal for equal dynamics, whatever the looks."""
        return scene_hash(self.model)


def _times(first: Sequence[Array], second: Sequence[Array]) -> list[Array]:
    """Product of two quaternions, w first."""
    a, b, c, d = first
    w, x, y, z = second
    return [
        a * w - b * x - c * y - d * z,
        a * x + b * w + c * z - d * y,
        a * y - b * z + c * w + d * x,
        a * z + b * y - c * x + d * w,
    ]


def build_model(task: TaskConfig, robot_source: str, visual: bool = False) -> mujoco.MjModel:
    """Compiles stage, board and robot; as `build_spec`."""
    return build_spec(task, robot_source, visual).compile()


def build_spec(task: TaskConfig, robot_source: str, visual: bool = False) -> mujoco.MjSpec:
    """Assembles stage, board and robot.

    Args:
      task: time step and standing height.
      robot_source: as `Config.robot`.
      visual: whether to keep the visual geoms; without them MJX has a sixth of the geoms to move.

    Raises:
      ConfigError: if the robot's file asks for a board that its feet do not fit on.
    """
    robot = find_robot(robot_source)
    stage = mujoco.MjSpec.from_file(str(scene_dir() / "scene.xml"))
    for looked in (*stage.cameras, *stage.worldbody.geoms):  # from as far as it is large
        looked.pos = looked.pos * robot.size_scale
    body = robot_spec(robot_source, visual)
    size = body.numeric(BOARD_SIZE)
    board = _board(robot, None if size is None else float(size.data[0]))
    carrier = _platform(stage, robot) if task.platform else stage.worldbody
    stage.attach(board, prefix=BOARD, frame=carrier.add_frame())
    for name in (x for x in dir(stage.option) if not x.startswith("_")):
        setattr(body.option, name, getattr(stage.option, name))
    frame = stage.worldbody.add_frame(pos=[0, 0, task.body_height])
    stage.attach(body, prefix=ROBOT, frame=frame)
    friction = robot.foot_friction
    for leg in robot.legs:
        stage.add_pair(
            name=f"{leg.name}_contact",
            geomname1=f"{ROBOT}{leg.foot}",
            geomname2=f"{BOARD}board",
            condim=3,
            friction=[friction, friction, 0.005, 0.0001, 0.0001],
            solref=[CONTACT_TIME, 1],
        )
    stage.option.timestep = task.sim_dt
    if not visual:
        for geom in [g for g in stage.geoms if g.group == VISUAL_GROUP]:
            stage.delete(geom)
    return stage


def _platform(stage: mujoco.MjSpec, robot: Robot) -> mujoco.MjsBody:
    """Adds the platform, as heavy and stiff for this robot as ours is for our own."""
    platform = mujoco.MjSpec.from_file(str(scene_dir() / "platform.xml"))
    for joint in platform.joints:
        joint.armature *= robot.mass_scale
        joint.damping = joint.damping * robot.mass_scale
    for servo in platform.actuators:
        servo.set_to_position(kp=servo.gainprm[0] * robot.mass_scale)
    stage.attach(platform, prefix=PLATFORM, frame=stage.worldbody.add_frame())
    for camera in stage.cameras:  # follows the board
        camera.mode = mujoco.mjtCamLight.mjCAMLIGHT_TARGETBODY
        camera.targetbody = f"{PLATFORM}platform"
    return stage.body(f"{PLATFORM}platform")


def _board(robot: Robot, size: float | None) -> mujoco.MjSpec:
    """The board, as large, heavy and stiff for this robot as ours is for our own; `size` in m."""
    board = mujoco.MjSpec.from_file(str(scene_dir() / "board.xml"))
    longer, heavier = robot.size_scale, robot.mass_scale
    if size is not None:
        half_length, half_width, _ = board.geom("board").size
        longer = size / (2 * half_length)
        feet = robot.half_length / half_length, robot.half_track / half_width
        if longer < max(feet):
            raise ConfigError(
                f"robot {robot.name}: board_size is {size:g} m; for its feet to stand on the board "
                f"it must be at least {2 * half_length * max(feet):.2f}"
            )
    if longer == heavier == 1:
        return board
    for geom in board.geoms:
        geom.pos, geom.size = geom.pos * longer, geom.size * longer
        geom.fromto = geom.fromto * longer
    body = board.body("board")
    body.mass, body.inertia = body.mass * heavier, body.inertia * heavier * longer**2
    body.ipos = body.ipos * longer
    for joint in board.joints:
        joint.armature *= heavier * longer**2
        joint.damping = joint.damping * heavier * longer**2
    for servo in board.actuators:
        servo.set_to_position(kp=servo.gainprm[0] * heavier * longer**2)
    return board


def load_scene(config: Config, visual: bool = False) -> Scene:
    """Builds the model, looks its addresses up and settles the robot.

    Raises:
      ConfigError: if the config contradicts its robot, or the robot does not come to rest upright.
    """
    robot = find_robot(config.robot)
    check_robot(config, robot)
    model = build_model(config.task, config.robot, visual)
    names = [[f"{ROBOT}{joint}" for joint in leg.joints] for leg in robot.legs]
    board = [f"{BOARD}board_{axis}" for axis in "xy"]
    slides = [f"{PLATFORM}{name}" for name in SLIDES] if config.task.platform else []
    trunk = model.body(f"{ROBOT}{robot.trunk}")
    root = model.joint(int(trunk.jntadr[0]))
    sensors = [model.sensor(f"{ROBOT}{name}") for name in (GYRO, ACCELEROMETER)]
    ids = functools.partial(np.asarray, dtype=np.int32)
    layout = Layout(
        task=config.task,
        robot=robot,
        robot_source=config.robot,
        model=model,
        trunk=trunk.id,
        leg_qpos=ids([[model.joint(n).qposadr[0] for n in leg] for leg in names]),
        leg_ctrl=ids([[model.actuator(n).id for n in leg] for leg in names]),
        foot_pairs=ids([model.pair(f"{leg.name}_contact").id for leg in robot.legs]),
        board_qpos=ids([model.joint(n).qposadr[0] for n in board]),
        board_ctrl=ids([model.actuator(n).id for n in board]),
        platform_qpos=ids([model.joint(n).qposadr[0] for n in slides]),
        platform_ctrl=ids([model.actuator(n).id for n in slides]),
        trunk_quat=ids(root.qposadr[0] + np.arange(3, 7)),
        trunk_velocity=ids(root.dofadr[0] + np.arange(2)),
        imu=ids([k for s in sensors for k in range(s.adr[0], s.adr[0] + s.dim[0])]),
    )
    return Scene(**vars(layout), stance=_settle(layout))


def soft_factors(robot: Robot) -> Float[np.ndarray, "2 3"]:
    """Stiffness and damping of soft servos, relative to the robot's own; at most 1.

    They are those of `quadruped_soft` times weight and leg length relative to ours.
    """
    soft, scale = find_robot("quadruped_soft"), _weight_scale(robot)
    names = ("servo_stiffness", "servo_damping")
    softer = [scale * getattr(soft, name) / per_joint(getattr(robot, name)) for name in names]
    return np.minimum(softer, 1.0)


def soften(scene: Scene) -> Scene:
    """The scene with soft servos (`soft_factors`).

    Raises:
      ConfigError: if the robot does not stand.
    """
    model, servos, robot = copy.copy(scene.model), scene.leg_ctrl, scene.robot
    stiffness, damping = soft_factors(robot)
    stiffness = stiffness * per_joint(robot.servo_stiffness)
    damping = damping * per_joint(robot.servo_damping)
    model.actuator_gainprm[servos, 0] = stiffness
    model.actuator_biasprm[servos, 1] = -stiffness
    model.dof_damping[leg_dofs(model, servos)] = damping
    robot = dataclasses.replace(
        robot, servo_stiffness=tuple(stiffness), servo_damping=tuple(damping)
    )
    softer = dataclasses.replace(scene, model=model, robot=robot)
    return dataclasses.replace(softer, stance=_settle(softer))


def _settle(layout: Layout) -> Stance:
    """Lets the robot come to rest on the level board with its joints at their targets.

    On soft servos a robot sags by more than their error, so that the trim does not settle. Then
    stiff servos carry it first.
    """
    data, trim = _rest(layout, np.ones((len(layout.leg_ctrl), 3)))
    if not (_is_still(layout, data) and _is_at_targets(layout, data)):
        data, trim = _rest_carried(layout)
        if not _endures(layout, data):
            raise ConfigError(_why_unsettled(layout))
    state = data.qpos.copy(), data.qvel.copy(), data.qacc_warmstart.copy()
    return Stance(*state, trim, data.sensordata[layout.imu].copy())


def _rest(
    layout: Layout, stiffer: Float[np.ndarray, "legs 3"]
) -> tuple[mujoco.MjData, Float[np.ndarray, "legs 3"]]:
    """Lets the robot come to rest, if it does; returns its state and its trim.

    Each round adds the servos' error under load to the trim, as an integral term would. The servos
    are so many times stiffer until the last round, in which the trim gives the torque of before.
    """
    model, legs, height = layout.model, layout.leg_qpos, layout.task.body_height
    servos, root = layout.leg_ctrl, layout.trunk_quat[0] - 3
    angles = _standing_angles(layout)
    trim = np.zeros_like(angles)
    data = mujoco.MjData(model)
    data.qpos[root : root + 7] = (0, 0, height, 1, 0, 0, 0)
    data.qpos[legs] = angles
    stiff = _with_gains(layout, stiffer)
    stiff.dof_damping[leg_dofs(model, servos)] *= stiffer
    stiff.dof_armature[leg_dofs(model, servos)] *= stiffer  # or they would be too fast for a step
    for _ in range(SETTLE_ROUNDS):
        data.ctrl[servos] = angles + trim
        _step(stiff, data, SETTLE_STEPS)
        trim = trim + angles - data.qpos[legs]
    trim = trim * stiffer
    data.ctrl[servos] = angles + trim
    data.qpos[root : root + 2] = 0
    _step(model, data, SETTLE_STEPS)
    return data, trim


def _rest_carried(layout: Layout) -> tuple[mujoco.MjData, Float[np.ndarray, "legs 3"]]:
    """`_rest` with servos that are at first as stiff as our own robot's, relative to its weight."""
    return _rest(layout, np.maximum(_too_soft_by(layout), 1))


def _step(model: mujoco.MjModel, data: mujoco.MjData, steps: int) -> None:
    """Steps until MuJoCo warns: steps after a divergence tell nothing, and are slow."""
    for _ in range(0, steps, WARNING_STEPS):
        if not data.warning.number.any():
            mujoco.mj_step(model, data, nstep=min(steps, WARNING_STEPS))


def _standing_angles(layout: Layout) -> Float[np.ndarray, "legs 3"]:
    """Joint angles of the robot at `body_height`, rad."""
    heights = np.full(len(layout.leg_ctrl), layout.task.body_height)
    return joint_angles(layout.robot, heights)


def _with_gains(layout: Layout, factor: float | np.ndarray) -> mujoco.MjModel:
    """The model with servos so many times as stiff."""
    model, servos = copy.copy(layout.model), layout.leg_ctrl
    model.actuator_gainprm[servos, 0] *= factor
    model.actuator_biasprm[servos, 1] *= factor
    return model


def _weight_scale(robot: Robot) -> float:
    """Weight times leg length, relative to our own robot's."""
    return robot.mass_scale * robot.leg_length / OUR_LEG


def leg_dofs(model: mujoco.MjModel, servos: Int[np.ndarray, "legs 3"]) -> np.ndarray:
    """Addresses in qvel of the joints that the servos move."""
    return model.jnt_dofadr[model.actuator_trnid[servos, 0]]


def _too_soft_by(layout: Layout) -> Float[np.ndarray, "legs 3"]:
    """Factor to the stiffness of our own robot's servos, relative to weight times leg length."""
    return (
        OUR_STIFFNESS
        * _weight_scale(layout.robot)
        / layout.model.actuator_gainprm[layout.leg_ctrl, 0]
    )


def _is_still(layout: Layout, data: mujoco.MjData) -> bool:
    """Whether the robot is upright and at rest."""
    upright = np.abs(data.qpos[layout.trunk_quat[1:3]]).max() < 0.01
    return bool(upright and np.abs(data.qvel).max() < 0.01)


def _is_at_targets(layout: Layout, data: mujoco.MjData) -> bool:
    """Whether the trim holds the joints at the angles of the standing robot."""
    return np.abs(data.qpos[layout.leg_qpos] - _standing_angles(layout)).max() < TRIM_ERROR


def _endures(layout: Layout, data: mujoco.MjData) -> bool:
    """Whether the robot is still, and comes to rest again after a nudge."""
    if not _is_still(layout, data):
        return False
    nudged = copy.copy(data)
    nudged.qvel[layout.trunk_velocity] += NUDGE
    _step(layout.model, nudged, NUDGE_STEPS)
    return _is_still(layout, nudged)


def _why_unsettled(layout: Layout) -> str:
    """Says that the robot does not stand, and why, as far as one can tell."""
    robot, height = layout.robot, layout.task.body_height
    limits = layout.model.actuator_forcerange[layout.leg_ctrl, 1]
    # Servos that are far too stiff reach their limits in any case.
    gentle = _with_gains(layout, np.minimum(_too_soft_by(layout), 1))
    data, _ = _rest_carried(dataclasses.replace(layout, model=gentle))
    share = np.abs(data.actuator_force[layout.leg_ctrl]) / limits
    if share.max() > 0.99:
        leg, joint = np.unravel_index(np.argmax(share), share.shape)
        return (
            f"robot {robot.name} weighs {robot.total_mass:.1f} kg, too much for its servos: "
            f"{robot.legs[leg].joints[joint]!r} needs more than its {limits[leg, joint]:g} N m to "
            f"stand at body_height {height} m"
        )
    return (
        f"robot {robot.name} does not stand still at body_height {height} m with "
        f"servo_stiffness {gain_text(robot.servo_stiffness)} N m/rad: "
        f"{_why_unbalanced(layout) or _why_too_soft(layout) or _what_to_leave_out(layout)}"
    )


def _why_unbalanced(layout: Layout) -> str:
    """Where the centre of mass is if it is not above the feet."""
    data, robot = mujoco.MjData(layout.model), layout.robot
    data.qpos[layout.trunk_quat[0]] = 1
    mujoco.mj_forward(layout.model, data)
    sides = ("x", "ahead", "behind"), ("y", "left", "right")
    for (axis, above, below), at in zip(sides, data.subtree_com[layout.trunk], strict=False):
        least, most = robot.each(axis).min(), robot.each(axis).max()
        if not least < at < most:
            return (
                f"its centre of mass is {1000 * abs(at):.0f} mm {above if at > most else below} of "
                f"the trunk's origin, and its feet stand from {1000 * least:.0f} to "
                f"{1000 * most:.0f} mm"
            )
    return ""


def _why_too_soft(layout: Layout) -> str:
    """The least stiffness with which the robot stands, if it does with stiff servos."""
    most = float(_too_soft_by(layout).max())

    def stands(factor: float) -> bool:
        stiffer = dataclasses.replace(layout, model=_with_gains(layout, factor))
        data, _ = _rest_carried(stiffer)
        return _endures(stiffer, data)

    if most <= 1 or not stands(most):
        return ""
    low, high = 1.0, most
    while high / low > LEAST_STEP:
        middle = math.sqrt(low * high)
        low, high = (low, middle) if stands(middle) else (middle, high)
    least = high * per_joint(layout.robot.servo_stiffness)
    digits = 10.0 ** (np.floor(np.log10(least)) - 1)
    text = gain_text(tuple(digits * np.ceil(least / digits)))
    return f"its weight bends them ever further; servo_stiffness must be at least {text}"


def _what_to_leave_out(layout: Layout) -> str:
    """Which numbers of the file to leave to the rules."""
    file = robot_file(layout.robot_source)
    names = ("servo_stiffness", "servo_damping", "servo_armature", "body_height")
    own = [name for name in names if getattr(file, name) is not None]
    if own:
        return f"leave out {', '.join(own)} of its file, and the rules give others"
    return "neither its centre of mass nor its file says why; look at its picture"


_HASHED = (
    "body_parentid body_mass body_inertia body_ipos body_iquat body_pos body_quat "
    "body_gravcomp jnt_type jnt_axis jnt_pos jnt_range jnt_limited jnt_solref jnt_solimp "
    "jnt_margin jnt_stiffness jnt_actfrclimited jnt_actfrcrange qpos0 qpos_spring "
    "dof_parentid dof_armature dof_damping dof_frictionloss dof_solref dof_solimp "
    "actuator_trntype actuator_trnid actuator_dyntype actuator_dynprm actuator_gaintype "
    "actuator_gainprm actuator_biastype actuator_biasprm actuator_forcelimited "
    "actuator_forcerange actuator_ctrllimited actuator_ctrlrange actuator_gear site_bodyid "
    "site_pos site_quat pair_friction pair_solref pair_solimp pair_margin pair_gap pair_dim "
    "pair_solreffriction sensor_type sensor_objid sensor_cutoff sensor_noise"
).split()
_HASHED_OPTIONS = (
    "timestep gravity wind density viscosity integrator cone impratio jacobian solver iterations "
    "tolerance ls_iterations ls_tolerance noslip_iterations noslip_tolerance o_margin o_solref "
    "o_solimp o_friction disableflags enableflags disableactuator"
).split()


def scene_hash(model: mujoco.MjModel) -> str:
    """Hashes what the dynamics depend on, the solver included, to six significant digits.

    Args:
      model: with or without its visual geoms; both give the same hash.

    Returns:
      16 hexadecimal digits.
    """
    digest = hashlib.sha256()
    touching = np.r_[model.pair_geom1, model.pair_geom2]
    parts = [getattr(model, name) for name in _HASHED]
    geoms = (model.geom_type, model.geom_size, model.geom_pos, model.geom_quat, model.geom_bodyid)
    parts += [field[touching] for field in geoms]
    parts += [getattr(model.opt, name) for name in _HASHED_OPTIONS]
    for part in parts:
        digest.update(",".join(f"{x:.6g}" for x in np.ravel(part)).encode() + b";")
    return digest.hexdigest()[:16]
