"""Measures a robot on its compiled model, and scales servos, height and action to its size."""

import dataclasses
import itertools
import math
from collections.abc import Iterator
from typing import NamedTuple

import mujoco
import numpy as np

from mjx_balance.files.text import quote
from mjx_balance.files.validation import check_types
from mjx_balance.robots.robot import OUR_LEVER, OUR_MASS, Body, Leg, Robot
from mjx_balance.robots.schema import LegFile, RobotError, RobotFile

LEVEL = math.cos(math.radians(1.0))
"""Cosine of the greatest angle between a joint's axis and the trunk's axis."""

# Numbers of our own robot (robots/quadruped.toml), from which others are scaled.
OUR_LEG, OUR_HALF_TRACK, OUR_HEIGHT = 0.426, 0.142, 0.35
OUR_STIFFNESS, OUR_DAMPING, OUR_ARMATURE = 400.0, 16.0, 0.02
OUR_ACTION = 0.003  # paper Eq. 3
STRETCH = 0.77
"""Standing length of the legs as a share of their full length: 0.35 m for ours (paper 3.1)."""
SMALLEST = 0.01
"""Least mass and size relative to ours."""
INCLINE = 7.0
"""Board angle on both axes at once that the legs must compensate, deg (paper 3.1)."""


def measure(file: RobotFile, model: mujoco.MjModel, feet: list[str], radius: float) -> Robot:
    """Measures a robot, and scales what its file leaves out to its mass and size.

    Args:
      file: the robot's file.
      model: compiled, x forward, with its maker's actuators.
      feet: name of each leg's foot geom.
      radius: of the feet, m.

    Raises:
      RobotError: if the kinematics of a leg do not fit, or the legs are too short for the board.
    """
    legs = _with_corners([_leg(file, model, *one) for one in zip(file.legs, feet, strict=True)])
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
    gain_scale = _gain_scale(body, height)
    robot = Robot(
        **vars(body),
        hip_torque=file.hip_torque or _torque(model, [x for leg in legs for x in leg.joints[:2]]),
        knee_torque=file.knee_torque or _torque(model, [leg.joints[2] for leg in legs]),
        servo_stiffness=file.servo_stiffness or _three_digits(OUR_STIFFNESS * gain_scale),
        servo_damping=file.servo_damping or _three_digits(OUR_DAMPING * gain_scale),
        servo_armature=file.servo_armature or _three_digits(OUR_ARMATURE * gain_scale),
        foot_friction=file.foot_friction,
        body_height=height,
        action_max=file.action_max or _three_digits(OUR_ACTION * body.lever / OUR_LEVER),
    )
    # The policy file repeats this check, but only after the training.
    return check_types(robot, RobotError)


def check_joints(model: mujoco.MjModel, file: RobotFile) -> None:
    """Checks that every leg is a chain of three hinges, and that no other joint is left.

    Raises:
      RobotError: names the first joint that does not fit.
    """
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
    """Ids of a body's ancestors, from its parent up to the world."""
    bodies = []
    while body:
        body = int(model.body_parentid[body])
        bodies.append(body)
    return bodies


class Pose:
    """Places and axes of a robot at given joint angles (rad), in its trunk's frame."""

    def __init__(self, model: mujoco.MjModel, trunk: str, angles: dict[str, float]):
        self.model, self.data = model, mujoco.MjData(model)
        free = model.body(trunk).jntadr[0]
        self.data.qpos[:] = 0
        self.data.qpos[model.jnt_qposadr[free] + 3] = 1
        for name, angle in angles.items():
            self.data.joint(name).qpos = angle
        mujoco.mj_kinematics(model, self.data)

    def anchor(self, joint: str) -> np.ndarray:
        """Place of a joint's anchor, (3,) m."""
        return self.data.joint(joint).xanchor.copy()

    def axis(self, joint: str) -> np.ndarray:
        """Axis of a joint, (3,) unit vector."""
        return self.data.joint(joint).xaxis.copy()

    def foot(self, geom: str) -> np.ndarray:
        """Place of a geom, (3,) m."""
        return self.data.geom(geom).xpos.copy()


def _standing_height(robot: Body) -> float:
    """Body height with the legs at `STRETCH` of their length, m.

    Clipped, so that the legs can compensate a board at `INCLINE` on both axes.
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
    stance = robot.foot_radius + float(np.mean(stretched))
    return round(min(max(stance, low + room), high - room), 3)


def _gain_scale(robot: Body, height: float) -> float:
    """Servo gains relative to our own robot's.

    Roll is the softest motion. A mass m at height h rolls on legs of length l and half-track y,
    with joints of stiffness k, at a frequency proportional to sqrt(k / m) * y / (l * h). Every
    robot gets the frequency of ours, so that its oscillation decays as early in a decision and the
    gyro then reads the board's rate.
    """
    leg = float(np.mean([leg.thigh + leg.calf for leg in robot.legs]))
    longer = (leg * height / robot.half_track) / (OUR_LEG * OUR_HEIGHT / OUR_HALF_TRACK)
    return robot.total_mass / OUR_MASS * longer**2


def _three_digits(value: float) -> float:
    return float(f"{value:.3g}")


def _leg(file: RobotFile, model: mujoco.MjModel, leg: LegFile, foot: str) -> Leg:
    """Measures a leg with the hip's axis level; `_with_corners` sets left and front."""
    _check_foot(model, leg, foot)
    pose, tilt, signs = _level_pose(model, file.trunk, leg)
    at, hip, knee = (pose.anchor(joint) for joint in leg.joints)
    end = pose.foot(foot)
    thigh, calf = knee - hip, end - knee
    lengths = [math.hypot(v[0], v[2]) for v in (thigh, calf)]
    lean, calf_lean = (math.atan2(-v[0], -v[2]) for v in (thigh, calf))
    zeros = (_clean(tilt), _clean(lean), _clean(math.remainder(calf_lean - lean, 2 * math.pi)))
    ranges = [_range(model, *one) for one in zip(leg.joints, signs, zeros, strict=True)]
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
      The pose, the roll of the hip's axis at joint angles 0, rad, and the joints' signs, +-1.
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
    """1 if a joint's axis points along the trunk's x (`along` 0) or y (1), -1 if against it."""
    axis = pose.axis(joint)
    if abs(axis[along]) < LEVEL:
        ways = ("(1, 0, 0) or (-1, 0, 0)", "(0, 1, 0) or (0, -1, 0)")
        raise RobotError(
            f"joint {quote(joint)} of leg {leg.name} turns about {_vector(axis)} of the trunk; "
            f"{rule}, {ways[along]}"
        )
    return float(np.sign(axis[along]))


