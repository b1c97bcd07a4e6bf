"""A robot's numbers, found on its compiled model; what depends on its size follows from them."""

import dataclasses
import math
from typing import NamedTuple

import mujoco
import numpy as np

from mjx_balance.files.validation import check_types
from mjx_balance.robots.robot import (
    OUR_LEVER,
    OUR_MASS,
    Leg,
    Robot,
)
from mjx_balance.robots.schema import LegFile, RobotError, RobotFile

LEVEL = math.cos(math.radians(1.0))
"""Cosine of what an axis may be off the one that the kinematics take it for."""

# Our own robot's (robots/quadruped.toml), which is chosen; others' follow from it.
OUR_LEG, OUR_HALF_TRACK, OUR_HEIGHT = 0.426, 0.142, 0.35
OUR_STIFFNESS, OUR_DAMPING, OUR_ARMATURE = 400.0, 16.0, 0.02
OUR_ACTION = 0.003  # paper Eq. 3
STRETCH = 0.77
"""Of the legs' length that they stand at: 0.35 m for ours (paper 3.1)."""
SMALLEST = 0.01
"""Mass and size against ours that the board can still be made for."""
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
    legs = _placed([_leg(file, model, *one) for one in zip(file.legs, feet, strict=True)])
    _check_corners(file, legs)
    _check_bends(file, legs)
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
    if min(robot.mass_scale, robot.size_scale) < SMALLEST:
        raise RobotError(
            f"it weighs {mass:.3g} kg and its feet are {robot.lever:.3g} m off its middle; at "
            f"least {SMALLEST * OUR_MASS:.2g} kg and {SMALLEST * OUR_LEVER:.2g} m are needed for "
            "a board of its size"
        )
    sized = {"body_height": file.body_height or _body_height(robot)}
    sized["action_max"] = _digits(OUR_ACTION * robot.lever / OUR_LEVER)
    stiffer = _stiffer(robot, sized["body_height"])
    sized["servo_stiffness"] = _digits(OUR_STIFFNESS * stiffer)
    sized["servo_damping"] = _digits(OUR_DAMPING * stiffer)
    sized["servo_armature"] = _digits(OUR_ARMATURE * stiffer)
    said = {name: getattr(file, name) or value for name, value in sized.items()}
    robot = dataclasses.replace(robot, **said)
    # A policy carries it: better refused now than when a training has ended.
    return check_types(robot, RobotError)


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
            if above == body:
                raise RobotError(
                    f"joint {joint!r} of leg {name} is on body {model.body(body).name!r}, as the "
                    "one before it; each joint of a leg needs a body of its own"
                )
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
    ranges = [_turns(model, *one) for one in zip(joints, signs, zeros, strict=True)]
    abducts = _levelled(name, joints[0], ranges[0])
    bend = _bend(said, ranges[1], ranges[2], [math.hypot(v[0], v[2]) for v in (thigh, shank)])
    return Leg(
        name=name,
        left=False,  # `_placed` sees
        front=False,
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
        zeros=(
            _clean(zeros[0] + abducts),
            _clean(zeros[1] + bend.hip),
            _clean(zeros[2] + bend.calf),
        ),
        knee=(_clean(bend.low), _clean(bend.high)),
    )


def _placed(legs: list[Leg]) -> tuple[Leg, ...]:
    """With their corners: a trunk's origin need not lie between its legs."""
    x, y = (np.mean([getattr(leg, axis) for leg in legs]) for axis in "xy")
    return tuple(
        dataclasses.replace(leg, left=bool(leg.y > y), front=bool(leg.x > x)) for leg in legs
    )


FREE_KNEE = (0.1, 2.7)
"""Turns of a knee that nothing stops, rad: short of straight, and of the thigh."""
WHOLE_TURNS = [2 * math.pi * k for k in (0, 1, -1, 2, -2)]
"""By which a joint's angles may be drawn off, rad."""


def _turns(model: mujoco.MjModel, joint: str, sign: float, zero: float) -> tuple[float, float]:
    """What its limits let a joint turn the leg by, rad; infinite without limits."""
    one = model.joint(joint)
    if not model.jnt_limited[one.id]:
        return -math.inf, math.inf
    low, high = sorted(sign * one.range + zero)
    return float(low), float(high)


def _levelled(leg: str, joint: str, turns: tuple[float, float]) -> float:
    """Whole turns that bring the level hip's axis within an abduction's limits, rad."""
    low, high = turns
    for whole in WHOLE_TURNS:
        if low + whole - SLACK <= 0 <= high + whole + SLACK:
            return whole
    raise RobotError(
        f"joint {joint!r} of leg {leg} turns the hip's axis from {math.degrees(low):.0f} to "
        f"{math.degrees(high):.0f} deg off level; it must be able to hold it level"
    )


SLACK = 1e-3
"""Of a limit that is level itself, rad."""


