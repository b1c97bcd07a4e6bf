"""Robots other than ours, made of ours."""

import dataclasses
import math
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import mujoco
import numpy as np

from mjx_balance.robots.build import scene_dir
from mjx_balance.robots.catalogue import Robot


def with_legs(robot: Robot, **changes: Any) -> Robot:
    """The robot with the same numbers changed in all legs."""
    legs = tuple(dataclasses.replace(leg, **changes) for leg in robot.legs)
    return dataclasses.replace(robot, legs=legs)


LEGS = ("LF", "RF", "LH", "RH")
JOINTS = ("abduction", "hip", "knee")
INERTIA = ("ixx", "iyy", "izz", "ixy", "ixz", "iyz")


def file_text(model: Path, legs: Sequence[str] = LEGS, **extra: str) -> str:
    """The TOML file of a robot whose parts are called as ours.

    `extra` goes in front, or, for a leg's name, to its leg.
    """
    lines = [f'model = "{model}"', 'trunk = "trunk"']
    lines += [f"{name} = {value}" for name, value in extra.items() if name not in legs]
    for leg in legs:
        joints = ", ".join(f'"{leg}_{joint}"' for joint in JOINTS)
        lines += ["", f"[legs.{leg}]", f"joints = [{joints}]", f'foot = "{leg}_foot"']
        lines += [extra[leg]] if leg in extra else []
    return "\n".join(lines) + "\n"


def our_spec() -> mujoco.MjSpec:
    """Our own robot's model, to be made another maker's."""
    return mujoco.MjSpec.from_file(str(scene_dir() / "quadruped.xml"))


def turned(spec: mujoco.MjSpec, degrees: float) -> mujoco.MjSpec:
    """Its trunk's frame turned about z, the robot itself left where it is."""
    trunk = spec.body("trunk")
    half = math.radians(degrees) / 2
    quat = np.asarray([math.cos(half), 0, 0, math.sin(half)])
    for element in (*trunk.bodies, *trunk.geoms, *trunk.sites):
        place, turn = np.zeros(3), np.zeros(4)
        mujoco.mju_rotVecQuat(place, element.pos, quat)
        mujoco.mju_mulQuat(turn, quat, element.quat)
        element.pos, element.quat = place, turn
        element.alt.type = mujoco.mjtOrientation.mjORIENTATION_QUAT
    trunk.inertia = trunk.inertia[[1, 0, 2]] if round(degrees / 90) % 2 else trunk.inertia
    return spec


def backward_axes(spec: mujoco.MjSpec) -> mujoco.MjSpec:
    """Every joint of the left legs turns the other way round."""
    for joint in spec.joints:
        if joint.name.startswith("L"):
            joint.axis, joint.range = -joint.axis, -joint.range[::-1]
    return spec


def drawn_standing(spec: mujoco.MjSpec) -> mujoco.MjSpec:
    """All joint angles are zero where the robot stands with bent legs."""
    lean = 0.7
    for leg in LEGS:
        for part, joint, angle in (("thigh", "hip", lean), ("calf", "knee", -2 * lean)):
            spec.body(f"{leg}_{part}").quat = [math.cos(angle / 2), 0, math.sin(angle / 2), 0]
            spec.joint(f"{leg}_{joint}").range = spec.joint(f"{leg}_{joint}").range - angle
    return spec


def high_shoulders(spec: mujoco.MjSpec) -> mujoco.MjSpec:
    """Abduction axes 30 mm above the trunk's origin, hips 20 mm below these."""
    for leg in LEGS:
        for part, z in (("hip", 0.03), ("thigh", -0.02)):
            body = spec.body(f"{leg}_{part}")
            body.pos = [*body.pos[:2], z]
    return spec


