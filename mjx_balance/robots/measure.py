"""Measures a robot on its compiled model, and scales servos, height and action to its size."""

import dataclasses
import math
from collections.abc import Iterator

import mujoco
import numpy as np

from mjx_balance.config.schema import GRAVITY
from mjx_balance.errors import quote
from mjx_balance.files.validation import check_types
from mjx_balance.robots.model import JOINT_ACTUATORS
from mjx_balance.robots.robot import OUR_LEVER, OUR_MASS, Body, Leg, Robot
from mjx_balance.robots.schema import LegFile, RobotError, RobotFile

LEVEL = math.cos(math.radians(1.0))  #: of the greatest angle of a joint's axis to the trunk's
SLACK = 1e-3  #: tolerance of an abduction's limits, rad
FREE_KNEE = (0.1, 2.7)  #: bend of a knee without limits, rad: almost straight, on the thigh
WHOLE_TURNS = [2 * math.pi * k for k in (0, 1, -1, 2, -2)]  #: between the model's angles and ours
UNLIMITED = 1e4  #: torque limit of servos if neither file nor model gives one, N m

# Numbers of our own robot (robots/quadruped.toml), from which others are scaled.
OUR_LEG, OUR_HALF_TRACK, OUR_HEIGHT = 0.426, 0.142, 0.35
OUR_STIFFNESS, OUR_DAMPING, OUR_ARMATURE = 400.0, 16.0, 0.02
OUR_ACTION = 0.003  # paper Eq. 3
STRETCH = 0.77  #: standing length of the legs, of their full length: 0.35 m for ours (paper 3.1)
LEAST_STIFFNESS = 2.0
"""Least stiffness of the servos, relative to weight times leg; that of ours is 6.3. Below 1.2 a
small robot tilts by half a degree on the tilted board."""
SMALLEST = 0.01  #: least mass and size relative to ours
DENSITY = (5.0, 20_000.0)
"""Least and greatest mass over the product of the feet's span on both axes and the legs' length, kg
/ m^3; the robots of 20 makers have 70 to 420."""
STUCK = 0.1  #: range of all joints below which their limits are taken for another unit's, rad
INCLINE = 7.0  #: board angle on both axes at once that the legs must compensate, deg (paper 3.1)

Range = tuple[float, float]  #: least and greatest turn of a link (`Leg`), rad


def measure(
    file: RobotFile, model: mujoco.MjModel, feet: list[str], radius: float, notes: list[str]
) -> Robot:
    """Measures a robot, and scales what its file leaves out to its mass and size.

    Args:
      file: the robot's file.
      model: compiled, x forward, with its maker's actuators.
      feet: name of each leg's foot geom.
      radius: of the feet, m.
      notes: takes what was chosen where the model leaves it open.

    Raises:
      RobotError: if the kinematics of a leg do not fit, or the legs are too short for the board.
    """
    either_way: list[str] = []
    _check_limits(file, model)
    legs = _with_corners(
        [_leg(file, model, *one, either_way) for one in zip(file.legs, feet, strict=True)]
    )
    _check_corners(file, legs)
    if either_way:
        notes.append(
            f"knees of {', '.join(either_way)} may bend either way, and are taken to point "
            'backward: say knee = "forward" where they do not'
        )
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
    _check_units(body, model)
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
        command_delay=file.command_delay,
        servo_friction=file.servo_friction or 0.0,
    )
    # The policy file repeats this check, but only after the training.
    return check_types(robot, RobotError)


def check_joints(model: mujoco.MjModel, file: RobotFile) -> None:
    """Checks that every leg is a chain of three hinges, and that no other joint is left.

    Raises:
      RobotError: names the first joint that does not fit.
    """
    moving = [joint.name for joint in map(model.joint, range(model.njnt)) if joint.type[0] != 0]
    for leg in file.legs:
        above = model.body(file.trunk).id
        for name in leg.joints:
            subject = f"joint {quote(name)} of leg {leg.name}"
            if name not in moving:
                raise RobotError(f"{subject} is none of its model's; they are: {', '.join(moving)}")
            joint = model.joint(name)
            if joint.type[0] != mujoco.mjtJoint.mjJNT_HINGE:
                raise RobotError(f"{subject} is no hinge")
            body = int(joint.bodyid[0])
            if above == body:
                raise RobotError(
                    f"{subject} is on body {quote(model.body(body).name)}, as the one before it; "
                    "each joint of a leg needs a body of its own"
                )
            if above not in ancestors(model, body):
                raise RobotError(
                    f"{subject} does not hang on {quote(model.body(above).name)}; joints go from "
                    "the trunk down: abduction, hip, knee"
                )
            above = body
    listed = {joint for leg in file.legs for joint in leg.joints}
    for name in moving:
        if name not in listed:
            raise RobotError(f"joint {quote(name)} is in no leg; strip it, and it is fixed")


