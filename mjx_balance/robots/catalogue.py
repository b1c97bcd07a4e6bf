"""Finds robots: shipped ones by name, Menagerie's by `menagerie:NAME`, others by TOML file.

`use_robot` adds one that is made in Python, for this process.
"""

import dataclasses
import functools
import json
from pathlib import Path
from typing import Any

import mujoco

from mjx_balance.errors import quote, suggest
from mjx_balance.files.validation import parse
from mjx_balance.robots import OURS, SHIPPED, shipped
from mjx_balance.robots.build import build
from mjx_balance.robots.draft import draft
from mjx_balance.robots.model import model_path
from mjx_balance.robots.robot import Robot
from mjx_balance.robots.schema import RobotError, RobotFile, parse_robot_file, read_robot_file

MENAGERIE = "menagerie:"
_IN_PYTHON: dict[str, RobotFile] = {}


def makers() -> list[str]:
    """Returns those of them that other makers make."""
    return [name for name in shipped() if name not in OURS]


def robot_file(name: str) -> RobotFile:
    """Reads or drafts the file of a robot.

    Args:
      name: as `Config.robot`: a shipped robot's name, the path of a TOML file, `menagerie:NAME`, or
        a name that `use_robot` has returned.

    Raises:
      RobotError: if there is none, or its file is invalid.
    """
    if name in _IN_PYTHON:
        return _IN_PYTHON[name]
    if name.endswith(".toml"):
        return read_robot_file(Path(name))
    if name.startswith(MENAGERIE):
        return _draft_file(name)
    if name not in shipped():
        raise unknown_robot(name)
    return read_robot_file(SHIPPED / f"{name}.toml")


def unknown_robot(name: str) -> RobotError:
    """The error about a robot that is not here."""
    if ":" in name:
        return RobotError(
            f"robot is {quote(name)}, which is made in Python; name it with --robot module:NAME "
            "(in Python: catalogue.use_robot)"
        )
    remedy = suggest("robot", name, shipped())
    return RobotError(f"robot is {quote(name)}; {remedy}; or menagerie:NAME, or a TOML file")


def use_robot(file: RobotFile, name: str | None = None) -> str:
    """Makes a robot known in this process, and returns its name for `Config.robot`.

    Args:
      file: e.g. `dataclasses.replace(robot_file("go2"), name="soft_go2", servo_stiffness=60.0)`.
      name: of the robot in configs; None: the file's own.

    Raises:
      RobotError: if a field is invalid, or the name is taken by a shipped robot.
    """
    name = name or file.name
    parse(RobotFile, dataclasses.asdict(file), RobotError)
    if name in shipped() or name.endswith(".toml"):
        raise RobotError(
            f"name is {quote(name)}, which is a shipped robot's or a file's; give yours another"
        )
    _IN_PYTHON[name] = file
    return name


def in_python(name: str) -> dict[str, Any] | None:
    """A robot that is made in Python as JSON values, for another process; None for any other."""
    file = _IN_PYTHON.get(name)
    return file and json.loads(json.dumps(dataclasses.asdict(file), default=str))


@functools.lru_cache(maxsize=8)
def _draft_file(model: str) -> RobotFile:
    return parse_robot_file(draft(model, model_path(model, Path())), Path(model))


def robot_spec(name: str, visual: bool = False) -> mujoco.MjSpec:
    """Returns a new robot body for a scene to attach; as `robot_file` and `build.build`."""
    return build(robot_file(name), visual).spec


def robot_xml(name: str) -> str:
    """Returns a robot's body without visual geoms as MJCF; equal bodies give equal text."""
    spec = robot_spec(name)
    spec.compile()
    return spec.to_xml()


def find_robot(name: str) -> Robot:
    """Returns a robot's numbers, cached while its files stay the same; raises as `build.build`."""
    file = robot_file(name)
    return _build_robot(file, model_path(file.model, file.folder).stat().st_mtime_ns)


@functools.lru_cache(maxsize=64)
def _build_robot(file: RobotFile, _: int) -> Robot:
    return build(file).robot


def robot_notes(name: str) -> list[str]:
    """Returns what was mended, left out or is odd in a robot's model; raises as `build.build`."""
    return build(robot_file(name), visual=True).notes
