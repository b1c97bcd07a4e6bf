"""The TOML file that describes a robot to `mjx_balance`, read and checked."""

import dataclasses
import tomllib
from collections.abc import Mapping
from pathlib import Path
from typing import Any

from mjx_balance.errors import InputError
from mjx_balance.robots.robot import MOST


class RobotError(InputError):
    """A robot that cannot be found, read or built; the message says what is wrong with it."""


@dataclasses.dataclass(frozen=True)
class Foot:
    """Where a foot is: a geom, site or body by its name, or a place on a body."""

    name: str
    offset: tuple[float, float, float] | None = None
    """In the frame of the body `name`, m; none: a geom's or site's centre, or a body's origin."""


@dataclasses.dataclass(frozen=True)
class LegFile:
    """A leg, as a file describes it."""

    name: str
    joints: tuple[str, str, str]
    """Abduction, hip and knee."""
    foot: Foot
    side: str | None = None
    """"left" or "right"; none: as it is placed."""
    end: str | None = None
    """"front" or "hind"; none: as it is placed."""
    knee: str | None = None
    """Where it points, "forward" or "backward"; none: as its limits suggest."""


@dataclasses.dataclass(frozen=True)
class RobotFile:
    """What a file says; what it leaves out is read off the model, or follows from the size."""

    name: str
    folder: Path
    """Of the file."""
    model: str
    """MJCF or URDF file, relative to `folder`; or `PACKAGE:PATH` of a file inside an installed
    Python package; or `menagerie:NAME`."""
    trunk: str
    """Body."""
    legs: tuple[LegFile, ...]
    """In the order of the observation."""
    imu: str | tuple[float, float, float] | None = None
    """Site on the trunk, or a place in its frame, m; none: its origin."""
    strip: tuple[str, ...] = ()
    """Bodies to leave out, with all that hangs on them, and joints to fix."""
    foot_radius: float | None = None
    foot_friction: float = 0.8
    hip_torque: float | None = None
    knee_torque: float | None = None
    servo_stiffness: float | None = None
    servo_damping: float | None = None
    servo_armature: float | None = None
    body_height: float | None = None
    action_max: float | None = None
    board_size: float | None = None
    """Length of the board that it is trained on, m; none: by the robot's size."""
    source: str = ""
    """Of the model."""
    license: str = ""
    """Of the model."""


NUMBERS = (
    *("foot_radius", "foot_friction", "hip_torque", "knee_torque", "servo_stiffness"),
    *("servo_damping", "servo_armature", "body_height", "action_max"),
    "board_size",
)


def read_robot_file(path: Path) -> RobotFile:
    """Reads a robot's TOML file.

    Raises:
      RobotError: if it is missing, or something in it is not what it must be.
    """
    try:
        text = path.read_text()
    except FileNotFoundError:
        raise RobotError(
            f"no robot file at {path}; `mjx-balance robot new MODEL.xml` drafts one"
        ) from None
    except (OSError, UnicodeDecodeError) as error:
        raise RobotError(f"{path} cannot be read: {error}") from error
    return parse_robot_file(text, path)


def parse_robot_file(text: str, path: Path) -> RobotFile:
    """A robot file's content; `path` gives its name and folder, and need not exist.

    Raises:
      RobotError: if something in it is not what it must be.
    """
    try:
        return _parsed(path, tomllib.loads(text))
    except RecursionError:
        raise RobotError(f"{path}: its values are nested too deep to be read") from None
    except ValueError as error:
        raise RobotError(f"{path}: {error}") from error


