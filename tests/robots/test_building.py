"""A maker's model becomes the same robot however it is drawn, and the one it is."""

import dataclasses
import functools
import json
from collections.abc import Callable
from pathlib import Path
from typing import Any

import mujoco
import numpy as np
import pytest
from fixtures import bodies

from mjx_balance.cli.inspection import tilt_board
from mjx_balance.config import ConfigError, check, from_dict, preset
from mjx_balance.evaluation.controllers import make_controller, measure_response
from mjx_balance.evaluation.rollout import run_suite
from mjx_balance.robots.build import build as build_robot
from mjx_balance.robots.catalogue import (
    SHIPPED,
    Robot,
    RobotError,
    find_robot,
    robot_notes,
    robot_spec,
    robot_xml,
)
from mjx_balance.robots.draft import draft
from mjx_balance.robots.limits import for_robot
from mjx_balance.robots.robot import per_joint
from mjx_balance.robots.schema import parse_robot_file
from mjx_balance.sim.scene import ROBOT, Scene, load_scene
from mjx_balance.task.kinematics import foot_heights, joint_angles

LOOKS_BACK = {leg: f'end = "{"front" if leg[1] == "F" else "hind"}"' for leg in bodies.LEGS}
DRAWINGS: dict[str, tuple[Callable[[mujoco.MjSpec], mujoco.MjSpec], dict[str, Any]]] = {
    "as ours": (lambda spec: spec, {}),
    "other order": (lambda spec: spec, {"legs": ("RH", "LF", "RF", "LH")}),
    "other axes": (bodies.backward_axes, {}),
    "drawn standing": (bodies.drawn_standing, {}),
    "motors": (bodies.with_motors, {"foot_radius": "0.022"}),
    "looks along y": (lambda spec: bodies.turned(spec, 90), {}),
    "looks along -x": (lambda spec: bodies.turned(spec, 180), LOOKS_BACK),
    "looks along -y": (lambda spec: bodies.backward_axes(bodies.turned(spec, -90)), LOOKS_BACK),
}


@pytest.fixture(params=DRAWINGS, ids=str)
def drawing(request: pytest.FixtureRequest, tmp_path: Path) -> str:
    """Path of the file of our own robot, drawn in another way."""
    draw, extra = DRAWINGS[request.param]
    return bodies.write_robot(tmp_path, draw(bodies.our_spec()), imu='"imu"', **extra)


Edits = list[tuple[str, str]]


def scene_of(robot: str) -> Scene:
    return load_scene(check(for_robot(preset("default"), robot)))


shipped_scene = functools.cache(scene_of)
"""The scene of a shipped robot; do not modify its model."""


def check_kinematics(scene: Scene) -> None:
    """Heights from angles and back agree with MuJoCo; legs at a height stay within their limits."""
    robot, model, rng = scene.robot, scene.model, np.random.default_rng(0)
    joints = [[model.joint(f"{ROBOT}{name}").id for name in leg.joints] for leg in robot.legs]
    low, high = np.moveaxis(model.jnt_range[joints], -1, 0)
    limited = model.jnt_limited[joints].astype(bool)
    for height in np.linspace(*robot.height_range, 7):
        angles = joint_angles(robot, np.full(4, height))
        assert ((angles >= low - 1e-6) & (angles <= high + 1e-6) | ~limited).all()
        feet = feet_of(scene, angles)
        np.testing.assert_allclose(-feet[:, 2] + robot.foot_radius, height, atol=1e-6)
        np.testing.assert_allclose(feet[:, 0], robot.each("x"), atol=1e-6)
        np.testing.assert_allclose(feet[:, 1], robot.each("y"), atol=1e-6)
        other = angles + rng.uniform(-0.4, 0.4, (4, 3))
        below = -feet_of(scene, other)[:, 2] + robot.foot_radius
        np.testing.assert_allclose(foot_heights(robot, other), below, atol=1e-6)


def feet_of(scene: Scene, angles: np.ndarray) -> np.ndarray:
    """(legs, 3) centres of the feet from the trunk's origin, m."""
    data = mujoco.MjData(scene.model)
    data.qpos[scene.leg_qpos] = angles
    mujoco.mj_kinematics(scene.model, data)
    feet = [data.geom(f"{ROBOT}{leg.foot}").xpos for leg in scene.robot.legs]
    return np.asarray(feet) - data.body(f"{ROBOT}{scene.robot.trunk}").xpos


def test_our_robot_is_the_same_however_it_is_drawn(drawing: str, robot: Robot) -> None:
    """Up to order, signs and zeros; gains and heights follow by the rules."""
    other = find_robot(drawing)
    names = [leg.name for leg in other.legs]
    order = [names.index(leg.name) for leg in robot.legs]
    for k, leg in zip(order, robot.legs, strict=True):
        assert (other.legs[k].joints, other.legs[k].foot) == (leg.joints, leg.foot)
    for name in "left front x y axis_height drop offset thigh calf knee".split():
        np.testing.assert_allclose(
            other.each(name)[order], robot.each(name), atol=1e-6, err_msg=name
        )
    numbers = {name: x for name, x in vars(robot).items() if isinstance(x, float)}
    assert {name: vars(other)[name] for name in numbers} == pytest.approx(numbers, rel=2e-3)


@pytest.fixture(scope="module")
def tilt_of_ours() -> float:
    """Mean tilt under a controller that sees the IMU alone, deg."""
    scene = load_scene(preset("default"))
    return run_suite(scene, make_controller("pd-imu", scene), "corner", 4, 12.0, 1).tilt.mean()