def ancestors(model: mujoco.MjModel, body: int) -> list[int]:
    """Ids of a body's ancestors, from its parent up to the world."""
    bodies = []
    while body:
        body = int(model.body_parentid[body])
        bodies.append(body)
    return bodies


def pose(
    model: mujoco.MjModel, trunk: str, angles: dict[str, float] | None = None
) -> mujoco.MjData:
    """Kinematics in the trunk's frame, at `angles` (rad) of joints and 0 of all others."""
    data = mujoco.MjData(model)
    data.qpos[:] = 0
    data.qpos[model.jnt_qposadr[model.body(trunk).jntadr[0]] + 3] = 1
    for name, angle in (angles or {}).items():
        data.joint(name).qpos = angle
    mujoco.mj_kinematics(model, data)
    return data


def _check_limits(file: RobotFile, model: mujoco.MjModel) -> None:
    """Refuses legs that can hardly move, as where degrees are taken for radians."""
    joints = [model.joint(joint) for leg in file.legs for joint in leg.joints]
    turns = [float(np.ptp(x.range)) for x in joints if model.jnt_limited[x.id]]
    if len(turns) == len(joints) and max(turns) < STUCK:
        raise RobotError(
            f"the joints of its legs turn by {math.degrees(max(turns)):.2g} deg at most; an MJCF "
            'file\'s limits are in deg, or in rad after <compiler angle="radian"/>'
        )


def _check_units(body: Body, model: mujoco.MjModel) -> None:
    """Refuses sizes, masses and moments of inertia that no robot has; its model has other units."""
    leg = body.leg_length
    spans = [float(np.ptp(body.each(axis))) for axis in "xy"]
    density = body.total_mass / max(math.prod(spans) * leg, 1e-12)
    least, most = DENSITY
    if not least < density < most:
        odd = "light" if density <= least else "heavy"
        raise RobotError(
            f"it weighs {body.total_mass:.3g} kg, with legs of {leg:.3g} m whose feet span "
            f"{spans[0]:.3g} x {spans[1]:.3g} m; no robot is as {odd} for its size: "
            "write masses in kg and lengths in m"
        )
    greatest = body.total_mass * (leg + math.hypot(*spans)) ** 2
    for link in map(model.body, range(1, model.nbody)):
        if link.inertia.sum() / 2 > greatest:
            raise RobotError(
                f"body {quote(link.name)} of {link.mass[0]:.3g} kg has moments of inertia up to "
                f"{link.inertia.max():.3g} kg m^2; the whole robot, of {body.total_mass:.3g} kg, "
                f"could have {greatest:.3g}: write them in kg m^2"
            )


def _standing_height(robot: Body) -> float:
    """Body height with legs at `STRETCH`, within what a board at `INCLINE` needs, m."""
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
    height = min(max(stance, low + room), high - room)
    rounded = round(height, 3)
    return rounded if low + room <= rounded <= high - room else _clean(height)


def _gain_scale(robot: Body, height: float) -> float:
    """Servo gains relative to our own robot's.

    Roll is the softest motion, or pitch of a robot that is wider than long. A mass m at height h
    rolls on legs of length l and half-track y, with joints of stiffness k, at a frequency
    proportional to sqrt(k / m) * y / (l * h). Every robot gets the frequency of ours, so that its
    oscillation decays as early in a decision and the gyro then reads the board's rate. Gravity
    grows in proportion as robots get smaller; `LEAST_STIFFNESS` keeps small ones from sagging.
    """
    leg = robot.leg_length
    narrow = min(robot.half_track, robot.half_length)
    longer = (leg * height / narrow) / (OUR_LEG * OUR_HEIGHT / OUR_HALF_TRACK)
    least = LEAST_STIFFNESS * robot.total_mass * GRAVITY * leg / OUR_STIFFNESS
    return max(robot.total_mass / OUR_MASS * longer**2, least)


def _three_digits(value: float) -> float:
    return float(f"{value:.3g}")


def _clean(value: float) -> float:
    """Drops the last digits, which differ between machines."""
    return round(float(value), 9) + 0.0