def _parsed(path: Path, values: dict[str, Any]) -> RobotFile:
    known = {f.name for f in dataclasses.fields(RobotFile)} - {"name", "folder"}
    _refuse_unknown("the file", values, known)
    for name in ("model", "trunk"):
        if not _is_name(values.get(name)):
            raise RobotError(f"{name} is {values.get(name)!r}; it must be a name")
    for name in ("source", "license"):
        if not isinstance(values.get(name, ""), str):
            raise RobotError(f"{name} is {values[name]!r}; it must be a text")
    legs = values.get("legs")
    if not isinstance(legs, dict) or len(legs) != 4:
        count = len(legs) if isinstance(legs, dict) else 0
        raise RobotError(f"legs has {count} entries; it must have four, as [legs.FL]")
    parsed = tuple(_leg(name, leg) for name, leg in legs.items())
    used: dict[str, str] = {}
    for leg in parsed:
        for joint in leg.joints:
            if used.get(joint) == leg.name:
                raise RobotError(f"joint {joint!r} is in leg {leg.name} twice")
            if joint in used:
                raise RobotError(f"joint {joint!r} is in leg {used[joint]} and in leg {leg.name}")
            used[joint] = leg.name
    for name in NUMBERS:
        value = values.get(name, 1.0)
        if not _is_number(value) or value <= 0:
            raise RobotError(
                f"{name} is {_shown(value)}; it must be a number above 0, at most {MOST:g}"
            )
        if name in values:
            values[name] = float(value)
    imu = values.get("imu")
    if isinstance(imu, list):
        values["imu"] = _triple("imu", imu)
    elif imu is not None and not isinstance(imu, str):
        raise RobotError(f"imu is {imu!r}; it must be a site, or a place [x, y, z] in m")
    strip = values.get("strip", [])
    if not isinstance(strip, list) or not all(map(_is_name, strip)):
        raise RobotError(f"strip is {strip!r}; it must list bodies and joints")
    values |= {"legs": parsed, "strip": tuple(strip)}
    return RobotFile(name=path.stem, folder=path.absolute().parent, **values)


def _leg(name: str, values: Any) -> LegFile:
    if not isinstance(values, dict):
        raise RobotError(f"leg {name} is {values!r}; it must be a table, [legs.{name}]")
    known = {f.name for f in dataclasses.fields(LegFile)} - {"name"}
    _refuse_unknown(f"leg {name}", values, known)
    joints = values.get("joints")
    if not (isinstance(joints, list) and len(joints) == 3 and all(map(_is_name, joints))):
        raise RobotError(
            f"joints of leg {name} is {joints!r}; it must name three: abduction, hip, knee"
        )
    foot = values.get("foot")
    if isinstance(foot, str) and foot:
        where = Foot(foot)
    elif isinstance(foot, dict) and set(foot) == {"body", "offset"} and _is_name(foot["body"]):
        where = Foot(foot["body"], _triple(f"foot of leg {name}", foot["offset"]))
    else:
        raise RobotError(
            f"foot of leg {name} is {foot!r}; it must be a geom, site or body, or "
            "{ body = ..., offset = [x, y, z] }"
        )
    said = {"side": ("left", "right"), "end": ("front", "hind"), "knee": ("forward", "backward")}
    for key, options in said.items():
        if values.get(key, options[0]) not in options:
            raise RobotError(
                f"{key} of leg {name} is {values[key]!r}; it must be {' or '.join(options)}"
            )
    words = {key: values.get(key) for key in said}
    return LegFile(name, (joints[0], joints[1], joints[2]), where, **words)


def _refuse_unknown(what: str, values: Mapping[str, Any], known: set[str]) -> None:
    unknown = sorted(set(values) - known)
    if unknown:
        raise RobotError(
            f"{what} has the unknown key {unknown[0]!r}; known keys: {', '.join(sorted(known))}"
        )


def _triple(name: str, value: Any) -> tuple[float, float, float]:
    if not isinstance(value, list) or len(value) != 3 or not all(map(_is_number, value)):
        raise RobotError(f"{name} is at {_shown(value)}; a place is three numbers, [x, y, z] in m")
    x, y, z = map(float, value)
    return x, y, z


def _is_number(value: Any) -> bool:
    number = isinstance(value, (int, float)) and not isinstance(value, bool)
    return number and abs(value) <= MOST


def _is_name(value: Any) -> bool:
    return isinstance(value, str) and bool(value)


def _shown(value: Any) -> str:
    """Its beginning, should it be long."""
    text = repr(value)
    return text if len(text) <= 60 else text[:60] + "..."