def test_it_behaves_alike_however_it_is_drawn(
    drawing: str, scene: Scene, tilt_of_ours: float
) -> None:
    """Its feet, what an action does to roll and pitch, and a controller that sees the IMU alone."""
    other = scene_of(drawing)
    check_kinematics(other)
    passive = (other.model.jnt_stiffness, other.model.dof_frictionloss)
    assert not any(field.any() for field in (*passive, other.model.jnt_actfrclimited))
    theirs, ours = measure_response(other), measure_response(scene)
    np.testing.assert_allclose(theirs.gain, ours.gain, rtol=0.01)
    np.testing.assert_allclose(theirs.course, ours.course, atol=0.01)
    theirs = run_suite(other, make_controller("pd-imu", other), "corner", 4, 12.0, 1)
    assert not theirs.fell.any()
    assert theirs.tilt.mean() == pytest.approx(tilt_of_ours, rel=0.05)


def test_shoulders_and_hips_at_other_heights(tmp_path: Path) -> None:
    """Feet 10 mm nearer to the trunk's origin, all angles being the same."""
    scene = scene_of(bodies.write_robot(tmp_path, bodies.high_shoulders(bodies.our_spec())))
    robot, ours = scene.robot, find_robot("quadruped")
    assert (robot.legs[0].axis_height, robot.legs[0].drop) == pytest.approx((0.03, 0.02))
    assert robot.height_range == pytest.approx([x - 0.01 for x in ours.height_range])
    assert robot.body_height == pytest.approx(0.34, abs=1e-3)
    standing = joint_angles(robot, np.full(4, 0.34))
    np.testing.assert_allclose(standing, joint_angles(ours, np.full(4, 0.35)), atol=1e-9)
    check_kinematics(scene)


def test_a_hips_limits_limit_the_reach(tmp_path: Path) -> None:
    """A thigh that leans back by 0.6 rad at most, half the knee's turn: 0.426 cos 0.6 + 0.022."""
    edit = ('range="-1.5708 3.4907"', 'range="-1.5 0.6"')
    robot = find_robot(bodies.write_robot(tmp_path, [edit], body_height="0.39"))
    assert robot.height_range[0] == pytest.approx(0.426 * np.cos(0.6) + 0.022, abs=1e-3)
    assert robot.legs[0].knee == pytest.approx((-1.2, -0.838), abs=2e-3)


def test_the_reach_is_that_of_all_legs(robot: Robot) -> None:
    """One leg cannot fold as far, another not stretch as far."""
    legs = list(robot.legs)
    legs[1] = dataclasses.replace(legs[1], knee=(-2.0, -0.838))
    legs[2] = dataclasses.replace(legs[2], knee=(-2.72, -1.2))
    low, high = dataclasses.replace(robot, legs=tuple(legs)).height_range
    assert (low, high) == pytest.approx((0.426 * np.cos(1.0) + 0.022, 0.426 * np.cos(0.6) + 0.022))


PUBLISHED = {
    # kg, thigh and calf m, of the makers' data sheets or the models' own inertias
    "go1": (12.74, 0.213, 0.213, 35.55),
    "go2": (15.21, 0.213, 0.213, 45.43),
    "b2": (83.50, 0.35, 0.35, 300.0),
    "aliengo": (24.64, 0.25, 0.25, 44.4),
    "mini_cheetah": (12.47, 0.209, 0.18, 28.0),
    "spot": (50.34, 0.321, 0.3365, 135.278),
}


@pytest.mark.parametrize("name", bodies.MAKERS)
def test_a_makers_robot_is_what_it_is(name: str) -> None:
    robot, (mass, thigh, calf, torque) = find_robot(name), PUBLISHED[name]
    assert robot.total_mass == pytest.approx(mass, abs=0.01)
    assert robot.knee_torque == torque
    for leg in robot.legs:
        assert (leg.thigh, leg.calf) == pytest.approx((thigh, calf), abs=1e-3)
        assert (leg.name[1] == "L", leg.name[0] == "F") == (leg.left, leg.front)
        assert max(leg.knee) < 0, "knees point backward"
    low, high = robot.height_range
    assert low < robot.body_height < high
    check_kinematics(shipped_scene(name))


@pytest.mark.parametrize("name", bodies.SLOW_MAKERS)
def test_a_makers_robot_can_follow_the_board(name: str) -> None:
    """With our own's margin at least: 15 mm/s at 0.193 m, 4.45 deg/s, against the board's 3.5.

    Soft servos swing beyond their targets, and have not come back when the decision ends.
    """
    scene = shipped_scene(name)
    per_second = 5 * scene.task.action_max * np.abs(measure_response(scene).gain)
    assert per_second.min() > 4.45 * 0.92
    rollout = run_suite(scene, make_controller("rate-oracle", scene), "corner", 4, 12.0, 0)
    assert not rollout.fell.any()
    assert rollout.tilt.mean() < 0.4


@pytest.mark.parametrize("name", bodies.MAKERS)
def test_only_feet_touch_and_only_our_servos_pull(name: str) -> None:
    scene = shipped_scene(name)
    model, robot = scene.model, scene.robot
    assert not model.geom_contype.any()
    assert not model.geom_conaffinity.any()
    friction = np.zeros(model.nv)
    assert (model.npair, model.nu, model.nkey, model.ntendon, model.neq) == (4, 14, 0, 0, 0)
    assert model.body_mass[1:].sum() == pytest.approx(robot.total_mass + 10 * robot.mass_scale)
    assert (model.opt.timestep, model.opt.impratio) == (0.004, 1)
    for k, leg in enumerate(robot.legs):
        for j, joint in enumerate(leg.joints):
            servo = model.actuator(f"{ROBOT}{joint}")
            assert servo.id == scene.leg_ctrl[k, j]
            assert model.jnt_qposadr[servo.trnid[0]] == scene.leg_qpos[k, j]
            limit = robot.knee_torque if j == 2 else robot.hip_torque
            assert servo.forcerange.tolist() == [-limit, limit]
            assert servo.gainprm[0] == per_joint(robot.servo_stiffness)[j]
            friction[model.jnt_dofadr[servo.trnid[0]]] = per_joint(robot.servo_friction)[j]
    np.testing.assert_array_equal(model.dof_frictionloss, friction)