def _leg(
    file: RobotFile, model: mujoco.MjModel, leg: LegFile, foot: str, either_way: list[str]
) -> Leg:
    """Measures a leg with the hip's axis level; `_with_corners` sets left and front."""
    _check_foot(model, leg, foot)
    data, tilt, signs = _level_pose(model, file.trunk, leg)
    at, hip, knee = (data.joint(joint).xanchor for joint in leg.joints)
    end = data.geom(foot).xpos
    thigh, calf = knee - hip, end - knee
    lengths = [math.hypot(v[0], v[2]) for v in (thigh, calf)]
    lean, calf_lean = (math.atan2(-v[0], -v[2]) for v in (thigh, calf))
    zeros = (_clean(tilt), _clean(lean), _clean(math.remainder(calf_lean - lean, 2 * math.pi)))
    ranges = [_range(model, *one) for one in zip(leg.joints, signs, zeros, strict=True)]
    bend, hip_turns, knee_turns = _bend(leg, ranges[1], ranges[2], lengths, either_way)
    level_turns = _level_turns(leg, ranges[0])
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
            _clean(zeros[0] + level_turns),
            _clean(zeros[1] + hip_turns),
            _clean(zeros[2] + knee_turns),
        ),
        knee=bend,
    )


def _check_foot(model: mujoco.MjModel, leg: LegFile, foot: str) -> None:
    calf, holder = int(model.joint(leg.joints[2]).bodyid[0]), int(model.geom(foot).bodyid[0])
    if calf not in (holder, *ancestors(model, holder)):
        raise RobotError(
            f"foot of leg {leg.name} hangs on body {quote(model.body(holder).name)}; it must hang "
            f"on what joint {quote(leg.joints[2])} moves, {quote(model.body(calf).name)}"
        )


def _level_pose(
    model: mujoco.MjModel, trunk: str, leg: LegFile
) -> tuple[mujoco.MjData, float, tuple[float, float, float]]:
    """The pose with a level hip axis, its roll at joint angles 0, rad, and the joints' signs."""
    drawn = pose(model, trunk)
    abduction, hip, knee = leg.joints
    forward = _sign(drawn, leg, abduction, "an abduction turns about forward", 0)
    axis = drawn.joint(hip).xaxis
    axis = axis * np.sign(axis[1] or 1.0)
    tilt = math.atan2(axis[2], axis[1])
    level = pose(model, trunk, {abduction: -forward * tilt})
    hip_sign = _sign(level, leg, hip, "a hip turns about the left", 1)
    knee_sign = _sign(level, leg, knee, "a knee turns about the left", 1)
    return level, tilt, (forward, hip_sign, knee_sign)


def _sign(data: mujoco.MjData, leg: LegFile, joint: str, rule: str, along: int) -> float:
    """1 if a joint's axis points along the trunk's x (`along` 0) or y (1), -1 if against it."""
    axis = data.joint(joint).xaxis
    if abs(axis[along]) < LEVEL:
        ways = ("(1, 0, 0) or (-1, 0, 0)", "(0, 1, 0) or (0, -1, 0)")
        turns = ", ".join(f"{x + 0:.2f}" for x in axis)
        raise RobotError(
            f"joint {quote(joint)} of leg {leg.name} turns about ({turns}) of the trunk; {rule}, "
            f"{ways[along]}"
        )
    return float(np.sign(axis[along]))


def _range(model: mujoco.MjModel, joint: str, sign: float, zero: float) -> Range:
    """Turns that a joint's limits allow; infinite without limits."""
    one = model.joint(joint)
    if not model.jnt_limited[one.id]:
        return -math.inf, math.inf
    low, high = sorted(sign * one.range + zero)
    return float(low), float(high)


def _level_turns(leg: LegFile, turns: Range) -> float:
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


def _bend(
    leg: LegFile, hip: Range, knee: Range, lengths: list[float], either_way: list[str]
) -> tuple[Range, float, float]:
    """Bends the knee as the file says; else backward, unless forward has twice the range."""
    backward, forward = (_bend_to(side, hip, knee, lengths) for side in (-1, 1))
    if leg.knee is not None:
        bend = forward if leg.knee == "forward" else backward
    elif backward and forward:
        bend = forward if np.ptp(forward[0]) > 2 * np.ptp(backward[0]) else backward
        if bend is backward and np.ptp(backward[0]) <= 2 * np.ptp(forward[0]):
            either_way.append(leg.name)
    else:
        bend = backward or forward
    if bend is None:
        way = f" with the knee {leg.knee}" if leg.knee else ""
        bounds = [abs(x) for x in (*hip, *knee) if math.isfinite(x)]
        rad = "; their limits look like deg, and are read as rad" * (max(bounds) > 4 * math.pi)
        raise RobotError(
            f"joints {quote(leg.joints[1])} and {quote(leg.joints[2])} of leg {leg.name} cannot "
            f"turn far enough to keep its foot under the hip{way}: the thigh turns "
            f"{_degrees(hip)}, the calf against it {_degrees(knee)}{rad}"
        )
    return bend


