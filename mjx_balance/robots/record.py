"""The record of a robot."""

import dataclasses
import math


@dataclasses.dataclass(frozen=True)
class Robot:
    """What the task and the scene need to know of a robot.

    The numbers repeat the model file's; `scene.build_model` compares them with the
    compiled model. Tuples over the legs are in the order of `legs`.
    """

    name: str
    """As `config.robot` names it."""
    model: str
    """MJCF file in scenes/."""
    legs: tuple[str, ...]
    """Names in observation order (paper Eq. 2)."""
    left: tuple[bool, ...]
    """Whether each leg is on the left side."""
    front: tuple[bool, ...]
    """Whether each leg is in front."""
    joints: tuple[tuple[str, str, str], ...]
    """Abduction, hip and knee joint of each leg; its servos have the same names."""
    feet: tuple[str, ...]
    """Sphere geoms that touch the board."""
    trunk: str
    """The body that is kept level."""
    root: str
    """Its free joint."""
    gyro: str
    """Sensor."""
    accelerometer: str
    """Sensor."""
    hip_x: float
    """Fore-aft distance of the hips from the trunk centre, m."""
    hip_y: float
    """Lateral distance of the abduction axes from the trunk centre, m."""
    abduction_offset: float
    """Lateral distance from the abduction axis to the leg plane, m."""
    thigh: float
    """Hip to knee, m."""
    calf: float
    """Knee to foot centre, m."""
    foot_radius: float
    """Radius of the feet, m."""
    trunk_mass: float
    """kg."""
    total_mass: float
    """kg."""
    knee_min: float
    """rad."""
    knee_max: float
    """rad."""
    hip_torque: float
    """Limit of the abduction and hip servos, N m."""
    knee_torque: float
    """Limit of the knee servos, N m."""
    servo_stiffness: float
    """Position gain of the leg servos, N m / rad."""
    servo_damping: float
    """Damping of the leg joints, N m s / rad."""
    foot_friction: float
    """Sliding friction of a foot on the board."""

    @property
    def half_track(self) -> float:
        """Lateral distance of a foot from the trunk centre, m."""
        return self.hip_y + self.abduction_offset

    @property
    def height_range(self) -> tuple[float, float]:
        """Least and greatest body height above a foot's contact point, m (knee range)."""

        def height(knee: float) -> float:
            squared = self.thigh**2 + self.calf**2 + 2 * self.thigh * self.calf * math.cos(knee)
            return math.sqrt(squared) + self.foot_radius

        return height(self.knee_min), height(self.knee_max)