@pytest.mark.parametrize("name", bodies.SLOW_MAKERS)
def test_looks_are_there_for_the_eye(name: str) -> None:
    """And change nothing else."""
    scene = shipped_scene(name)
    visual = load_scene(check(for_robot(preset("default"), name)), visual=True)
    assert (scene.model.nmesh > 0, visual.model.nmesh > 0) == (False, True)
    assert visual.hash == scene.hash


@pytest.mark.parametrize("name", [*bodies.SLOW_MAKERS, "quadruped"])
def test_feet_hold_as_well_as_ours(name: str) -> None:
    """Regularised friction lets every robot creep; a light body for a foot, twice as fast."""
    assert tilt_board(shipped_scene(name)).creep < 0.005


def test_rules_of_size_by_hand() -> None:
    """B2: 83.498 kg on legs of 0.7 m; feet 0.3285 m ahead, 0.19173 m aside.

    Height 0.77 * 0.7 + 0.032; heights change by 3 mm * 0.3285 / 0.193; servos are stiffer by
    mass and (leg * height / half-track)^2: 5.4933 * (0.7 * 0.571 / 0.19173 / 1.05)^2 = 21.66.
    """
    lines = (SHIPPED / "b2.toml").read_text().splitlines()
    unsaid = "\n".join(line for line in lines if not line.startswith("servo_"))
    robot = build_robot(parse_robot_file(unsaid, Path("b2.toml")))[1]
    assert (robot.body_height, robot.action_max) == (0.571, 0.00511)
    servos = (robot.servo_stiffness, robot.servo_damping, robot.servo_armature)
    assert servos == pytest.approx((400 * 21.66, 16 * 21.66, 0.02 * 21.66), rel=2e-3)
    assert (robot.mass_scale, robot.size_scale) == (5.493, 1.702)


@pytest.mark.parametrize(("size", "stiffness"), [(0.5, 400 / 2**5), (0.25, 0.496), (0.22, 0.298)])
def test_small_robots_do_not_sag(size: float, stiffness: float, tmp_path: Path) -> None:
    """Equal frequencies take 400 size^5; weight times leg is 15.2 size^3 * 9.81 * 0.426 size.

    Twice that is 0.496 at a quarter of our size, and 0.298 at 0.22 of it.
    """
    robot = find_robot(bodies.write_robot(tmp_path, bodies.scaled(bodies.our_spec(), size)))
    assert robot.servo_stiffness == pytest.approx(stiffness, rel=0.01)
    assert robot.servo_damping == pytest.approx(16 / 400 * stiffness, rel=0.01)
    assert robot.servo_armature == pytest.approx(0.02 / 400 * stiffness, rel=0.01)


@pytest.mark.parametrize(("x", "stiffness"), [("0.1", 400 * 1.42**2), ("0.04", 400 * 3.55**2)])
def test_a_robot_wider_than_long_pitches_softest(x: str, stiffness: float, tmp_path: Path) -> None:
    """Its feet are 0.142 m aside and x ahead; at 0.04 its hips, too, are further apart aside."""
    edits = [(f'_hip" pos="{sign}0.193', f'_hip" pos="{sign}{x}') for sign in ("", "", "-", "-")]
    robot = find_robot(bodies.write_robot(tmp_path, edits))
    assert robot.servo_stiffness == pytest.approx(stiffness, rel=0.01)
    assert [(leg.left, leg.front) for leg in robot.legs] == [
        (leg.left, leg.front) for leg in find_robot("quadruped").legs
    ]
    text = draft("model.xml", tmp_path / "model.xml")
    assert "LF_abduction" in text.partition("[legs.FL]")[2].partition("[legs.FR]")[0]


def test_the_board_grows_with_the_robot() -> None:
    scene, ours = shipped_scene("b2"), shipped_scene("quadruped")
    length, mass = 1.702, 5.493

    def measures(model: mujoco.MjModel) -> list[Any]:
        body, servo = model.body("board/board"), model.actuator("board/board_x")
        joints = [model.joint(f"board/board_{axis}") for axis in "xy"]
        turning = [servo.gainprm, *(x.damping for x in joints), *(x.armature for x in joints)]
        return [model.geom("board/board").size, body.mass, body.inertia, *turning]

    factors = (length, mass, *[mass * length**2] * 6)
    rows = zip(measures(scene.model), measures(ours.model), factors, strict=True)
    for k, (large, small, factor) in enumerate(rows):
        np.testing.assert_allclose(large, factor * small, rtol=1e-6, err_msg=str(k))
    board = scene.model.geom("board/board")
    assert board.pos[2] == pytest.approx(-board.size[2]), "it is stood on at the pivot's height"
    configs = (for_robot(preset("default"), name) for name in ("b2", "quadruped"))
    far, near = (load_scene(x, visual=True).model.camera("main") for x in configs)
    np.testing.assert_allclose(far.pos, length * near.pos, rtol=1e-6)


def test_a_file_may_name_the_boards_size(tmp_path: Path) -> None:
    """1.4 m long, and wide and thick in proportion; its weight stays by the robot's."""
    name = bodies.write_robot(tmp_path / "large", board_size="1.4")
    plain = bodies.write_robot(tmp_path / "plain")
    scene, ours = scene_of(name), scene_of(plain)
    board, our_board = (x.model.geom("board/board") for x in (scene, ours))
    np.testing.assert_allclose(board.size, [0.7, 0.56, 0.028])
    assert (board.pos[2], our_board.size[0]) == pytest.approx((-0.028, 0.5))
    heavy, light = (x.model.body("board/board") for x in (scene, ours))
    assert heavy.mass[0] == light.mass[0]
    np.testing.assert_allclose(heavy.inertia, 1.4**2 * light.inertia)
    assert scene.hash != ours.hash, "a policy of another board is another policy"
    assert robot_xml(name) != robot_xml(plain), "and so is a program"


