"""A robot's numbers, measured on its compiled model; what depends on its size follows from them."""

import dataclasses
import itertools
import math
from collections.abc import Iterator
from typing import NamedTuple

import mujoco
import numpy as np

from mjx_balance.files.text import quote
from mjx_balance.files.validation import check_types
from mjx_balance.robots.robot import (
    OUR_LEVER,
    OUR_MASS,
    Body,
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


def measure(file: RobotFile, model: mujoco.MjModel, feet: list[str], radius: float) -> Robot:
    """Measures a robot, and sizes what its file leaves out.

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
    body = Body(
        name=file.name,
        legs=legs,
        trunk=file.trunk,
        foot_radius=radius,
        trunk_mass=_clean(trunk.mass[0]),
        total_mass=_clean(trunk.subtreemass[0]),
    )
    if min(body.mass_scale, body.size_scale) < SMALLEST:
        raise RobotError(
            f"it weighs {body.total_mass:.3g} kg and its feet are {body.lever:.3g} m off its "
            f"middle; at least {SMALLEST * OUR_MASS:.2g} kg and {SMALLEST * OUR_LEVER:.2g} m are "
            "needed for a board of its size"
        )
    height = file.body_height or _standing_height(body)
    stiffer = _stiffer(body, height)
    robot = Robot(
        **vars(body),
        hip_torque=file.hip_torque or _torque(model, [x for leg in legs for x in leg.joints[:2]]),
        knee_torque=file.knee_torque or _torque(model, [leg.joints[2] for leg in legs]),
        servo_stiffness=file.servo_stiffness or _digits(OUR_STIFFNESS * stiffer),
        servo_damping=file.servo_damping or _digits(OUR_DAMPING * stiffer),
        servo_armature=file.servo_armature or _digits(OUR_ARMATURE * stiffer),
        foot_friction=file.foot_friction,
        body_height=height,
        action_max=file.action_max or _digits(OUR_ACTION * body.lever / OUR_LEVER),
    )
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
                    f"joint {quote(joint)} of leg {name} is none of its model's; they are: "
                    f"{', '.join(moving)}"
                )
            if model.joint(joint).type[0] != mujoco.mjtJoint.mjJNT_HINGE:
                raise RobotError(f"joint {quote(joint)} of leg {name} is no hinge")
            body = int(model.jnt_bodyid[model.joint(joint).id])
            if above == body:
                raise RobotError(
                    f"joint {quote(joint)} of leg {name} is on body "
                    f"{quote(model.body(body).name)}, as the one before it; each joint of "
                    "a leg needs a body of its own"
                )
            if above not in ancestors(model, body):
                raise RobotError(
                    f"joint {quote(joint)} of leg {name} does not hang on "
                    f"{quote(model.body(above).name)}; joints go from the trunk "
                    "down: abduction, hip, knee"
                )
            above = body
    listed = {joint for leg in file.legs for joint in leg.joints}
    extra = [name for name in moving if name not in listed]
    if extra:
        raise RobotError(f"joint {quote(extra[0])} is in no leg; strip it, and it is fixed")


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


def _standing_height(robot: Body) -> float:
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


def _stiffer(robot: Body, height: float) -> float:
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


def _leg(file: RobotFile, model: mujoco.MjModel, leg: LegFile, foot: str) -> Leg:
    """Measures a leg with the hip's axis level; `_placed` gives it its corner."""
    _check_foot(model, leg, foot)
    pose, tilt, signs = _level_pose(model, file.trunk, leg)
    at, hip, knee = (pose.anchor(joint) for joint in leg.joints)
    end = pose.foot(foot)
    thigh, calf = knee - hip, end - knee
    lengths = [math.hypot(v[0], v[2]) for v in (thigh, calf)]
    lean, calf_lean = (math.atan2(-v[0], -v[2]) for v in (thigh, calf))
    zeros = (_clean(tilt), _clean(lean), _clean(math.remainder(calf_lean - lean, 2 * math.pi)))
    ranges = [_turns(model, *one) for one in zip(leg.joints, signs, zeros, strict=True)]
    bend = _bend(leg, ranges[1], ranges[2], lengths)
    whole = _level_turns(leg, ranges[0])
    return Leg(
        name=leg.name,
        left=False,
        front=False,
        joints=leg.joints,
        foot=foot,
        x=_clean(hip[0]),
        y=_clean(end[1]),
        axis_height=_clean(at[2]),
        drop=_clean(at[2] - hip[2]),
        offset=_clean(end[1] - at[1]),
        thigh=_clean(lengths[0]),
        calf=_clean(lengths[1]),
        signs=signs,
        zeros=(
            _clean(zeros[0] + whole),
            _clean(zeros[1] + bend.hip),
            _clean(zeros[2] + bend.calf),
        ),
        knee=(_clean(bend.low), _clean(bend.high)),
    )


def _check_foot(model: mujoco.MjModel, leg: LegFile, foot: str) -> None:
    calf = int(model.jnt_bodyid[model.joint(leg.joints[2]).id])
    holder = int(model.geom(foot).bodyid[0])
    if calf not in (holder, *ancestors(model, holder)):
        raise RobotError(
            f"foot of leg {leg.name} hangs on body {quote(model.body(holder).name)}; it must hang "
            f"on what joint {quote(leg.joints[2])} moves, {quote(model.body(calf).name)}"
        )


def _level_pose(
    model: mujoco.MjModel, trunk: str, leg: LegFile
) -> tuple[Pose, float, tuple[float, float, float]]:
    """Turns the abduction until the hip's axis is level.

    Returns:
      The pose, the axis' angle off level as the model draws it, rad, and the joints' signs, +-1.
    """
    drawn = Pose(model, trunk, {})
    abduction, hip, knee = leg.joints
    forward = _sign(drawn, leg, abduction, "an abduction turns about forward", 0)
    axis = drawn.axis(hip) * np.sign(drawn.axis(hip)[1] or 1.0)
    tilt = math.atan2(axis[2], axis[1])
    pose = Pose(model, trunk, {abduction: -forward * tilt})
    left = [
        _sign(pose, leg, joint, f"a {what} turns about the left", 1)
        for joint, what in ((hip, "hip"), (knee, "knee"))
    ]
    return pose, tilt, (forward, left[0], left[1])


def _sign(pose: Pose, leg: LegFile, joint: str, rule: str, along: int) -> float:
    """Whether a joint's axis points along the trunk's x (0) or y (1), 1, or against it, -1."""
    axis = pose.axis(joint)
    if abs(axis[along]) < LEVEL:
        ways = ("(1, 0, 0) or (-1, 0, 0)", "(0, 1, 0) or (0, -1, 0)")
        raise RobotError(
            f"joint {quote(joint)} of leg {leg.name} turns about {_vector(axis)} of the trunk; "
            f"{rule}, {ways[along]}"
        )
    return float(np.sign(axis[along]))


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


def _level_turns(leg: LegFile, turns: tuple[float, float]) -> float:
    """Whole turns that bring the level hip's axis within an abduction's limits, rad."""
    low, high = turns
    for whole in WHOLE_TURNS:
        if low + whole - SLACK <= 0 <= high + whole + SLACK:
            return whole
    raise RobotError(
        f"joint {quote(leg.joints[0])} of leg {leg.name} turns the hip's axis from "
        f"{math.degrees(low):.0f} to {math.degrees(high):.0f} deg off level; it must be able to "
        "hold it level"
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
    leg: LegFile, hip: tuple[float, float], knee: tuple[float, float], lengths: list[float]
) -> _Bend:
    """Which way the knee points, and how far it turns within its limits and the hip's.

    Backward, unless forward has more than twice the room: limits that hardly differ say nothing,
    and all legs should bend alike.

    Args:
      leg: may say it.
      hip: least and greatest turn of the thigh, rad.
      knee: of the calf against it, rad.
      lengths: of thigh and calf, m.
    """
    backward, forward = (_bent(side, hip, knee, lengths) for side in (-1, 1))
    if leg.knee is not None:
        bend = forward if leg.knee == "forward" else backward
    elif backward and forward:
        wide = forward.high - forward.low > 2 * (backward.high - backward.low)
        bend = forward if wide else backward
    else:
        bend = backward or forward
    if bend is None:
        way = f" with the knee {leg.knee}" if leg.knee else ""
        raise RobotError(
            f"joints {quote(leg.joints[1])} and {quote(leg.joints[2])} of leg {leg.name} cannot "
            f"turn far enough to keep its foot under the hip{way}: the thigh turns "
            f"{_degrees(hip)}, the calf against it {_degrees(knee)}"
        )
    return bend


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


def _degrees(turns: tuple[float, float]) -> str:
    low, high = (math.degrees(x) for x in turns)
    return "freely" if math.isinf(low) else f"from {low:.0f} to {high:.0f} deg"


def _vector(v: np.ndarray) -> str:
    return "(" + ", ".join(f"{x + 0:.2f}" for x in v) + ")"


def _check_corners(file: RobotFile, legs: tuple[Leg, ...]) -> None:
    """Each corner has one leg, which stands where the file says."""
    corners: dict[tuple[str, str], str] = {}
    for words, leg in zip(file.legs, legs, strict=True):
        side, end = "left" if leg.left else "right", "front" if leg.front else "hind"
        for word, place in ((words.side, side), (words.end, end)):
            if word not in (None, place):
                raise RobotError(f"leg {leg.name} is said to be {word}, but it stands {place}")
        other = corners.setdefault((end, side), leg.name)
        if other != leg.name:
            raise RobotError(
                f"legs {other} and {leg.name} both stand {end} {side}; each corner has one"
            )


def _check_bends(file: RobotFile, legs: tuple[Leg, ...]) -> None:
    """Left and right legs are mirror images, or the file says that they are not."""
    unsaid = {leg.name for leg in file.legs if leg.knee is None}
    for leg, other in itertools.product(legs, legs):
        mirrored = leg.front == other.front and leg.left and not other.left
        differ = sum(leg.knee) * sum(other.knee) < 0
        if mirrored and differ and unsaid & {leg.name, other.name}:
            way = "forward" if sum(leg.knee) > 0 else "backward"
            raise RobotError(
                f"knees of legs {leg.name} and {other.name} would point different ways, that "
                f"of {leg.name} {way}; say knee of both"
            )


UNLIMITED = 1e4
"""Torque of servos that neither file nor model limit, N m."""


def _torque(model: mujoco.MjModel, joints: list[str]) -> float:
    """What the model's own actuators can do at the weakest of some joints, N m."""
    limits = [limit for joint in joints for limit in _limits(model, model.joint(joint).id)]
    return float(min(limits, default=UNLIMITED))


def _limits(model: mujoco.MjModel, joint: int) -> Iterator[float]:
    if model.jnt_actfrclimited[joint]:
        yield np.abs(model.jnt_actfrcrange[joint]).max()
    kinds = (mujoco.mjtTrn.mjTRN_JOINT, mujoco.mjtTrn.mjTRN_JOINTINPARENT)
    for k in range(model.nu):
        transmission = mujoco.mjtTrn(int(model.actuator_trntype[k]))
        if transmission not in kinds or model.actuator_trnid[k, 0] != joint:
            continue
        gear = abs(model.actuator_gear[k, 0])
        if model.actuator_forcelimited[k]:
            yield gear * np.abs(model.actuator_forcerange[k]).max()
        motor = (
            model.actuator_gaintype[k] == mujoco.mjtGain.mjGAIN_FIXED
            and model.actuator_biastype[k] == mujoco.mjtBias.mjBIAS_NONE
        )
        if motor and model.actuator_ctrllimited[k]:
            gain = abs(model.actuator_gainprm[k, 0])
            yield gear * gain * np.abs(model.actuator_ctrlrange[k]).max()
