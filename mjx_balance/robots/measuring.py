"""A robot's numbers, found on its compiled model; what depends on its size follows from them."""

import dataclasses
import math

import mujoco
import numpy as np

from mjx_balance.robots.file import LegFile, RobotError, RobotFile
from mjx_balance.robots.record import OUR_LEVER, OUR_MASS, Leg, Robot

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


def measured(file: RobotFile, model: mujoco.MjModel, feet: list[str], radius: float) -> Robot:
    """Measures a robot, and sizes what its file does not say.

    Args:
      file: what is known of it.
      model: compiled, x forward, with its maker's actuators.
      feet: geom of each leg's foot.
      radius: of the feet, m.

    Raises:
      RobotError: if a leg is none that can be put on the board, or they are too short for it.
    """
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


def check_joints(model: mujoco.MjModel, file: RobotFile) -> None:
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


class Pose:
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
    pose = Pose(model, file.trunk, {})
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
    pose = Pose(model, file.trunk, {joints[0]: -sign * tilt})
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
