"""The TOML file that describes a robot to `mjx_balance`, read and checked."""

import dataclasses
import tomllib
from pathlib import Path
from typing import Annotated, Any, Literal

from annotated_types import Gt, Le, Len, MinLen

from mjx_balance.config import ConfigError
from mjx_balance.files.text import MESSAGE, quote, shorten
from mjx_balance.files.validation import STRICT, parse
from mjx_balance.robots.robot import MOST, Number

Name = Annotated[str, MinLen(1)]
Positive = Annotated[float, Gt(0), Le(MOST)]
Place = tuple[Number, Number, Number]
"""x, y and z, m."""


class RobotError(ConfigError):
    """A robot that cannot be found, read or built; the message says what is wrong with it."""


@dataclasses.dataclass(frozen=True)
class Foot:
    """Where a foot is, if no geom, site or body is there."""

    __pydantic_config__ = STRICT

    body: Name
    offset: Place
    """In the body's frame, m."""


@dataclasses.dataclass(frozen=True)
class LegFile:
    """A leg, as a file describes it."""

    __pydantic_config__ = STRICT

    name: Name
    joints: tuple[Name, Name, Name]
    """Abduction, hip and knee."""
    foot: Name | Foot
    """Geom, site or body by its name, or a place on a body."""
    side: Literal["left", "right"] | None = None
    """None: as it is placed."""
    end: Literal["front", "hind"] | None = None
    """None: as it is placed."""
    knee: Literal["forward", "backward"] | None = None
    """Where it points; none: as its limits suggest."""


@dataclasses.dataclass(frozen=True)
class RobotFile:
    """What a file says; what it leaves out is read off the model, or follows from the size."""

    __pydantic_config__ = STRICT

    name: str
    folder: Path
    """Of the file."""
    model: Name
    """MJCF or URDF file, relative to `folder`; or `PACKAGE:PATH` of a file inside an installed
    Python package; or `menagerie:NAME`."""
    trunk: Name
    """Body."""
    legs: Annotated[tuple[LegFile, ...], Len(4, 4)]
    """In the order of the observation."""
    imu: Name | Place | None = None
    """Site on the trunk, or a place in its frame, m; none: its origin."""
    strip: tuple[Name, ...] = ()
    """Bodies to leave out, with all that hangs on them, and joints to fix."""
    foot_radius: Positive | None = None
    """m; none: of the model's spheres."""
    foot_friction: Positive = 0.8
    """Sliding friction of a foot on the board."""
    hip_torque: Positive | None = None
    """Limit of the abduction and hip servos, N m; none: of the model's actuators."""
    knee_torque: Positive | None = None
    """Limit of the knee servos, N m; none: of the model's actuators."""
    servo_stiffness: Positive | None = None
    """N m / rad; this and the next four: by the robot's mass and size if none."""
    servo_damping: Positive | None = None
    """N m s / rad."""
    servo_armature: Positive | None = None
    """Inertia of rotor and gear at the joint, kg m^2."""
    body_height: Positive | None = None
    """Standing height of the trunk's origin above the board, m."""
    action_max: Positive | None = None
    """Greatest height change of one decision on one axis, m."""
    board_size: Positive | None = None
    """Length of the board that it is trained on, m; none: by the robot's size."""
    source: str = ""
    """Of the model."""
    license: str = ""
    """Of the model."""


REMEDIES = {
    "model": "be a name",
    "trunk": "be a name",
    "legs": "be four tables, as [legs.FL]",
    "joints": "name three: abduction, hip, knee",
    "foot": "be a geom, site or body, or { body = ..., offset = [x, y, z] }, in m",
    "imu": "be a site, or a place [x, y, z] in m",
    "strip": "list bodies and joints",
}


def read_robot_file(path: Path) -> RobotFile:
    """Reads a robot's TOML file.

    Raises:
      RobotError: if it is missing, or something in it is not what it must be.
    """
    try:
        text = path.read_text(encoding="utf-8")
    except FileNotFoundError:
        raise RobotError(
            f"no robot file at {path}; `mjx-balance robot new MODEL.xml` drafts one"
        ) from None
    except (OSError, UnicodeDecodeError) as error:
        raise RobotError(f"{path} cannot be read: {shorten(error, MESSAGE)}") from error
    return parse_robot_file(text, path)


def parse_robot_file(text: str, path: Path) -> RobotFile:
    """Reads a robot file's content.

    Args:
      text: TOML.
      path: gives the robot's name and its folder; need not exist.

    Raises:
      RobotError: if something in it is not what it must be.
    """
    try:
        values = tomllib.loads(text)
        legs = values.get("legs")
        if isinstance(legs, dict):
            values["legs"] = [_with(leg, name=name) for name, leg in legs.items()]
        values = _with(values, name=path.stem, folder=str(path.absolute().parent))
        file = parse(RobotFile, values, remedies=REMEDIES)
        _check_joints(file)
    except RecursionError:
        raise RobotError(f"{path}: its values are nested too deep to be read") from None
    except ValueError as error:
        raise RobotError(f"{path}: {shorten(error, MESSAGE)}") from error
    return file


def _with(table: Any, **own: str) -> Any:
    """A table with what the file says of it elsewhere; what is no table is refused later."""
    if not isinstance(table, dict):
        return table
    for key in own:
        if key in table:
            raise RobotError(f"unknown field {key!r}; a {key} is not said here")
    return table | own


def _check_joints(file: RobotFile) -> None:
    """Refuses a joint that two legs, or one leg twice, name."""
    owners: dict[str, str] = {}
    for leg in file.legs:
        for joint in leg.joints:
            if owners.get(joint) == leg.name:
                raise RobotError(f"joint {quote(joint)} is in leg {leg.name} twice")
            if joint in owners:
                raise RobotError(
                    f"joint {quote(joint)} is in leg {owners[joint]} and in leg {leg.name}"
                )
            owners[joint] = leg.name
