"""The robots that can be trained, by name."""

from mjx_balance.robots.quadruped import QUADRUPED
from mjx_balance.robots.record import Robot

ROBOTS = {robot.name: robot for robot in (QUADRUPED,)}


class RobotError(ValueError):
    """An unknown robot; the message lists the known ones."""


def find_robot(name: str) -> Robot:
    """Returns the robot called `name`; raises `RobotError` with the known names."""
    if name not in ROBOTS:
        raise RobotError(f"robot is {name!r}; known robots: {', '.join(ROBOTS)}")
    return ROBOTS[name]
