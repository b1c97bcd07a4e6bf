"""What `mjx-balance robot check` says of a robot: built, stood on the board, tilted. No JAX."""

import math
from typing import NamedTuple

import mujoco
import numpy as np

from mjx_balance.config import Config, check, fitted, greatest_incline, preset
from mjx_balance.robots import Robot
from mjx_balance.robots.measuring import UNLIMITED
from mjx_balance.scene import Scene, load_scene
from mjx_balance.suites import authority
from mjx_balance.task.attitude import body_tilt
from mjx_balance.task.kinematics import joint_angles

MOST_CREEP = 0.01
"""Of a robot that stands still, m/s."""
MOVING, WAITING = 3.0, 1.0
"""Time to turn the board, and to watch the robot at rest then, s."""


class Tilted(NamedTuple):
    """A robot that its legs keep level on a board held at the greatest incline on both axes."""

    torque_share: np.ndarray
    """(legs, 3) of each servo's limit that it takes."""
    tilt: float
    """Of the body at the end, deg."""
    creep: float
    """What the trunk moves by meanwhile, m/s: regularised friction gives way."""
    qpos: np.ndarray
    """(nq,) at the end."""


def find_out(robot: str) -> tuple[Scene, Tilted]:
    """Builds a robot's scene and tilts it.

    Args:
      robot: as `config.robot`.

    Raises:
      ConfigError: if it cannot be built, or does not stand.
    """
    config = check(fitted(preset("default"), robot))
    scene = load_scene(config)
    return scene, tilted(scene)


def tilted(scene: Scene) -> Tilted:
    """Turns the board to `max_incline` on both axes, the body kept level by geometry alone."""
    model, task, robot = scene.model, scene.config.task, scene.robot
    data = mujoco.MjData(model)
    data.qpos[:], data.qvel[:] = scene.stance.qpos, scene.stance.qvel
    slope = math.tan(math.radians(task.max_incline))
    rise = slope * (robot.each("y") - robot.each("x"))
    steps = round(MOVING / task.sim_dt)
    angle = math.radians(task.max_incline)
    root = scene.trunk_quat[0] - 3
    rested = data.qpos[root : root + 3].copy()
    for k in range(steps + round(WAITING / task.sim_dt)):
        share = min(1.0, (k + 1) / steps)
        data.ctrl[scene.board_ctrl] = share * angle
        heights = task.body_height - share * rise
        data.ctrl[scene.leg_ctrl] = joint_angles(robot, heights) + scene.stance.leg_trim
        mujoco.mj_step(model, data)
        if k == steps:
            rested = data.qpos[root : root + 3].copy()
    limits = model.actuator_forcerange[scene.leg_ctrl, 1]
    return Tilted(
        torque_share=np.abs(data.actuator_force[scene.leg_ctrl]) / limits,
        tilt=float(body_tilt(data.qpos[scene.trunk_quat])),
        creep=float(np.linalg.norm(data.qpos[root : root + 3] - rested)) / WAITING,
        qpos=data.qpos.copy(),
    )


def described(scene: Scene, at_tilt: Tilted) -> list[str]:
    """What was found, line by line."""
    robot, config = scene.robot, scene.config
    low, high = robot.height_range
    lines = [
        f"{robot.name}: {robot.total_mass:.2f} kg, of which the trunk {robot.trunk_mass:.2f}",
        f"stands at {_mm(config.task.body_height)}; its legs reach from {_mm(low)} to {_mm(high)}",
        f"servos {robot.servo_stiffness:g} N m/rad, {robot.servo_damping:g} N m s/rad; limits "
        f"{_limit(robot.hip_torque)} (abduction, hip), {_limit(robot.knee_torque)} (knee)",
        "",
        *_legs(robot),
        "",
        *_abilities(config, robot),
        *_standing(scene, at_tilt),
    ]
    return lines


def _legs(robot: Robot) -> list[str]:
    lines = []
    for leg in robot.legs:
        side, ahead = "left" if leg.left else "right", "ahead" if leg.front else "behind"
        place = f"{'front' if leg.front else 'hind'} {side}"
        turns = " ".join(
            ("+" if sign > 0 else "-") + joint
            for sign, joint in zip(leg.signs, leg.joints, strict=True)
        )
        bend = "backward" if sum(leg.knee) < 0 else "forward"
        lines.append(
            f"{leg.name:>4}  {place:<10}  foot {_mm(abs(leg.x))} {ahead}, {_mm(abs(leg.y))} to the "
            f"{side}; thigh {_mm(leg.thigh)}, calf {_mm(leg.calf)}; knee {bend}; {turns}"
        )
    return lines


def _abilities(config: Config, robot: Robot) -> list[str]:
    able, reach = authority(config), greatest_incline(config.task, robot)
    task = config.task
    return [
        f"height changes up to {1000 * task.action_max:.2f} mm follow {able:.2f} deg/s, "
        f"{able / task.board_rate:.2f} of the board's {task.board_rate:g}",
        f"the legs follow {reach:.1f} deg on both axes at once; the board tilts to "
        f"{task.max_incline:g}",
    ]


def _standing(scene: Scene, at_tilt: Tilted) -> list[str]:
    leg, joint = np.unravel_index(np.argmax(at_tilt.torque_share), (4, 3))
    share, name = at_tilt.torque_share.max(), scene.robot.legs[leg].joints[joint]
    slow = at_tilt.creep < MOST_CREEP
    still = "stands still" if slow else f"slides by {1000 * at_tilt.creep:.0f} mm/s"
    incline = scene.config.task.max_incline
    return [
        f"at {incline:g} deg on both axes it {still}, level to {at_tilt.tilt:.2f} deg; the most "
        f"loaded servo, {name}, takes {100 * share:.0f}% of its torque",
    ]


def _limit(torque: float) -> str:
    return "none" if torque == UNLIMITED else f"{torque:g} N m"


def _mm(metres: float) -> str:
    return f"{1000 * metres:.0f} mm"
