"""The numbers of a robot that the task, the scene and the runtime use."""

import dataclasses
import math
from typing import Annotated

import numpy as np
from annotated_types import Ge, Gt, Le, Len

from mjx_balance.files.validation import STRICT

MOST = 1e7  #: bound of a robot's numbers, in their units
Number = Annotated[float, Ge(-MOST), Le(MOST)]
Gain = Number | tuple[Number, Number, Number]  #: of all servos, or of abduction, hip and knee
Length = Annotated[float, Gt(0), Le(MOST)]
Delay = Annotated[float, Ge(0), Le(10)]
Turn = Annotated[float, Ge(-16), Le(16)]  #: rad; two and a half turns are 15.7
Bend = Annotated[float, Ge(-math.pi), Le(math.pi)]
OUR_MASS, OUR_LEVER = 15.2, 0.193  #: mass and lever of our own robot, kg and m
OUR_TRACK, OUR_HEIGHT = 0.142, 0.35  #: its half track and standing height, m


@dataclasses.dataclass(frozen=True)
class Leg:
    """Three hinges and a foot, in the trunk's frame: x forward, y left, z up.

    A joint angle q turns the leg by `sign * q + zero`: the abduction about x, 0 with the hip's axis
    level; the hip about y, 0 with the thigh hanging straight down; the knee about y, 0 with the leg
    straight. The foot stands under the hip, in the plane of hip and knee.
    """

    __pydantic_config__ = STRICT

    name: str
    left: bool
    front: bool
    joints: tuple[str, str, str]  #: abduction, hip and knee; the scene's servos have the same names
    foot: str  #: name of the foot's sphere geom in the scene
    x: Number  #: x of the hip, and of the foot under it, m
    y: Number  #: y of the foot, m
    axis_height: Number  #: z of the abduction's axis, m
    drop: Number  #: distance from the abduction's axis down to the hip, m
    offset: Number  #: distance from the abduction's axis to the left, to the plane of the foot, m
    thigh: Length  #: length from hip to knee, m
    calf: Length  #: length from knee to the foot's centre, m
    signs: tuple[Number, Number, Number]  #: +-1, of abduction, hip and knee
    zeros: tuple[Turn, Turn, Turn]  #: turns at joint angle 0, rad
    knee: tuple[Bend, Bend]
    """Least and greatest turn of the calf against the thigh, rad; negative: the knee points
    backward."""

    def height(self, knee: float) -> float:
        """Distance from the trunk's origin down to the foot's centre at a turn of the knee, m."""
        squared = self.thigh**2 + self.calf**2 + 2 * self.thigh * self.calf * math.cos(knee)
        return math.sqrt(max(squared, 0.0)) + self.drop - self.axis_height


@dataclasses.dataclass(frozen=True)
class Body:
    """Geometry (m) and mass (kg), measured on the compiled model."""

    __pydantic_config__ = STRICT

    name: str  #: the stem of the robot's file name
    legs: Annotated[tuple[Leg, ...], Len(4, 4)]  #: in the order of the observation
    trunk: str  #: name of the body to keep level; it has a free joint
    foot_radius: Number
    trunk_mass: Number
    total_mass: Number

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
        """Half of the feet's span, along x or y, whichever is longer, m."""
        return max(float(np.ptp(self.each(axis))) / 2 for axis in "xy")

    @property
    def leg_length(self) -> float:
        """Mean length of thigh and calf together, m."""
        return float(np.mean(self.each("thigh") + self.each("calf")))

    @property
    def height_range(self) -> tuple[float, float]:
        """Least and greatest body height above the board that all legs reach, m."""
        ends = [sorted(map(leg.height, leg.knee)) for leg in self.legs]
        least, most = max(low for low, _ in ends), min(high for _, high in ends)
        return least + self.foot_radius, most + self.foot_radius

    @property
    def mass_scale(self) -> float:
        """Mass relative to our own robot's, to three decimals."""
        return round(self.total_mass / OUR_MASS, 3)

    @property
    def size_scale(self) -> float:
        """Greatest of half length and half track relative to our own robot's, to three decimals."""
        return round(max(self.half_length, self.half_track) / OUR_LEVER, 3)

    def each(self, name: str) -> np.ndarray:
        """Values of a field of `Leg`, (legs, ...)."""
        return np.asarray([getattr(leg, name) for leg in self.legs], float)


@dataclasses.dataclass(frozen=True)
class Robot(Body):
    """Body, servos, friction and the numbers that scale with size (`measure.measure`)."""

    hip_torque: Number  #: limit of the abduction and hip servos, N m
    knee_torque: Number  #: limit of the knee servos, N m
    servo_stiffness: Gain  #: position gain of the leg servos, N m / rad
    servo_damping: Gain  #: damping of the leg joints, N m s / rad
    servo_armature: Gain  #: inertia of rotor and gear at the joint, kg m^2
    foot_friction: Number  #: sliding friction of a foot on the board
    body_height: Number  #: standing height of the trunk's origin, foot radius included, m
    action_max: Number  #: greatest height change of one decision on one axis, m
    command_delay: Delay = 0.0  #: time until the servos obey a command, s
    servo_friction: Gain = 0.0  #: dry friction of the gears at the joint, N m

    @property
    def push_scale(self) -> float:
        """Speed from which a push tips it over, relative to our own robot's, to three decimals.

        A pendulum of height h tips over an edge at distance d from a speed of d sqrt(g / h); d is
        half of the feet's span, along or across, whichever is shorter.
        """
        distance = min(float(np.ptp(self.each(axis))) / 2 for axis in "xy")
        return round(distance / OUR_TRACK * math.sqrt(OUR_HEIGHT / self.body_height), 3)


def per_joint(gain: Gain) -> np.ndarray:
    """A gain of abduction, hip and knee, (3,)."""
    return np.broadcast_to(gain, 3)


def gain_text(gain: Gain) -> str:
    """A gain as text; three if abduction, hip and knee differ."""
    values = per_joint(gain).tolist()
    return "/".join(f"{x:g}" for x in (values if len(set(values)) > 1 else values[:1]))