def test_a_files_own_numbers_win(tmp_path: Path) -> None:
    numbers: dict[str, Any] = {
        "servo_stiffness": "300.0",
        "servo_damping": "11.0",
        "servo_armature": "0.03",
        "foot_friction": "0.6",
        "foot_radius": "0.03",
        "hip_torque": "20.0",
        "knee_torque": "40.0",
        "body_height": "0.33",
        "action_max": "0.0025",
        "command_delay": "0.02",
    }
    scene = scene_of(bodies.write_robot(tmp_path, imu="[0.1, 0.02, 0.03]", **numbers))
    model, robot = scene.model, scene.robot
    for field, value in numbers.items():
        assert getattr(robot, field) == float(value), field
    assert model.geom(f"{ROBOT}{robot.legs[0].foot}").size[0] == 0.03
    assert model.site(f"{ROBOT}balance_imu").pos.tolist() == [0.1, 0.02, 0.03]
    assert model.pair_friction[0, 0] == 0.6


def test_gains_of_abduction_hip_and_knee_may_differ(tmp_path: Path) -> None:
    gains = {"stiffness": [60.0, 50.0, 80.0], "damping": [5.0, 4.0, 7.0]}
    gains |= {"armature": [0.1, 0.2, 0.3], "friction": [0.01, 0.02, 0.03]}
    fields: dict[str, Any] = {f"servo_{name}": f"{values}" for name, values in gains.items()}
    scene = scene_of(bodies.write_robot(tmp_path, **fields))
    for joints in (leg.joints for leg in scene.robot.legs):
        servos = [scene.model.actuator(f"{ROBOT}{joint}") for joint in joints]
        moving = [scene.model.joint(f"{ROBOT}{joint}") for joint in joints]
        assert [x.gainprm[0] for x in servos] == gains["stiffness"]
        assert [-x.biasprm[1] for x in servos] == gains["stiffness"]
        assert [x.damping[0] for x in moving] == gains["damping"]
        assert [x.armature[0] for x in moving] == gains["armature"]
        assert [x.frictionloss[0] for x in moving] == gains["friction"]
    assert from_dict(Robot, json.loads(json.dumps(dataclasses.asdict(scene.robot)))) == scene.robot


INERTIAL = '<inertial pos="0 0 0" mass="1" diaginertia="0.01 0.01 0.01"/>'
LEFT_LEG = '<body name="LF_hip"'
KNEE_RANGE, HIP_RANGE = 'range="-2.72 -0.838"', 'range="-1.5708 3.4907"'


@pytest.mark.parametrize(
    ("strip", "mass"),
    [
        ('["arm"]', 15.2),
        ('["hand", "arm", "arm", "finger"]', 15.2),
        ('["arm_joint", "hand", "thumb"]', 16.2),
        ('["arm_joint", "hand_joint", "thumb", "finger"]', 17.2),
    ],
)
def test_an_arm_goes_with_all_that_refers_to_it(tmp_path: Path, strip: str, mass: float) -> None:
    """Arm and hand of 1 kg each, a tendon of two joints and what pulls at them."""
    arm = f"""
      <body name="arm" pos="0.1 0 0.1">
        {INERTIAL}
        <joint name="arm_joint" type="hinge"/>
        <body name="hand" pos="0 0 0.1">
          {INERTIAL}
          <joint name="hand_joint" type="hinge"/>
          <joint name="finger" type="slide"/>
          <site name="palm" material="shell"/>
          <joint name="thumb" type="slide" axis="0 1 0"/>
        </body>
      </body>"""
    refer = """
      <tendon>
        <fixed name="grip"><joint joint="finger" coef="1"/><joint joint="thumb" coef="1"/></fixed>
        <spatial name="string" material="shell"><site site="palm"/><site site="imu"/></spatial>
      </tendon>
      <equality><joint joint1="finger" joint2="thumb"/></equality>
      <custom><tuple name="two"><element objtype="site" objname="palm"/></tuple></custom>
      <contact><exclude body1="arm" body2="trunk"/></contact>
      <actuator>
        <motor name="arm_motor" joint="arm_joint"/><motor name="grip" tendon="grip"/>
        <general name="push" site="palm"/>
      </actuator>"""
    edits = [(LEFT_LEG, arm + LEFT_LEG), ("<sensor>", refer + "<sensor>")]
    scene = scene_of(bodies.write_robot(tmp_path, edits, strip=strip))
    assert scene.robot.total_mass == pytest.approx(mass)
    assert scene.model.ntendon == 0


LEFTOVERS = {
    "servos": ("<default>", '<default><motor gear="9" ctrllimited="true" ctrlrange="-1 1"/>'),
    "geoms": ("<geom contype", '<geom euler="0.3 0 0" material="shell" contype'),
    "springs": ('armature="0.02"', 'armature="0.02" springdamper="0.1 1"'),
    "floating bodies": ('<body name="trunk"', '<body name="trunk" gravcomp="1"'),
    "site's material": ('<site name="imu"', '<site name="imu" material="shell"'),
    "name of a foot": ('name="LF_rubber"', 'name="LF_contact"'),
    "tuples": (
        "<sensor>",
        '<custom><tuple name="a"><element objtype="geom" objname="head"/></tuple></custom><sensor>',
    ),
    "tendons": (
        "<sensor>",
        '<tendon><spatial name="string" material="shell"><site site="imu"/><site site="LF_foot"/>'
        '</spatial></tendon><actuator><motor name="pull" tendon="string"/></actuator><sensor>',
    ),
}


