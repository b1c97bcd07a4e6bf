"""The tests of `mjx-balance robot check`: a robot stands on the board, which tilts. No JAX."""

import itertools
import math
from collections.abc import Iterator
from typing import NamedTuple

import mujoco
import numpy as np

from mjx_balance.config import check, preset
from mjx_balance.errors import MESSAGE, quote, shorten
from mjx_balance.evaluation.suites import SUITES
from mjx_balance.robots.catalogue import robot_notes
from mjx_balance.robots.limits import authority, for_robot, greatest_incline, scale_ranges
from mjx_balance.robots.measure import UNLIMITED
from mjx_balance.robots.robot import Leg, gain_text
from mjx_balance.sim.scene import ROBOT, Scene, load_scene
from mjx_balance.task.attitude import body_tilt
from mjx_balance.task.kinematics import joint_angles

MAX_CREEP = 0.01
"""Greatest speed of a robot that counts as standing still, m/s."""
NO_TORQUE_LEFT = 0.99
"""Share of a servo's torque limit at which it has no reserve left."""
MAX_TORQUE = 5
"""Greatest plausible torque, relative to weight times leg; those of the shipped robots are 0.4 to
1."""
TILT_SECONDS, REST_SECONDS = 3.0, 1.0
"""Time in which the board turns, then in which it rests, s."""


class TiltTest(NamedTuple):
    """The worst of four tilt tests: the board turns either way about each axis."""

    torque_share: np.ndarray  # (legs, 3) greatest torque of each servo, as a share of its limit
    tilt: float  # greatest body tilt at the end, deg
    creep: float  # greatest mean speed of the trunk at rest, m/s: feet creep
    qpos: np.ndarray  # (nq,) final state of the test with the greatest torque


def inspect(robot: str) -> tuple[Scene, TiltTest]:
    """Builds a robot's scene and runs the tilt test; raises `ConfigError` if it does not stand."""
    scene = load_scene(check(for_robot(preset("default"), robot)))
    return scene, tilt_board(scene)


def tilt_board(scene: Scene) -> TiltTest:
    """Turns the board to `max_incline` on both axes; the legs level the body by geometry alone."""
    tests = [_tilt_board(scene, np.asarray(ways)) for ways in itertools.product((1, -1), repeat=2)]
    return TiltTest(
        torque_share=np.max([one.torque_share for one in tests], axis=0),
        tilt=max(one.tilt for one in tests),
        creep=max(one.creep for one in tests),
        qpos=max(tests, key=lambda one: one.torque_share.max().round(3)).qpos,
    )


def _tilt_board(scene: Scene, ways: np.ndarray) -> TiltTest:
    """One tilt test; `ways` (2,) is +-1, the direction about the board's X and Y."""
    model, task, robot = scene.model, scene.task, scene.robot
    data = mujoco.MjData(model)
    data.qpos[:], data.qvel[:] = scene.stance.qpos, scene.stance.qvel
    angle = math.radians(task.max_incline)
    rise = math.tan(angle) * (ways[0] * robot.each("y") - ways[1] * robot.each("x"))
    steps, path = round(TILT_SECONDS / task.sim_dt), []
    for k in range(steps + round(REST_SECONDS / task.sim_dt)):
        share = min(1.0, (k + 1) / steps)
        data.ctrl[scene.board_ctrl] = share * angle * ways
        heights = task.body_height - share * rise
        data.ctrl[scene.leg_ctrl] = joint_angles(robot, heights) + scene.stance.leg_trim
        mujoco.mj_step(model, data)
        path.append(data.qpos.copy())
    root = scene.trunk_quat[0] - 3
    moved = (path[-1] - path[steps])[root : root + 3]
    limits = model.actuator_forcerange[scene.leg_ctrl, 1]
    return TiltTest(
        torque_share=np.abs(data.actuator_force[scene.leg_ctrl]) / limits,
        tilt=float(body_tilt(data.qpos[scene.trunk_quat])),
        creep=float(np.linalg.norm(moved)) / REST_SECONDS,
        qpos=path[-1],
    )


def problems(scene: Scene, tilt_test: TiltTest) -> list[str]:
    """Reasons why the robot is not ready for training, one sentence each."""
    task, name, sentences = scene.task, shorten(scene.robot.name), []
    place = f"at {task.max_incline:g} deg on both axes"
    if tilt_test.tilt > task.fail_tilt:
        sentences.append(
            f"robot {name} does not hold itself level {place}: its body tilts to "
            f"{tilt_test.tilt:.1f} deg, and {task.fail_tilt:g} is a fall"
        )
    joint, share = _most_loaded(scene, tilt_test)
    if share >= NO_TORQUE_LEFT:
        load = f"{quote(joint)} takes {100 * share:.0f}% of its limit"
        sentences.append(f"robot {name} has no torque left {place}: {load}")
    return sentences


def _most_loaded(scene: Scene, tilt_test: TiltTest) -> tuple[str, float]:
    """Name and torque share of the most loaded servo; the first of equally loaded ones."""
    leg, joint = np.unravel_index(np.argmax(tilt_test.torque_share.round(3)), (4, 3))
    return scene.robot.legs[leg].joints[joint], float(tilt_test.torque_share.max())