def with_motors(spec: mujoco.MjSpec) -> mujoco.MjSpec:
    """Torque motors in another order, on geared shafts, and feet on bodies of their own.

    A floor, a lamp, a keyframe, contacts, joints with friction and springs, other options, an IMU
    mounted askew.
    """
    for servo in [*spec.actuators, *spec.sensors]:
        spec.delete(servo)
    for leg in reversed(LEGS):
        for joint, torque in zip(JOINTS, (23.7, 23.7, 45.4), strict=True):
            gear = 9.1
            motor = spec.add_actuator(
                name=f"motor_{leg}_{joint}",
                target=f"{leg}_{joint}",
                trntype=mujoco.mjtTrn.mjTRN_JOINT,
                ctrlrange=[-torque / gear, torque / gear],
                ctrllimited=1,
                gear=[gear, 0, 0, 0, 0, 0],
            )
            motor.set_to_motor()
    for geom in spec.geoms:
        geom.contype = geom.conaffinity = 1
    for joint in spec.joints:
        joint.frictionloss, joint.stiffness = 0.3, [2.0, 0, 0]
    for leg in LEGS:
        old = spec.geom(f"{leg}_foot")
        tip = spec.body(f"{leg}_calf").add_body(name=f"{leg}_tip", pos=old.pos)
        size = old.size
        spec.delete(old)
        tip.add_geom(name=f"{leg}_foot", type=mujoco.mjtGeom.mjGEOM_SPHERE, size=size, mass=0)
    spec.worldbody.add_geom(type=mujoco.mjtGeom.mjGEOM_PLANE, size=[1, 1, 0.1])
    spec.worldbody.add_light(pos=[0, 0, 3])
    spec.add_key(name="home", qpos=[0, 0, 0.3, 1, 0, 0, 0] + [0.0, 0.8, -1.6] * 4)
    spec.option.timestep, spec.option.impratio = 0.001, 100
    spec.site("imu").quat = [0.6, 0, 0, 0.8]
    return spec


def urdf_text(root: str = "trunk") -> str:
    """Our robot's legs and masses as a URDF; a root of another name is a link without weight."""

    def link(name: str, mass: float, shape: str = "") -> str:
        same = " ".join(f'{i}="{0.01 * (i[1] == i[2])}"' for i in INERTIA)
        inertial = f'<inertial><mass value="{mass}"/><inertia {same}/></inertial>'
        solid = f"<collision><geometry>{shape}</geometry></collision>" if shape else ""
        return f'<link name="{name}">{inertial}{solid}</link>'

    def joint(name: str, ends: tuple[str, str], place: str, turns: str = "") -> str:
        kind = "revolute" if turns else "fixed"
        parent, child = ends
        return (
            f'<joint name="{name}" type="{kind}"><parent link="{parent}"/><child link="{child}"/>'
            f'<origin xyz="{place}"/>{turns}</joint>'
        )

    def turns(axis: str, low: float, high: float, torque: float) -> str:
        limit = f'lower="{low}" upper="{high}" effort="{torque}" velocity="20"'
        return f'<axis xyz="{axis}"/><limit {limit}/>'

    parts = [link("trunk", 6.92, '<box size="0.3 0.1 0.1"/>')]
    if root != "trunk":
        parts += [f'<link name="{root}"/>', joint("stand", (root, "trunk"), "0 0 0")]
    for name, x, y in (("LF", 1, 1), ("RF", 1, -1), ("LH", -1, 1), ("RH", -1, -1)):
        hip, thigh, calf, tip = (f"{name}_{part}" for part in ("hip", "thigh", "calf", "tip"))
        parts += [link(hip, 0.68), link(thigh, 1.15), link(calf, 0.2)]
        parts += [link(tip, 0.04, '<sphere radius="0.022"/>')]
        place, knee = f"{0.193 * x} {0.0465 * y} 0", turns("0 1 0", -2.72, -0.838, 45.4)
        parts += [joint(f"{name}_abduction", ("trunk", hip), place, turns("1 0 0", -1, 1, 23.7))]
        place = f"0 {0.0955 * y} 0"
        parts += [joint(f"{name}_hip", (hip, thigh), place, turns("0 1 0", -1.5, 3.4, 23.7))]
        parts += [joint(f"{name}_knee", (thigh, calf), "0 0 -0.213", knee)]
        parts += [joint(f"{name}_tip", (calf, tip), "0 0 -0.213")]
    return f'<robot name="ours">{"".join(parts)}</robot>'