class _Bend(NamedTuple):
    """A knee that points one way."""

    low: float
    """Least turn of the calf against the thigh, rad; negative: backward."""
    high: float
    """The greatest."""
    hip: float
    """Whole turns to add to the hip's angle for the thigh's turn, rad."""
    calf: float
    """Likewise to the knee's."""


def _bend(
    said: LegFile, hip: tuple[float, float], knee: tuple[float, float], lengths: list[float]
) -> _Bend:
    """Which way the knee points, and how far it turns within its limits and the hip's.

    Backward, unless forward has more than twice the room: limits that hardly differ say nothing,
    and all legs should bend alike.

    Args:
      said: may say it.
      hip: least and greatest turn of the thigh, rad.
      knee: of the calf against it, rad.
      lengths: of thigh and calf, m.
    """
    ways = {
        name: _bent(side, hip, knee, lengths) for name, side in (("backward", -1), ("forward", 1))
    }
    backward, forward = ways["backward"], ways["forward"]
    if said.knee is not None:
        chosen = ways[said.knee]
    elif backward and forward:
        wide = forward.high - forward.low > 2 * (backward.high - backward.low)
        chosen = forward if wide else backward
    else:
        chosen = backward or forward
    if chosen is None:
        way = f" with the knee {said.knee}" if said.knee else ""
        raise RobotError(
            f"joints {said.joints[1]!r} and {said.joints[2]!r} of leg {said.name} cannot turn far "
            f"enough to keep its foot under the hip{way}: the thigh turns {_degrees(hip)}, the "
            f"calf against it {_degrees(knee)}"
        )
    return chosen


def _bent(
    side: int, hip: tuple[float, float], knee: tuple[float, float], lengths: list[float]
) -> _Bend | None:
    """The knee on one side, -1 backward or 1 forward; none: its limits, or the hip's, forbid it."""
    ends = (-math.pi, 0.0) if side < 0 else (0.0, math.pi)

    def room(whole: float) -> float:
        return min(knee[1] + whole, ends[1]) - max(knee[0] + whole, ends[0])

    calf = max(WHOLE_TURNS, key=room)
    free = sorted(side * x for x in FREE_KNEE)
    low, high = knee[0] + calf, knee[1] + calf
    low = low if low > ends[0] else free[0]
    high = high if high < ends[1] else free[1]
    if low >= high:
        return None
    a, b = lengths
    turns = np.linspace(low, high, 2001)
    leans = -np.arctan2(b * np.sin(turns), a + b * np.cos(turns))

    def good(whole: float) -> np.ndarray:
        return turns[(leans >= hip[0] + whole) & (leans <= hip[1] + whole)]

    thigh = max(WHOLE_TURNS, key=lambda whole: len(good(whole)))
    kept = good(thigh)
    return _Bend(float(kept[0]), float(kept[-1]), thigh, calf) if len(kept) else None


def _clean(value: float) -> float:
    """Without the last digits, which differ from machine to machine."""
    return round(float(value), 9) + 0.0


def _wrapped(angle: float) -> float:
    """To -pi .. pi."""
    return math.remainder(angle, 2 * math.pi)


def _degrees(turns: tuple[float, float]) -> str:
    low, high = (math.degrees(x) for x in turns)
    return "freely" if math.isinf(low) else f"from {low:.0f} to {high:.0f} deg"


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


def _check_bends(file: RobotFile, legs: tuple[Leg, ...]) -> None:
    """Left and right legs are mirror images, or the file says that they are not."""
    said = {leg.name: leg.knee for leg in file.legs}
    for leg in legs:
        for other in legs:
            mirrored = leg.front == other.front and leg.left and not other.left
            differ = sum(leg.knee) * sum(other.knee) < 0
            if mirrored and differ and None in (said[leg.name], said[other.name]):
                way = "forward" if sum(leg.knee) > 0 else "backward"
                raise RobotError(
                    f"knees of legs {leg.name} and {other.name} would point different ways, that "
                    f"of {leg.name} {way}; say knee of both"
                )


UNLIMITED = 1e4
"""Torque of servos that neither file nor model limit, N m."""


def _torque(model: mujoco.MjModel, joint: str) -> float:
    """What the model's own actuators can do at a joint, N m."""
    number = model.joint(joint).id
    limits = []
    if model.jnt_actfrclimited[number]:
        limits.append(np.abs(model.jnt_actfrcrange[number]).max())
    for k in range(model.nu):
        kinds = (mujoco.mjtTrn.mjTRN_JOINT, mujoco.mjtTrn.mjTRN_JOINTINPARENT)
        moves = mujoco.mjtTrn(int(model.actuator_trntype[k])) in kinds
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
            gain = abs(model.actuator_gainprm[k, 0])
            limits.append(gear * gain * np.abs(model.actuator_ctrlrange[k]).max())
    return float(min(limits, default=UNLIMITED))
