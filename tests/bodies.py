"""Robots other than ours, made of ours."""

import dataclasses
from typing import Any

from mjx_balance.robots import Robot


def with_legs(robot: Robot, **changes: Any) -> Robot:
    """The robot with the same numbers changed in all legs."""
    legs = tuple(dataclasses.replace(leg, **changes) for leg in robot.legs)
    return dataclasses.replace(robot, legs=legs)