def _with_corners(legs: list[Leg]) -> tuple[Leg, ...]:
    """Sets left and front relative to the legs' mean; the trunk's origin may lie outside."""
    x, y = (np.mean([getattr(leg, axis) for leg in legs]) for axis in "xy")
    return tuple(
        dataclasses.replace(leg, left=bool(leg.y > y), front=bool(leg.x > x)) for leg in legs
    )


FREE_KNEE = (0.1, 2.7)
"""Least and greatest bend of a knee without limits, rad: almost straight, almost on the thigh."""
WHOLE_TURNS = [2 * math.pi * k for k in (0, 1, -1, 2, -2)]
"""Offsets of a model's joint angles from ours, rad."""


def _range(model: mujoco.MjModel, joint: str, sign: float, zero: float) -> tuple[float, float]:
    """Range of the turn of the leg by a joint (`Leg`), rad; infinite without limits."""
    one = model.joint(joint)
    if not model.jnt_limited[one.id]:
        return -math.inf, math.inf
    low, high = sorted(sign * one.range + zero)
    return float(low), float(high)


def _level_turns(leg: LegFile, turns: tuple[float, float]) -> float:
    """Whole turns that bring the level hip axis, turn 0, within an abduction's limits, rad."""
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
"""Tolerance of an abduction's limits, rad."""


class _Bend(NamedTuple):
    """The range of a knee that points one way."""

    low: float
    """Least turn of the calf against the thigh, rad; negative: backward."""
    high: float
    """Greatest turn, rad."""
    hip: float
    """Whole turns to add to the hip's zero, rad."""
    calf: float
    """Whole turns to add to the knee's zero, rad."""


def _bend(
    leg: LegFile, hip: tuple[float, float], knee: tuple[float, float], lengths: list[float]
) -> _Bend:
    """Chooses which way the knee points.

    It points backward unless the file says otherwise or forward has more than twice the range: the
    legs should bend alike even if their limits differ slightly.

    Args:
      leg: the leg's table in the file.
      hip: least and greatest turn of the thigh, rad.
      knee: least and greatest turn of the calf against the thigh, rad.
      lengths: of thigh and calf, m.
    """
    backward, forward = (_bend_to(side, hip, knee, lengths) for side in (-1, 1))
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


def _bend_to(
    side: int, hip: tuple[float, float], knee: tuple[float, float], lengths: list[float]
) -> _Bend | None:
    """Range of a knee that points backward (-1) or forward (1), with the foot under the hip.

    None if the limits of knee and hip leave no range.
    """
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
    usable = good(thigh)
    return _Bend(float(usable[0]), float(usable[-1]), thigh, calf) if len(usable) else None


def _clean(value: float) -> float:
    """Drops the last digits, which differ between machines."""
    return round(float(value), 9) + 0.0


def _degrees(turns: tuple[float, float]) -> str:
    low, high = (math.degrees(x) for x in turns)
    return "freely" if math.isinf(low) else f"from {low:.0f} to {high:.0f} deg"


def _vector(v: np.ndarray) -> str:
    return "(" + ", ".join(f"{x + 0:.2f}" for x in v) + ")"


def _check_corners(file: RobotFile, legs: tuple[Leg, ...]) -> None:
    """Checks that each corner has one leg, and that sides and ends are as the file says."""
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
    """Checks that knees of left and right legs point the same way, unless the file sets both."""
    unset = {leg.name for leg in file.legs if leg.knee is None}
    for leg, other in itertools.product(legs, legs):
        mirrored = leg.front == other.front and leg.left and not other.left
        differ = sum(leg.knee) * sum(other.knee) < 0
        if mirrored and differ and unset & {leg.name, other.name}:
            way = "forward" if sum(leg.knee) > 0 else "backward"
            raise RobotError(
                f"knees of legs {leg.name} and {other.name} would point different ways, that "
                f"of {leg.name} {way}; say knee of both"
            )


UNLIMITED = 1e4
"""Torque limit of servos if neither file nor model gives one, N m."""


def _torque(model: mujoco.MjModel, joints: list[str]) -> float:
    """Least torque limit of the model's actuators and joints over some joints, N m."""
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