def _bend_to(
    side: int, hip: Range, knee: Range, lengths: list[float]
) -> tuple[Range, float, float] | None:
    """Range of a knee that points backward (-1) or forward (1), with the foot under the hip.

    Args:
      side: -1 or 1.
      hip: limits of the thigh.
      knee: limits of the calf against the thigh.
      lengths: of thigh and calf, m.

    Returns:
      The range, and the whole turns to add to the zeros of hip and knee, rad; none if the limits
      leave no range.
    """
    first, last = sorted((0.0, side * math.pi))
    calf = max(WHOLE_TURNS, key=lambda k: min(knee[1] + k, last) - max(knee[0] + k, first))
    low, high = knee[0] + calf, knee[1] + calf
    free = sorted(side * x for x in FREE_KNEE)
    low, high = low if low > first else free[0], high if high < last else free[1]
    if low >= high:
        return None
    a, b = lengths
    turns = np.linspace(low, high, 2001)
    leans = -np.arctan2(b * np.sin(turns), a + b * np.cos(turns))
    usable = {k: turns[(leans >= hip[0] + k) & (leans <= hip[1] + k)] for k in WHOLE_TURNS}
    thigh, bends = max(usable.items(), key=lambda item: len(item[1]))
    return ((_clean(bends[0]), _clean(bends[-1])), thigh, calf) if len(bends) else None


def _degrees(turns: Range) -> str:
    low, high = (math.degrees(x) for x in turns)
    return "freely" if math.isinf(low) else f"from {low:.0f} to {high:.0f} deg"


def _with_corners(legs: list[Leg]) -> tuple[Leg, ...]:
    """Sets left and front relative to the legs' mean; the trunk's origin may lie outside."""
    x, y = (np.mean([getattr(leg, axis) for leg in legs]) for axis in "xy")
    return tuple(
        dataclasses.replace(leg, left=bool(leg.y > y), front=bool(leg.x > x)) for leg in legs
    )


def _check_corners(file: RobotFile, legs: tuple[Leg, ...]) -> None:
    """Checks each corner's leg against the file, and that left and right knees bend alike."""
    corners: dict[tuple[str, str], Leg] = {}
    for words, leg in zip(file.legs, legs, strict=True):
        side, end = "left" if leg.left else "right", "front" if leg.front else "hind"
        for word, place in ((words.side, side), (words.end, end)):
            if word not in (None, place):
                raise RobotError(f"leg {leg.name} is said to be {word}, but it stands {place}")
        other = corners.setdefault((end, side), leg)
        if other is not leg:
            raise RobotError(
                f"legs {other.name} and {leg.name} both stand {end} {side}; each corner has one"
            )
    unset = {leg.name for leg in file.legs if leg.knee is None}
    for end in ("front", "hind"):
        left, right = corners[end, "left"], corners[end, "right"]
        if sum(left.knee) * sum(right.knee) < 0 and unset & {left.name, right.name}:
            way = "forward" if sum(left.knee) > 0 else "backward"
            raise RobotError(
                f"knees of legs {left.name} and {right.name} would point different ways, that "
                f"of {left.name} {way}; say knee of both"
            )


def _torque(model: mujoco.MjModel, joints: list[str]) -> float:
    """Least torque limit of the model's actuators and joints over some joints, N m."""
    limits = [limit for joint in joints for limit in _limits(model, model.joint(joint).id)]
    return float(min(limits, default=UNLIMITED))


def _limits(model: mujoco.MjModel, joint: int) -> Iterator[float]:
    if model.jnt_actfrclimited[joint]:
        yield np.abs(model.jnt_actfrcrange[joint]).max()
    for motor in map(model.actuator, range(model.nu)):
        transmission = mujoco.mjtTrn(int(motor.trntype[0]))
        if transmission not in JOINT_ACTUATORS or motor.trnid[0] != joint:
            continue
        gear = abs(motor.gear[0])
        if motor.forcelimited[0]:
            yield gear * np.abs(motor.forcerange).max()
        fixed = motor.gaintype[0] == mujoco.mjtGain.mjGAIN_FIXED
        if fixed and motor.biastype[0] == mujoco.mjtBias.mjBIAS_NONE and motor.ctrllimited[0]:
            gain = abs(motor.gainprm[0])
            yield gear * gain * np.abs(motor.ctrlrange).max()
