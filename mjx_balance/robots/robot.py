"""A robot in numbers: what the task, the scene and a robot's own computer need to know of it."""

import dataclasses
import math
from typing import Annotated, Any

import numpy as np
from annotated_types import Ge, Le, Len

from mjx_balance.files.validation import STRICT, parse

MOST = 1e7
"""Of any number of a robot, in its unit: what is greater has never walked."""
Number = Annotated[float, Ge(-MOST), Le(MOST)]
OUR_MASS, OUR_LEVER = 15.2, 0.193
"""Of our own robot, kg and m."""


@dataclasses.dataclass(frozen=True)
class Leg:
    """Three hinges and a foot, measured in the trunk's frame: x forward, y left, z up.

    A joint's angle q turns the leg by `sign * q + zero`: the abduction about x from where the
    hip's axis is level, the thigh about y from hanging straight down, the knee about y from
    straight. The foot is kept under the hip, in the plane that hip and knee move in.
    """

    __pydantic_config__ = STRICT

    name: str
    left: bool
    front: bool
    joints: tuple[str, str, str]
    """Abduction, hip and knee; the scene's servos have the same names."""
    foot: str
    """Sphere geom of the scene that touches the board."""
    x: Number
    """Of the hip, and of the foot when it stands under it, m."""
    y: Number
    """Of the foot, m."""
    axis_height: Number
    """z of the abduction's axis, m."""
    drop: Number
    """From there down to the hip, m."""
    offset: Number
    """From there to the left, to the plane of the foot, m."""
    thigh: Number
    """Hip to knee, m."""
    calf: Number
    """Knee to the foot's centre, m."""
    signs: tuple[Number, Number, Number]
    """Of abduction, hip and knee, +-1."""
    zeros: tuple[Number, Number, Number]
    """rad"""
    knee: tuple[Number, Number]
    """Least and greatest turn of the calf against the thigh, rad; negative: the knee points
    backward."""

    def height(self, knee: float) -> float:
        """From the trunk's origin down to the foot's centre, for a turn of the knee, m."""
        squared = self.thigh**2 + self.calf**2 + 2 * self.thigh * self.calf * math.cos(knee)
        return math.sqrt(squared) + self.drop - self.axis_height


@dataclasses.dataclass(frozen=True)
class Body:
    """Geometry and mass, measured on the compiled model; legs in observation order."""

    __pydantic_config__ = STRICT

    name: str
    """Its file's."""
    legs: Annotated[tuple[Leg, ...], Len(4, 4)]
    trunk: str
    """The body that is kept level, on a free joint."""
    foot_radius: Number
    """m"""
    trunk_mass: Number
    """kg"""
    total_mass: Number
    """kg"""

    @property
    def names(self) -> tuple[str, ...]:
        """Of the legs."""
        return tuple(leg.name for leg in self.legs)

    @property
    def left(self) -> tuple[bool, ...]:
        """Whether each leg is on the left side."""
        return tuple(leg.left for leg in self.legs)

    @property
    def front(self) -> tuple[bool, ...]:
        """Whether each leg is in front."""
        return tuple(leg.front for leg in self.legs)

    @property
    def joints(self) -> tuple[tuple[str, str, str], ...]:
        """Of each leg."""
        return tuple(leg.joints for leg in self.legs)

    @property
    def half_length(self) -> float:
        """Greatest fore-aft distance of a foot from the trunk's origin, m."""
        return max(abs(leg.x) for leg in self.legs)

    @property
    def half_track(self) -> float:
        """Greatest lateral distance of a foot from the trunk's origin, m."""
        return max(abs(leg.y) for leg in self.legs)

    @property
    def lever(self) -> float:
        """Half of what the feet span, along or across, m: a height change turns the body by it."""
        return max(float(np.ptp(self.each(axis))) / 2 for axis in "xy")

    @property
    def height_range(self) -> tuple[float, float]:
        """Least and greatest body height above a foot's contact point that all legs reach, m."""
        ends = [sorted(map(leg.height, leg.knee)) for leg in self.legs]
        least, most = max(low for low, _ in ends), min(high for _, high in ends)
        return least + self.foot_radius, most + self.foot_radius

    @property
    def mass_scale(self) -> float:
        """Mass against our own robot's, to three decimals."""
        return round(self.total_mass / OUR_MASS, 3)

    @property
    def size_scale(self) -> float:
        """Its furthest foot's distance, along or across, against our own's, to three decimals."""
        return round(max(self.half_length, self.half_track) / OUR_LEVER, 3)

    def each(self, name: str) -> np.ndarray:
        """One number of every leg, (legs, ...)."""
        return np.asarray([getattr(leg, name) for leg in self.legs], float)


@dataclasses.dataclass(frozen=True)
class Robot(Body):
    """A body with servos and feet (`measure.measure`)."""

    hip_torque: Number
    """Limit of the abduction and hip servos, N m."""
    knee_torque: Number
    """Limit of the knee servos, N m."""
    servo_stiffness: Number
    """Position gain of the leg servos, N m / rad."""
    servo_damping: Number
    """Damping of the leg joints, N m s / rad."""
    servo_armature: Number
    """Inertia of rotor and gear at the joint, kg m^2."""
    foot_friction: Number
    """Sliding friction of a foot on the board."""
    body_height: Number
    """Standing height of the trunk's origin above the board, foot radius included, m."""
    action_max: Number
    """Greatest height change of one decision on one axis, m."""


def robot_from_dict(values: Any) -> Robot:
    """Rebuilds a robot from the JSON values of `dataclasses.asdict`.

    Raises:
      InputError: if a field is missing, unknown or of another type.
    """
    return parse(Robot, values)