def describe(scene: Scene, tilt_test: TiltTest) -> list[str]:
    """Describes the robot and the result of its tilt test, line by line."""
    robot, task, name = scene.robot, scene.task, shorten(scene.robot.name)
    low, high = robot.height_range
    able, reach = authority(task, robot), greatest_incline(task, robot)
    late = f"; obey after {1000 * robot.command_delay:g} ms" if robot.command_delay else ""
    return [
        f"{name}: {robot.total_mass:.2f} kg, of which the trunk {robot.trunk_mass:.2f}",
        f"stands at {_mm(task.body_height)}; its legs reach from {_mm(low)} to {_mm(high)}",
        f"servos {gain_text(robot.servo_stiffness)} N m/rad, {gain_text(robot.servo_damping)} N m "
        f"s/rad; limits "
        f"{_limit(robot.hip_torque)} (abduction, hip), {_limit(robot.knee_torque)} (knee){late}",
        "",
        *map(_leg, robot.legs),
        *(f"note: {shorten(note, MESSAGE)}" for note in robot_notes(scene.robot_source)),
        "",
        f"height changes up to {1000 * task.action_max:.2f} mm turn the trunk by {able:.2f} deg/s, "
        f"{able / task.board_rate:.2f} times the board's {task.board_rate:g}",
        f"the legs can level {reach:.1f} deg on both axes at once; the board tilts to "
        f"{task.max_incline:g}",
        _standing(scene, tilt_test),
        _stance(scene),
        *_implausible(scene),
    ]


def _leg(leg: Leg) -> str:
    place = f"{'front' if leg.front else 'hind'} {'left' if leg.left else 'right'}"
    ahead, side = "ahead" if leg.x > 0 else "behind", "left" if leg.y > 0 else "right"
    signs = ("+" if sign > 0 else "-" for sign in leg.signs)
    turns = " ".join(map("".join, zip(signs, map(shorten, leg.joints), strict=True)))
    bend = "backward" if sum(leg.knee) < 0 else "forward"
    return (
        f"{shorten(leg.name):>4}  {place:<10}  foot {_mm(abs(leg.x))} {ahead}, {_mm(abs(leg.y))} "
        f"to the {side}; thigh {_mm(leg.thigh)}, calf {_mm(leg.calf)}; knee {bend}; {turns}"
    )


def _standing(scene: Scene, tilt_test: TiltTest) -> str:
    joint, share = _most_loaded(scene, tilt_test)
    slow = tilt_test.creep < MAX_CREEP
    still = "stands still" if slow else f"slides by {1000 * tilt_test.creep:.0f} mm/s"
    loaded = f"the most loaded servo, {shorten(joint)}, takes {100 * share:.0f}% of its torque"
    if UNLIMITED in (scene.robot.hip_torque, scene.robot.knee_torque):
        loaded = "its model has no torque limits: set hip_torque and knee_torque, in N m"
    place = f"at {scene.task.max_incline:g} deg on both axes"
    return f"{place} it {still}, level to {tilt_test.tilt:.2f} deg; {loaded}"


def _stance(scene: Scene) -> str:
    """Where the centre of mass is among the feet, and the push that tips the robot over.

    A pendulum of height h tips over an edge at distance d from a speed of d sqrt(g / h).
    """
    data = mujoco.MjData(scene.model)
    data.qpos[:] = scene.stance.qpos
    mujoco.mj_forward(scene.model, data)
    feet = np.asarray([data.geom(f"{ROBOT}{leg.foot}").xpos for leg in scene.robot.legs])
    ahead, left, above = data.subtree_com[scene.trunk] - feet.mean(axis=0)
    height = above + scene.robot.foot_radius
    feet = feet[:, :2] - feet[:, :2].mean(axis=0)
    starts = feet[np.argsort(np.arctan2(*feet.T))] - (ahead, left)  # of the edges, from the centre
    ends = np.roll(starts, -1, axis=0)
    areas = np.abs(np.linalg.det(np.stack((starts, ends), axis=1)))
    distance = (areas / np.linalg.norm(ends - starts, axis=1)).min()
    tips = distance * math.sqrt(-scene.model.opt.gravity[2] / height)
    most = scale_ranges(SUITES["push"].randomization, scene.robot).push_max
    return (
        f"its centre of mass is {_mm(abs(ahead))} {'ahead of' if ahead > 0 else 'behind'} and "
        f"{_mm(abs(left))} {'left' if left > 0 else 'right'} of the middle of its feet, "
        f"{_mm(height)} above the board; it cannot bear pushes above {tips:.2f} m/s (suite push: "
        f"up to {most:.2f})"
    )


def _implausible(scene: Scene) -> Iterator[str]:
    """Warns of torque limits that no robot of its weight has."""
    robot = scene.robot
    holds = robot.total_mass * -scene.model.opt.gravity[2] * robot.leg_length
    for name in ("hip_torque", "knee_torque"):
        torque = getattr(robot, name)
        if torque > MAX_TORQUE * holds and torque != UNLIMITED:
            yield (
                f"warning: {name} is {torque:g} N m, {torque / holds:.0f} times the robot's "
                f"weight times its leg's length; set {name}, in N m, in the file"
            )


def _limit(torque: float) -> str:
    return "none" if torque == UNLIMITED else f"{torque:g} N m"


def _mm(metres: float) -> str:
    return f"{1000 * metres:.0f} mm"