@pytest.mark.parametrize("left", LEFTOVERS)
def test_nothing_of_the_makers_is_left(tmp_path: Path, left: str) -> None:
    """The scene is that of a model without it."""
    extra: dict[str, Any] = {"foot_radius": "0.03", "hip_torque": "20", "knee_torque": "40"}
    scene = scene_of(bodies.write_robot(tmp_path / "left", [LEFTOVERS[left]], **extra))
    plain = scene_of(bodies.write_robot(tmp_path / "plain", **extra))
    assert scene.hash == plain.hash
    legs = zip(scene.robot.legs, plain.robot.legs, strict=True)
    same = tuple(dataclasses.replace(leg, foot=x.foot) for leg, x in legs)
    assert dataclasses.replace(scene.robot, legs=same) == plain.robot


@pytest.mark.parametrize(
    "edit",
    [
        ("<default>", '<default><site euler="0 1.5 0" pos="1 2 3" material="shell"/>'),
        ('<site name="imu"', '<site name="balance_imu" pos="0.1 0 0" euler="0 1 0"/><site'),
    ],
)
def test_the_imu_is_ours(tmp_path: Path, edit: tuple[str, str]) -> None:
    """At the trunk's origin, along its axes, whatever sites are in its maker's model."""
    scene = scene_of(bodies.write_robot(tmp_path, [edit]))
    model = scene.model
    for name in ("gyro", "accelerometer"):
        site = int(model.sensor(f"{ROBOT}{name}").objid[0])
        assert model.site_pos[site].tolist() == [0, 0, 0]
        assert model.site_quat[site].tolist() == [1, 0, 0, 0]
    np.testing.assert_allclose(scene.stance.imu, [0, 0, 0, 0, 0, 9.81], atol=0.01)


@pytest.mark.parametrize(
    ("site", "imu"),
    [('<site name="imu"', "[0.1, 0.0, -0.02]"), ('<site name="imu" euler="0 0 1"', '"imu"')],
)
def test_the_imu_is_where_the_file_says(tmp_path: Path, site: str, imu: str) -> None:
    """A place, or a site's; a site that is turned is not, for the axes are the trunk's."""
    edit = ('<site name="imu"', f'{site} pos="0.1 0 -0.02"')
    model = scene_of(bodies.write_robot(tmp_path, [edit], imu=imu)).model
    own = int(model.sensor(f"{ROBOT}gyro").objid[0])
    np.testing.assert_allclose(model.site_pos[own], (0.1, 0, -0.02))
    assert model.site_quat[own].tolist() == [1, 0, 0, 0]


FEET = {
    "site in a frame": '<frame pos="0 0 -0.2"><site name="{}" pos="0 0 -0.013"/></frame>',
    "cylinder in a frame": (
        '<frame pos="0 0 -0.213" euler="0 1 0"><geom name="{}" type="cylinder" size="0.02 0.01"/>'
        "</frame>"
    ),
    "capsule between ends": (
        '<geom name="{}" type="capsule" size="0.01" fromto="0 -0.02 -0.213 0 0.02 -0.213"/>'
    ),
    "sphere of another size": '<frame pos="0 0 -0.213"><geom name="{}" size="0.04"/></frame>',
    "body": '<body name="{}" pos="0 0 -0.213"/>',
}


@pytest.mark.parametrize("kind", FEET)
def test_a_foot_is_where_its_model_draws_it(kind: str, tmp_path: Path, robot: Robot) -> None:
    """0.213 m below the knee, whatever it is and whatever its place is relative to."""
    places = [(leg, f'<geom name="{leg}_rubber"') for leg in bodies.LEGS]
    model = [(old, FEET[kind].format(f"{leg}_paw") + old) for leg, old in places]
    file = [(f'"{leg}_foot"', f'"{leg}_paw"') for leg in bodies.LEGS]
    name = bodies.write_robot(tmp_path, model, file, foot_radius="0.022")
    for leg, ours in zip(find_robot(name).legs, robot.legs, strict=True):
        assert (leg.calf, leg.x, leg.y) == pytest.approx((0.213, ours.x, ours.y), abs=1e-9)


@pytest.mark.parametrize(
    ("option", "total", "trunk"),
    [('settotalmass="30.4"', 30.4, 2 * 6.92), ('boundmass="0.68"', 15.2 + 4 * (0.68 - 0.24), 6.92)],
)
@pytest.mark.filterwarnings("ignore:compiler attribute")
def test_masses_are_what_the_compiler_makes_them(
    tmp_path: Path, option: str, total: float, trunk: float
) -> None:
    """In the scene too, whose compiler has no such options."""
    scene = scene_of(bodies.write_robot(tmp_path, [("<compiler ", f"<compiler {option} ")]))
    assert (scene.robot.total_mass, scene.robot.trunk_mass) == pytest.approx((total, trunk))
    body = scene.model.body(f"{ROBOT}trunk")
    assert (body.subtreemass[0], body.mass[0]) == pytest.approx((total, trunk))


def turning(limits: str, *edits: tuple[str, str]) -> list[tuple[str, str]]:
    return [(KNEE_RANGE, f'range="{limits}"'), *edits]


FLIPPED = [(f'name="R{x}_knee" class', f'name="R{x}_knee" axis="0 -1 0" class') for x in "FH"]
KNEES = {
    "none to speak of": (turning("-9.42 9.42"), [(-2.7, -0.1)] * 4),
    "alike both ways": (turning("-2.6 2.69"), [(-2.6, -0.1)] * 4),
    "past the thigh": (turning("-3.5 -0.8"), [(-2.7, -0.8)] * 4),
    "mostly forward": (turning("-1 2.69"), [(0.1, 2.69)] * 4),
    "a whole turn off": (turning("-5.585 -3.578"), [(2 * np.pi - 5.585, 2 * np.pi - 3.578)] * 4),
    "two turns off": (turning("9.866 11.766"), [(9.866 - 4 * np.pi, 11.766 - 4 * np.pi)] * 4),
    "a hip a whole turn off": ([(HIP_RANGE, 'range="4.7124 9.7739"')], [(-2.72, -0.838)] * 4),
    "right ones turn the other way": (
        turning("-2.69 2.6", *FLIPPED),
        [(-2.69, -0.1), (-2.6, -0.1)] * 2,
    ),
    "front ones forward, by the file": (
        turning("-2.6 2.6"),
        [(0.1, 2.6), (0.1, 2.6), (-2.6, -0.1), (-2.6, -0.1)],
    ),
}


