"""Our own quadruped, `scenes/quadruped.xml`, in the class of a Unitree Go2.

"Go2" marks the Go2's published dimensions, "chosen" what has no source.
"""

from mjx_balance.robots.record import Robot

LEGS = ("LF", "RF", "LH", "RH")

QUADRUPED = Robot(
    name="quadruped",
    model="quadruped.xml",
    legs=LEGS,  # paper Eq. 2
    left=(True, False, True, False),
    front=(True, True, False, False),
    joints=tuple((f"{leg}_abduction", f"{leg}_hip", f"{leg}_knee") for leg in LEGS),
    feet=tuple(f"{leg}_foot" for leg in LEGS),
    trunk="trunk",
    root="root",
    gyro="gyro",
    accelerometer="accelerometer",
    hip_x=0.193,  # Go2
    hip_y=0.0465,  # Go2
    abduction_offset=0.0955,  # Go2
    thigh=0.213,  # Go2
    calf=0.213,  # Go2
    foot_radius=0.022,  # Go2
    trunk_mass=6.92,  # Go2
    total_mass=15.2,  # Go2
    knee_min=-2.72,  # Go2
    knee_max=-0.838,  # Go2
    hip_torque=23.7,  # Go2
    knee_torque=45.4,  # Go2
    servo_stiffness=400.0,  # chosen
    servo_damping=16.0,  # chosen
    foot_friction=0.8,  # chosen
)
