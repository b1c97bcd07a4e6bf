"""Fields and parser of a robot's TOML file."""

import dataclasses
import os
import tomllib
from pathlib import Path
from typing import Annotated, Any, Literal

from annotated_types import Gt, Le, Len, MinLen

from mjx_balance.config import ConfigError
from mjx_balance.errors import MESSAGE, printable, quote, shorten
from mjx_balance.files.validation import STRICT, parse
from mjx_balance.robots.robot import MOST, Delay, Number

MAX_FILE = 2**20  #: greatest size of a robot file, bytes
Name = Annotated[str, MinLen(1)]
Positive = Annotated[float, Gt(0), Le(MOST)]
Gain = Positive | tuple[Positive, Positive, Positive]
"""Of all servos, or of those of abductions, hips and knees."""
Place = tuple[Number, Number, Number]  #: x, y and z, m


class RobotError(ConfigError):
    """A robot that cannot be found, read or built; the message says why, in one short line."""


@dataclasses.dataclass(frozen=True)
class Foot:
    """The place of a foot without a geom, site or body."""

    __pydantic_config__ = STRICT

    body: Name
    offset: Place  #: in the body's frame, m


@dataclasses.dataclass(frozen=True)
class FixedJoint:
    """A joint to fix at another position than 0."""

    __pydantic_config__ = STRICT

    joint: Name  #: a hinge or a slide
    at: Number  #: its position in its maker's model, rad or m


@dataclasses.dataclass(frozen=True)
class LegFile:
    """A leg's table in the file."""

    __pydantic_config__ = STRICT

    name: Name
    joints: tuple[Name, Name, Name]  #: abduction, hip and knee
    foot: Name | Foot  #: name of a geom, site or body, or a place on a body
    side: Literal["left", "right"] | None = None  #: None: from its place
    end: Literal["front", "hind"] | None = None  #: None: from its place
    knee: Literal["forward", "backward"] | None = None
    """Direction in which the knee points; none: from its limits."""


@dataclasses.dataclass(frozen=True)
class RobotFile:
    """The content of a robot file; defaults come from the model, or scale with mass and size."""

    __pydantic_config__ = STRICT

    name: str  #: stem of the file name
    folder: Path  #: folder of the file
    model: Name
    """MJCF or URDF file, relative to `folder`; or `PACKAGE:PATH` of a file inside an installed
    Python package; or `menagerie:NAME`."""
    trunk: Name  #: name of the body to keep level
    legs: Annotated[tuple[LegFile, ...], Len(4, 4)]  #: in the order of the observation
    imu: Name | Place | None = None
    """Site on the trunk, or a place in its frame, m; none: the trunk's origin."""
    strip: tuple[Name | FixedJoint, ...] = ()
    """Bodies to remove, with their descendants, and joints to fix, at 0 or elsewhere."""
    foot_radius: Positive | None = None  #: m; none: from the sphere geoms of the feet
    foot_friction: Positive = 0.8  #: sliding friction of a foot on the board
    hip_torque: Positive | None = None
    """Torque limit of the abduction and hip servos, N m; none: from the model's actuators."""
    knee_torque: Positive | None = None
    """Torque limit of the knee servos, N m; none: from the model's actuators."""
    servo_stiffness: Gain | None = None
    """N m / rad; none, also of the next five: from the robot's mass and size."""
    servo_damping: Gain | None = None  #: N m s / rad
    servo_armature: Gain | None = None  #: inertia of rotor and gear at the joint, kg m^2
    body_height: Positive | None = None  #: standing height of the trunk's origin above the board, m
    action_max: Positive | None = None  #: greatest height change of one decision on one axis, m
    board_size: Positive | None = None  #: length of the board in training, m
    command_delay: Delay = 0.0  #: time until the servos obey a command, s
    servo_friction: Gain | None = None  #: dry friction of the gears at the joint, N m; none: 0
    source: str = ""  #: where the model is from
    license: str = ""  #: of the model


_GAIN = "be a number greater than 0, or three: of abductions, hips and knees"
REMEDIES = {
    "servo_stiffness": _GAIN,
    "servo_damping": _GAIN,
    "servo_armature": _GAIN,
    "servo_friction": _GAIN,
    "model": "be a name",
    "trunk": "be a name",
    "legs": "be four tables, as [legs.FL]",
    "joints": "name three: abduction, hip, knee",
    "foot": "be a geom, site or body, or { body = ..., offset = [x, y, z] }, in m",
    "imu": "be a site, or a place [x, y, z] in m",
    "strip": "list bodies and joints, by name or as { joint = ..., at = 0.5 }, in rad or m",
}


def read_robot_file(path: Path) -> RobotFile:
    """Reads a robot's TOML file.

    Raises:
      RobotError: if it is missing, unreadable or invalid.
    """
    try:
        if os.path.exists(path) and not os.path.isfile(path):
            raise RobotError(f"{path} is no regular file")
        with path.open("rb") as file:
            text = file.read(MAX_FILE + 1).decode("utf-8-sig")
        if len(text) > MAX_FILE:
            raise RobotError(f"{path} is larger than {MAX_FILE} bytes, the most")
    except FileNotFoundError:
        raise RobotError(
            f"no robot file at {path}; `mjx-balance robot new MODEL.xml` drafts one"
        ) from None
    except (OSError, UnicodeDecodeError) as error:
        raise RobotError(f"{path} cannot be read: {shorten(error, MESSAGE)}") from error
    return parse_robot_file(text, path)


def parse_robot_file(text: str, path: Path) -> RobotFile:
    """Parses the content of a robot file.

    Args:
      text: TOML.
      path: gives name and folder; need not exist.

    Raises:
      RobotError: names the first invalid field, its value and what would be right.
    """
    try:
        values = tomllib.loads(text)
        legs = values.get("legs")
        if isinstance(legs, dict):
            values["legs"] = [_with(leg, name=name) for name, leg in legs.items()]
        values = _with(values, name=printable(path.stem), folder="")
        file = parse(RobotFile, values, remedies=REMEDIES)
        # A path may hold bytes that are no UTF-8, which JSON does not.
        file = dataclasses.replace(file, folder=path.absolute().parent)
        _check_joints(file)
    except RecursionError:
        raise RobotError(f"{path}: its values are nested too deep to be read") from None
    except ValueError as error:
        raise RobotError(f"{path}: {shorten(error, MESSAGE)}") from error
    return file


def _with(table: Any, **own: str) -> Any:
    """A table with fields that its key or the file's path gives."""
    if not isinstance(table, dict):
        return table
    for key in own:
        if key in table:
            raise RobotError(f"unknown field {key!r}; a {key} is not said here")
    return table | own


def _check_joints(file: RobotFile) -> None:
    """Checks that no joint is named twice."""
    owners: dict[str, str] = {}
    for leg in file.legs:
        for joint in leg.joints:
            owner = owners.get(joint)
            if owner is not None:
                rest = "twice" if owner == leg.name else f"and in leg {leg.name}"
                raise RobotError(f"joint {quote(joint)} is in leg {owner} {rest}")
            owners[joint] = leg.name