@pytest.mark.parametrize("kind", KNEES)
def test_which_way_knees_point(kind: str, tmp_path: Path) -> None:
    """By their limits; all backward if they can do both, but for what the file says."""
    edits, turns = KNEES[kind]
    said = dict.fromkeys(("LF", "RF"), 'knee = "forward"') if kind.endswith("file") else {}
    name = bodies.write_robot(tmp_path, edits, **said)
    scene = scene_of(name)
    np.testing.assert_allclose(scene.robot.each("knee"), turns, atol=2e-3)
    open_to_both = kind in ("none to speak of", "alike both ways", "right ones turn the other way")
    unsaid = [leg.name for leg in scene.robot.legs if open_to_both or leg.name not in said]
    notes = [x for x in robot_notes(name) if x.startswith("knees of ")]
    if open_to_both or said:
        assert notes[0].startswith(f"knees of {', '.join(unsaid)} may bend either way")
    else:
        assert notes == []
    check_kinematics(scene)


def test_a_trunk_whose_origin_is_behind_all_legs(tmp_path: Path, robot: Robot) -> None:
    """Corners are told apart, and an action turns the body by as much as ours."""
    shifts = {"LF": ("0.193", "0.396"), "LH": ("-0.193", "0.01")}
    shifts |= {"RF": shifts["LF"], "RH": shifts["LH"]}
    edits = [
        (f'"{leg}_hip" pos="{old}', f'"{leg}_hip" pos="{x}') for leg, (old, x) in shifts.items()
    ]
    other = find_robot(bodies.write_robot(tmp_path, edits))
    assert [(x.left, x.front) for x in other.legs] == [(x.left, x.front) for x in robot.legs]
    assert other.lever == pytest.approx(0.193)
    assert other.action_max == 0.003
    assert other.each("x") == pytest.approx([0.396, 0.396, 0.01, 0.01])


@pytest.mark.parametrize("kind", ["negative gain", "in the parent's frame"])
def test_torques_of_unusual_motors(kind: str, tmp_path: Path) -> None:
    spec = bodies.with_motors(bodies.our_spec())
    for motor in spec.actuators:
        if kind == "negative gain":
            motor.gainprm[0], motor.ctrlrange = -2, motor.ctrlrange / 2
        else:
            motor.trntype = mujoco.mjtTrn.mjTRN_JOINTINPARENT
    robot = find_robot(bodies.write_robot(tmp_path, spec, foot_radius="0.022"))
    assert (robot.hip_torque, robot.knee_torque) == pytest.approx((23.7, 45.4), rel=1e-5)


SERVO = '<position name="RH_abduction"'
SERVOS: dict[str, tuple[Edits, tuple[float, float]]] = {
    "the weakest counts": (
        [
            (SERVO, f'{SERVO} gear="-2" forcerange="-8 10"'),
            ('<joint name="LF_knee"', '<joint name="LF_knee" actuatorfrcrange="-29 30"'),
        ],
        (20.0, 30.0),
    ),
    "no limits": ([(f'forcerange="-{x} {x}"', "") for x in (23.7, 23.7, 45.4)], (1e4, 1e4)),
}


@pytest.mark.parametrize("kind", SERVOS)
def test_torques_of_servos(kind: str, tmp_path: Path) -> None:
    """An abduction has 20 N m, by a gear of 2, one knee 30: no leg is told to do more."""
    edits, torques = SERVOS[kind]
    robot = find_robot(bodies.write_robot(tmp_path, edits))
    assert (robot.hip_torque, robot.knee_torque) == torques


def test_a_robots_size_is_by_its_furthest_foot_on_either_axis(robot: Robot) -> None:
    """Feet at 0.15 and -0.11 m fore-aft, at 0.3 m and -0.2 m aside: wider than long."""
    legs = [
        dataclasses.replace(leg, x=0.15 if leg.front else -0.11, y=0.3 if leg.left else -0.2)
        for leg in robot.legs
    ]
    wide = dataclasses.replace(robot, legs=tuple(legs))
    assert (wide.half_length, wide.half_track) == (0.15, 0.3)
    assert wide.lever == pytest.approx(0.25), "half of what the feet span"
    assert wide.size_scale == round(0.3 / 0.193, 3)


def test_unequal_legs_count_by_their_mean(tmp_path: Path) -> None:
    """Hind shanks of 180 mm: 0.77 of 0.426 and 0.393 m and the foot; servos by (l h / y)^2."""
    feet = [f'<geom name="{leg}_foot" class="foot" pos="0 0 ' for leg in ("LH", "RH")]
    edits = [(f"{foot}-0.213", f"{foot}-0.18") for foot in feet]
    robot = find_robot(bodies.write_robot(tmp_path, edits))
    height = round(0.022 + 0.77 * (0.426 + 0.393) / 2, 3)
    assert robot.body_height == height
    softer = (0.4095 * height / (0.426 * 0.35)) ** 2
    servos = (robot.servo_stiffness, robot.servo_damping, robot.servo_armature)
    assert servos == pytest.approx((400 * softer, 16 * softer, 0.02 * softer), rel=3e-3)


@pytest.mark.parametrize(("limits", "end"), [((-2.72, -1.5), 1), ((-1.4, -0.3), 0)])
def test_a_height_leaves_room_for_the_board(
    tmp_path: Path, limits: tuple[float, float], end: int
) -> None:
    """Knees that stay bent or straight: 7 deg below the longest legs, or above the shortest."""
    robot = find_robot(bodies.write_robot(tmp_path, turning("{} {}".format(*limits))))
    reach = 0.426 * np.cos(limits[end] / 2) + 0.022
    room = np.tan(np.radians(7)) * (0.193 + 0.142)
    assert robot.body_height == pytest.approx(reach - room if end else reach + room, abs=6e-4)


