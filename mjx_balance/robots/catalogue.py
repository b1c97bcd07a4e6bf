"""The robots that can be trained: shipped ones by name, others by their TOML file."""

import functools
from pathlib import Path

import mujoco

from mjx_balance.files.text import quote
from mjx_balance.robots.build import build, model_path
from mjx_balance.robots.draft import draft
from mjx_balance.robots.robot import Leg, Robot, robot_from_dict
from mjx_balance.robots.schema import (
    RobotError,
    RobotFile,
    parse_robot_file,
    read_robot_file,
)

__all__ = [
    "SHIPPED",
    "Leg",
    "Robot",
    "RobotError",
    "find_robot",
    "robot_file",
    "robot_from_dict",
    "robot_spec",
    "robot_xml",
    "shipped",
]

SHIPPED = Path(__file__).resolve().parent
MENAGERIE = "menagerie:"


def shipped() -> list[str]:
    """Names of the robots whose files are part of this package."""
    return sorted(path.stem for path in SHIPPED.glob("*.toml"))


def robot_file(name: str) -> RobotFile:
    """What is known of the robot that `config.robot` calls `name`.

    Args:
      name: a shipped robot's; the path of a TOML file; or `menagerie:NAME`.

    Raises:
      RobotError: if there is none, or its file is wrong.
    """
    if name.endswith(".toml"):
        return read_robot_file(Path(name))
    if name.startswith(MENAGERIE):
        return _drafted(name)
    if name not in shipped():
        raise RobotError(
            f"robot is {quote(name)}; known robots: {', '.join(shipped())}; or menagerie:NAME, or "
            "a TOML file"
        )
    return read_robot_file(SHIPPED / f"{name}.toml")


@functools.lru_cache(maxsize=8)
def _drafted(model: str) -> RobotFile:
    return parse_robot_file(draft(model, model_path(model, Path())), Path(model))


def robot_spec(name: str, visual: bool = False) -> mujoco.MjSpec:
    """A robot's body (`building.build`), new each time: whoever attaches it owns it."""
    return build(robot_file(name), visual)[0]


def robot_xml(name: str) -> str:
    """What `robot_spec` gives, as MJCF without looks: equal for equal bodies."""
    spec = robot_spec(name)
    spec.compile()
    return spec.to_xml()


def find_robot(name: str) -> Robot:
    """A robot's numbers; raises as `robot_file` and `building.build`."""
    file = robot_file(name)
    return _measured(file, model_path(file.model, file.folder).stat().st_mtime_ns)


@functools.lru_cache(maxsize=64)
def _measured(file: RobotFile, _: int) -> Robot:
    return build(file)[1]
