"""Finds robots: shipped ones by name, Menagerie's by `menagerie:NAME`, others by TOML file."""

import functools
from pathlib import Path

import mujoco

from mjx_balance.errors import quote
from mjx_balance.robots.build import build
from mjx_balance.robots.draft import draft
from mjx_balance.robots.model import model_path
from mjx_balance.robots.robot import Robot
from mjx_balance.robots.schema import RobotError, RobotFile, parse_robot_file, read_robot_file

SHIPPED = Path(__file__).resolve().parent
OURS = ("quadruped", "quadruped_soft")
MENAGERIE = "menagerie:"


def shipped() -> list[str]:
    """Returns the names of the robots whose files are part of this package."""
    return sorted(path.stem for path in SHIPPED.glob("*.toml"))


def makers() -> list[str]:
    """Returns those of them that other makers make."""
    return [name for name in shipped() if name not in OURS]


def robot_file(name: str) -> RobotFile:
    """Reads or drafts the file of a robot.

    Args:
      name: as `Config.robot`: a shipped robot's name, the path of a TOML file, or `menagerie:NAME`.

    Raises:
      RobotError: if there is none, or its file is invalid.
    """
    if name.endswith(".toml"):
        return read_robot_file(Path(name))
    if name.startswith(MENAGERIE):
        return _draft_file(name)
    if name not in shipped():
        raise RobotError(
            f"robot is {quote(name)}; known robots: {', '.join(shipped())}; or menagerie:NAME, or "
            "a TOML file"
        )
    return read_robot_file(SHIPPED / f"{name}.toml")


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