def test_a_strong_robot_can_be_read_back(tmp_path: Path) -> None:
    """A policy carries its numbers; one of 300 kg on narrow legs has servos of 10,100 N m/rad."""
    name = bodies.write_robot(tmp_path, servo_stiffness="10100", knee_torque="20000")
    robot = find_robot(name)
    assert from_dict(Robot, json.loads(json.dumps(dataclasses.asdict(robot)))) == robot


def stripping(name: str) -> tuple[str, str]:
    return ("trunk =", f'strip = ["{name}"]\ntrunk =')


def joint(name: str, attribute: str) -> tuple[str, str]:
    """An edit that gives a joint of the model another attribute."""
    return f'<joint name="{name}"', f'<joint name="{name}" {attribute}'


def of_last(line: str) -> tuple[str, str]:
    """An edit that adds a line to the last leg."""
    return 'foot = "RH_foot"', f'foot = "RH_foot"\n{line}'


def ending(**ends: str) -> list[tuple[str, str]]:
    return [(f'"{leg}_foot"', f'"{leg}_foot"\nend = "{end}"') for leg, end in ends.items()]


FREE_JOINT, HIP = '<freejoint name="root"/>', '<joint name="LF_hip" class="hip"/>'
ABDUCTION = '<joint name="LF_abduction" class="abduction"/>'
NECK = f'<body name="neck">{INERTIAL}<joint name="neck_joint"/></body>'
MODEL = "model.xml"
REFUSED: list[tuple[Edits, Edits, str]] = [
    # edits of the model, edits of the file, message
    ([], [('"trunk"', '"torso"')], "trunk is 'torso', which its model"),
    ([], [('"trunk"', '"world"')], "trunk is 'world', which"),
    ([(FREE_JOINT, "")], [], "trunk 'trunk' has no free joint"),
    ([], [('"LF_hip"', '"LF_hop"')], "joint 'LF_hop' of leg LF is none"),
    ([joint("LF_knee", 'type="slide"')], [], "joint 'LF_knee' of leg LF is no hinge"),
    (
        [],
        [('"LF_hip", "LF_knee"', '"LF_knee", "LF_hip"')],
        "joint 'LF_hip' of leg LF does not hang on 'LF_calf'",
    ),
    (
        [],
        [('"LF_foot"', '"RF_foot"')],
        "foot of leg LF hangs on body 'RF_calf'; it must hang on .* 'LF_calf'",
    ),
    ([], [('"LF_foot"', '"LF_paw"')], "foot of leg LF is 'LF_paw', which"),
    ([], [of_last('side = "left"')], "leg RH is said to be left, but it stands right"),
    ([], ending(LF="front"), "end is said of some legs only"),
    (
        [],
        ending(LF="front", RF="front", LH="front", RH="hind"),
        "3 legs have end front; two must, and two hind",
    ),
    (
        [],
        ending(LF="front", RF="hind", LH="front", RH="hind"),
        "legs LF and LH are said to be front, but they stand at different ends",
    ),
    ([('"LH_hip" pos="-0.193', '"LH_hip" pos="0.1')], [], "legs LF and LH both stand front left"),
    ([(LEFT_LEG, NECK + LEFT_LEG)], [], "joint 'neck_joint' is in no leg; strip it"),
    ([], [stripping("nose")], "strip names 'nose', which"),
    ([], [stripping("world")], "strip names 'world', which is, or carries, the trunk"),
    ([], [stripping("trunk")], "strip names 'trunk', which is, or carries, the trunk"),
    ([], [stripping("root")], "strip names 'root', by which the trunk is free; it must be"),
    ([], [stripping("LF_knee")], "strip takes joint 'LF_knee' of leg LF, which the leg needs"),
    ([], [stripping("LF_thigh")], "strip takes joint 'LF_hip' of leg LF, which the leg needs"),
    (
        [],
        [of_last('knee = "forward"')],
        "joints 'RH_hip' and 'RH_knee' of leg RH cannot turn far enough .* the knee forward: "
        "the thigh turns from -90 to 200 deg, the calf against it from -156 to -48 deg",
    ),
    (
        [joint("LH_knee", 'range="0.8 2.7"')],
        [],
        "knees of legs LH and RH would point different ways, that of LH forward; say knee of b",
    ),
    (
        [joint("RF_abduction", 'range="0.1 1.0"')],
        [],
        "joint 'RF_abduction' of leg RF turns the hip's axis from 6 to 57 deg off level",
    ),
    (
        [(HIP, ""), (ABDUCTION, ABDUCTION + HIP)],
        [],
        "joint 'LF_hip' of leg LF is on body 'LF_hip', as the one before it",
    ),
    ([("<compiler ", '<compiler settotalmass="0.00152" ')], [], "it weighs 0.00152 kg"),
    (
        [("<compiler ", '<compiler settotalmass="1520000" ')],
        [],
        r"it weighs 1.52e\+06 kg, .*; no robot is as heavy for its size: write masses in kg and l",
    ),
    (turning("-1.2 -1.0"), [], "too short for the board: its legs reach from 0.3"),
    (turning("-1.5 -0.9"), [], "too short for the board: its legs reach from 0.33"),
    (
        [joint("RF_knee", 'axis="0 0 1"')],
        [],
        r"joint 'RF_knee' of leg RF turns about \(0.00, 0.00, 1.00\)",
    ),
    ([joint("RF_abduction", 'axis="0 1 0"')], [], "joint 'RF_abduction' of leg RF turns about"),
    ([joint("LH_knee", 'axis="0.03 1 0"')], [], r"leg LH turns about \(0.03, 1.00, 0.00\)"),
    ([], [("trunk =", 'imu = "LF_foot"\ntrunk =')], "imu 'LF_foot' is on"),
    (
        [],
        [('"LF_foot"', '"LF_calf"')],
        "foot of leg LF is not a sphere geom; say foot_radius, in m",
    ),
    (
        [('"LH_foot" class="foot"', '"LH_foot" class="foot" size="0.025"')],
        [],
        "the feet have different radii, LF 0.022, RF 0.022, LH 0.025, RH 0.022; say foot_radius",
    ),
    ([], [("trunk =", 'imu = "eye"\ntrunk =')], "imu is 'eye', which"),
    ([], [(MODEL, "gone.xml")], "but there is no file .*gone.xml"),
    ([], [(MODEL, "maker.toml")], "maker.toml cannot be read"),
    *(
        ([], [(MODEL, f"{package}:m.xml")], f"the Python package '{package}' is not installed")
        for package in ("no_such", "no_such.part", "./here", "__main__", "my robot")
    ),
]


@pytest.mark.parametrize(("model", "file", "message"), REFUSED, ids=[x[2] for x in REFUSED])
@pytest.mark.filterwarnings("ignore:compiler attribute")
def test_what_does_not_fit_is_named(
    model: Edits, file: Edits, message: str, tmp_path: Path
) -> None:
    name = bodies.write_robot(tmp_path, model, file)
    with pytest.raises(RobotError, match=message) as caught:
        find_robot(name)
    assert "\n" not in str(caught.value)


@pytest.mark.parametrize(
    ("old", "new", "message"),
    [
        ('name="LF_knee" class="knee"/>', 'nom="LF_knee"/>', "'nom'; Element 'joint', line "),
        ("0.0012 0.0012", "1 0.0012", "body 'LF_calf' of 0.24 kg .* inertia 5e-05, 0.0012, 1 kg"),
    ],
)
def test_mujocos_words_name_the_element(tmp_path: Path, old: str, new: str, message: str) -> None:
    """In one line: it writes them below its complaint."""
    name = bodies.write_robot(tmp_path, [(old, new)])
    for build in (lambda: find_robot(name), lambda: draft("model.xml", tmp_path / "model.xml")):
        with pytest.raises(RobotError, match=message) as caught:
            build()
        assert "\n" not in str(caught.value)


STRONG = {"knee_torque": "500", "hip_torque": "500"}


@pytest.mark.parametrize(
    ("edits", "extra", "message"),
    [
        (
            [('pos="0 0 0" mass="6.92"', 'pos="0.5 0 0" mass="6.92"')],
            STRONG,
            "its centre of mass is 22[678] mm ahead of .* stand from -193 to 193 mm",
        ),
        (
            [('pos="0 0 0" mass="6.92"', 'pos="0 -0.5 0" mass="6.92"')],
            STRONG,
            "its centre of mass is 22[678] mm right of .* stand from -142 to 142 mm",
        ),
        (
            [],
            STRONG | {"servo_stiffness": "20", "servo_damping": "1"},
            "with servo_stiffness 20 N m/rad: its weight bends them ever further; servo_stiffness "
            "must be at least 2[345]$",
        ),
        (
            [],
            {"servo_stiffness": "1e6"},
            r"with servo_stiffness 1e\+06 N m/rad: leave out servo_stiffness of its file",
        ),
        (
            [('mass="6.92"', 'mass="400"')],
            {},
            r"weighs 408\.3 kg, too much for its servos: '.._(hip|knee)'",
        ),
        (
            [],
            {"board_size": "0.3"},
            "robot maker: board_size is 0.3 m; for its feet .* it must be at least 0.39",
        ),
    ],
)
def test_why_it_does_not_stand(
    edits: Edits, extra: dict[str, Any], message: str, tmp_path: Path
) -> None:
    """With the trunk's 6.92 of 15.2 kg half a metre ahead; feet need 2 * 0.193 m of board."""
    name = bodies.write_robot(tmp_path, edits, **extra)
    with pytest.raises(ConfigError, match=message):
        scene_of(name)


@pytest.mark.parametrize(
    ("stiffness", "damping", "armature"),
    [(60, 4, 0.02), (40, 2, 0.02), (30, 1.5, 0.02), (25, 1, 0.001)],
)
def test_a_robot_on_soft_servos_stands(
    stiffness: float, damping: float, armature: float, tmp_path: Path
) -> None:
    """At its height, each servo off its target by torque over stiffness; 10 s later as well.

    Rotors of 0.001 kg m^2 on stiff servos would be too fast for a physics step.
    """
    gains = {"stiffness": stiffness, "damping": damping, "armature": armature}
    fields: dict[str, Any] = {f"servo_{name}": f"{value}" for name, value in gains.items()}
    scene = scene_of(bodies.write_robot(tmp_path, **fields))
    data, stance = mujoco.MjData(scene.model), scene.stance
    data.qpos[:] = stance.qpos
    angles = joint_angles(scene.robot, np.full(4, 0.35))
    data.ctrl[scene.leg_ctrl] = angles + stance.leg_trim
    mujoco.mj_step(scene.model, data, nstep=2500)
    trunk = scene.trunk_quat[0] - 3
    np.testing.assert_allclose(data.qpos[trunk : trunk + 3], (0, 0, 0.35), atol=1.5e-3)
    np.testing.assert_allclose(data.qpos[scene.leg_qpos], angles, atol=1e-3)
    mujoco.mj_forward(scene.model, data)
    torque = data.actuator_force[scene.leg_ctrl]
    assert np.abs(torque[:, 2]).min() > 1, "knees carry the robot"
    np.testing.assert_allclose(torque / stiffness, stance.leg_trim, atol=1e-3)


def test_a_spec_is_new_each_time() -> None:
    """Whoever attaches one owns it."""
    first = robot_spec("quadruped")
    first.body("trunk").mass = 1.0
    assert robot_spec("quadruped").body("trunk").mass == 6.92
