"""A maker's model becomes the same robot however it is drawn, and the one it is."""

import dataclasses
import json
from collections.abc import Callable
from pathlib import Path

import mujoco
import numpy as np
import pytest
from fixtures import bodies

from mjx_balance.config import ConfigError, check, from_dict, preset
from mjx_balance.evaluation.controllers import make_controller, measure_response
from mjx_balance.evaluation.rollout import run_suite
from mjx_balance.robots.build import scene_dir
from mjx_balance.robots.catalogue import (
    Robot,
    RobotError,
    find_robot,
    robot_spec,
    robot_xml,
    shipped,
)
from mjx_balance.robots.draft import draft
from mjx_balance.robots.limits import for_robot
from mjx_balance.sim.scene import ROBOT, Scene, load_scene
from mjx_balance.task.kinematics import foot_heights, joint_angles

MAKERS = tuple(name for name in shipped() if name != "quadruped")
Draw = Callable[[mujoco.MjSpec], mujoco.MjSpec]
DRAWINGS: dict[str, tuple[Draw, tuple[str, ...], dict[str, str]]] = {
    "as ours": (lambda spec: spec, bodies.LEGS, {}),
    "other order": (lambda spec: spec, ("RH", "LF", "RF", "LH"), {}),
    "other axes": (bodies.backward_axes, bodies.LEGS, {}),
    "drawn standing": (bodies.drawn_standing, bodies.LEGS, {}),
    "motors": (bodies.with_motors, bodies.LEGS, {"foot_radius": "0.022"}),
    "looks along y": (lambda spec: bodies.turned(spec, 90), bodies.LEGS, {}),
    "looks along -x": (
        lambda spec: bodies.turned(spec, 180),
        bodies.LEGS,
        {leg: f'end = "{"front" if leg[1] == "F" else "hind"}"' for leg in bodies.LEGS},
    ),
    "looks along -y": (
        lambda spec: bodies.backward_axes(bodies.turned(spec, -90)),
        bodies.LEGS,
        {leg: f'end = "{"front" if leg[1] == "F" else "hind"}"' for leg in bodies.LEGS},
    ),
}


def written(folder: Path, spec: mujoco.MjSpec, text: str | None = None) -> str:
    """Path of a robot's file whose model is beside it."""
    spec.compile()
    (folder / "model.xml").write_text(spec.to_xml())
    (folder / "maker.toml").write_text(text or bodies.file_text(Path("model.xml")))
    return str(folder / "maker.toml")


@pytest.fixture(params=DRAWINGS, ids=str)
def drawing(request: pytest.FixtureRequest, tmp_path: Path) -> str:
    """Path of the file of our own robot, drawn in another way."""
    draw, legs, extra = DRAWINGS[request.param]
    extra = {"imu": '"imu"'} | extra
    return written(
        tmp_path, draw(bodies.our_spec()), bodies.file_text(Path("model.xml"), legs, **extra)
    )


def scene_of(robot: str) -> Scene:
    return load_scene(check(for_robot(preset("default"), robot)))


def test_our_robot_is_the_same_however_it_is_drawn(drawing: str, robot: Robot) -> None:
    """Up to names, order and what is where zero; gains and heights follow by the rules."""
    other = find_robot(drawing)
    legs = {leg.name: leg for leg in other.legs}
    for leg in robot.legs:
        found = dataclasses.replace(legs[leg.name], signs=leg.signs, zeros=leg.zeros)
        plain, ours = dataclasses.asdict(found), dataclasses.asdict(leg)
        for name, value in ours.items():
            if isinstance(value, (float, tuple)) and name != "joints":
                assert plain[name] == pytest.approx(value, abs=1e-6), name
            else:
                assert plain[name] == value, name
    for field in dataclasses.fields(robot):
        if field.type is float:
            ours = getattr(robot, field.name)
            assert getattr(other, field.name) == pytest.approx(ours, rel=2e-3), field.name


def test_it_moves_alike_however_it_is_drawn(drawing: str, scene: Scene) -> None:
    """What one action does to roll and pitch, after each physics step: within a hundredth."""
    ours, other = measure_response(scene), measure_response(scene_of(drawing))
    np.testing.assert_allclose(other.gain, ours.gain, rtol=0.01)
    np.testing.assert_allclose(other.course, ours.course, atol=0.01)


def test_its_feet_are_where_mujoco_sees_them_however_it_is_drawn(drawing: str) -> None:
    """At any angles, abduction to either side included."""
    scene, rng = scene_of(drawing), np.random.default_rng(0)
    data = mujoco.MjData(scene.model)
    standing = joint_angles(scene.robot, np.full(4, 0.33))
    for _ in range(10):
        angles = standing + rng.uniform(-0.4, 0.4, (4, 3))
        below = -feet_of(scene, data, angles)[:, 2] + 0.022
        np.testing.assert_allclose(foot_heights(scene.robot, angles), below, atol=1e-6)


def test_shoulders_and_hips_at_other_heights(tmp_path: Path) -> None:
    """Feet 10 mm nearer to the trunk's origin, all angles being the same."""
    name = written(tmp_path, bodies.high_shoulders(bodies.our_spec()))
    robot, ours = find_robot(name), find_robot("quadruped")
    assert (robot.legs[0].axis_height, robot.legs[0].drop) == pytest.approx((0.03, 0.02))
    assert robot.height_range == pytest.approx([x - 0.01 for x in ours.height_range])
    assert robot.body_height == pytest.approx(0.34, abs=1e-3)
    scene, rng = scene_of(name), np.random.default_rng(0)
    data = mujoco.MjData(scene.model)
    standing = joint_angles(robot, np.full(4, 0.34))
    np.testing.assert_allclose(standing, joint_angles(ours, np.full(4, 0.35)), atol=1e-9)
    angles = standing + rng.uniform(-0.4, 0.4, (4, 3))
    below = -feet_of(scene, data, angles)[:, 2] + 0.022
    np.testing.assert_allclose(foot_heights(robot, angles), below, atol=1e-6)


def test_a_hips_limits_limit_the_reach(tmp_path: Path) -> None:
    """A thigh that leans back by 0.6 rad at most, half the knee's turn: 0.426 cos 0.6 + 0.022."""
    spec = bodies.our_spec()
    for leg in bodies.LEGS:
        spec.joint(f"{leg}_hip").range = [-1.5, 0.6]
    text = bodies.file_text(Path("model.xml"), body_height="0.39")
    robot = find_robot(written(tmp_path, spec, text))
    assert robot.height_range[0] == pytest.approx(0.426 * np.cos(0.6) + 0.022, abs=1e-3)
    assert robot.legs[0].knee == pytest.approx((-1.2, -0.838), abs=2e-3)


def test_the_reach_is_that_of_all_legs(robot: Robot) -> None:
    """One leg cannot fold as far, another not stretch as far."""
    legs = list(robot.legs)
    legs[1] = dataclasses.replace(legs[1], knee=(-2.0, -0.838))
    legs[2] = dataclasses.replace(legs[2], knee=(-2.72, -1.2))
    low, high = dataclasses.replace(robot, legs=tuple(legs)).height_range
    assert (low, high) == pytest.approx((0.426 * np.cos(1.0) + 0.022, 0.426 * np.cos(0.6) + 0.022))


def test_nothing_but_its_servos_moves_a_joint(drawing: str) -> None:
    model = scene_of(drawing).model
    assert not model.jnt_stiffness.any()
    assert not model.dof_frictionloss.any()
    assert not model.jnt_actfrclimited.any()


def test_it_is_seen_alike_however_it_is_drawn(drawing: str, scene: Scene) -> None:
    """A controller that looks at the IMU alone holds it level: wrong axes or signs would not."""
    other = scene_of(drawing)
    found = run_suite(other, make_controller("pd-imu", other), "corner", 4, 12.0, 1)
    ours = run_suite(scene, make_controller("pd-imu", scene), "corner", 4, 12.0, 1)
    assert not found.fell.any()
    assert found.tilt.mean() == pytest.approx(ours.tilt.mean(), rel=0.05)


@pytest.mark.parametrize("name", MAKERS)
def test_kinematics_agree_with_mujoco(name: str) -> None:
    """Heights from any angles, and back, against the compiled model's own feet."""
    scene, robot = scene_of(name), find_robot(name)
    data, rng = mujoco.MjData(scene.model), np.random.default_rng(0)
    for height in np.linspace(*robot.height_range, 7):
        angles = joint_angles(robot, np.full(4, height))
        feet = feet_of(scene, data, angles)
        np.testing.assert_allclose(-feet[:, 2] + robot.foot_radius, height, atol=1e-6)
        np.testing.assert_allclose(feet[:, 0], robot.each("x"), atol=1e-6)
        np.testing.assert_allclose(feet[:, 1], robot.each("y"), atol=1e-6)
        other = angles + rng.uniform(-0.3, 0.3, (4, 3))
        below = -feet_of(scene, data, other)[:, 2] + robot.foot_radius
        np.testing.assert_allclose(foot_heights(robot, other), below, atol=1e-6)


def feet_of(scene: Scene, data: mujoco.MjData, angles: np.ndarray) -> np.ndarray:
    """(legs, 3) centres of the feet from the trunk's origin, m."""
    data.qpos[:] = scene.model.qpos0
    for leg, row in zip(scene.robot.legs, angles, strict=True):
        for joint, angle in zip(leg.joints, row, strict=True):
            data.joint(f"{ROBOT}{joint}").qpos = angle
    mujoco.mj_kinematics(scene.model, data)
    feet = [data.geom(f"{ROBOT}{leg.foot}").xpos for leg in scene.robot.legs]
    return np.asarray(feet) - data.body(f"{ROBOT}{scene.robot.trunk}").xpos


PUBLISHED = {
    # kg, thigh and calf m, of the makers' data sheets or the models' own inertias
    "go1": (12.74, 0.213, 0.213, 23.7),
    "go2": (15.21, 0.213, 0.213, 45.43),
    "b2": (83.50, 0.35, 0.35, 300.0),
    "aliengo": (24.64, 0.25, 0.25, 44.4),
    "mini_cheetah": (12.47, 0.209, 0.18, 45.43),
    "spot": (50.34, 0.321, 0.3365, 135.278),
}


@pytest.mark.parametrize("name", MAKERS)
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


@pytest.mark.parametrize("name", MAKERS)
def test_a_makers_robot_can_follow_the_board(name: str) -> None:
    """With our own's margin: 15 mm/s at 0.193 m, 4.45 deg/s, against the board's 3.5."""
    scene = scene_of(name)
    gain = measure_response(scene).gain
    per_second = 5 * scene.config.task.action_max * np.abs(gain)
    assert per_second.min() == pytest.approx(4.45, rel=0.08)
    found = run_suite(scene, make_controller("rate-oracle", scene), "corner", 4, 12.0, 0)
    assert not found.fell.any()
    assert found.tilt.mean() < 0.15


@pytest.mark.parametrize("name", MAKERS)
def test_only_feet_touch_and_only_our_servos_pull(name: str) -> None:
    scene = scene_of(name)
    model, robot = scene.model, scene.robot
    assert not model.geom_contype.any()
    assert not model.geom_conaffinity.any()
    assert (model.npair, model.nu, model.nkey, model.ntendon, model.neq) == (4, 14, 0, 0, 0)
    assert model.nmesh == 0, "looks are left out"
    assert not model.dof_frictionloss.any()
    assert model.body_mass[1:].sum() == pytest.approx(robot.total_mass + 10 * robot.mass_scale)
    assert model.opt.timestep == 0.004
    assert model.opt.impratio == 1
    for k, leg in enumerate(robot.legs):
        for j, joint in enumerate(leg.joints):
            servo = model.actuator(f"{ROBOT}{joint}")
            assert servo.id == scene.leg_ctrl[k, j]
            assert model.jnt_qposadr[servo.trnid[0]] == scene.leg_qpos[k, j]
            limit = robot.knee_torque if j == 2 else robot.hip_torque
            assert servo.forcerange.tolist() == [-limit, limit]
            assert servo.gainprm[0] == robot.servo_stiffness


@pytest.mark.parametrize("name", MAKERS)
def test_looks_are_there_for_the_eye(name: str) -> None:
    """And change nothing else."""
    config = check(for_robot(preset("default"), name))
    shown = load_scene(config, visual=True)
    assert shown.model.nmesh > 0
    assert shown.hash == load_scene(config).hash


def test_rules_of_size_by_hand() -> None:
    """B2: 83.498 kg on legs of 0.7 m; feet 0.3285 m ahead, 0.19173 m aside.

    Height 0.77 * 0.7 + 0.032; heights change by 3 mm * 0.3285 / 0.193; servos are stiffer by
    mass and (leg * height / half-track)^2: 5.4933 * (0.7 * 0.571 / 0.19173 / 1.05)^2 = 21.66.
    """
    robot = find_robot("b2")
    assert robot.body_height == 0.571
    assert robot.action_max == 0.00511
    assert robot.servo_stiffness == pytest.approx(400 * 21.66, rel=2e-3)
    assert robot.servo_damping == pytest.approx(16 * 21.66, rel=2e-3)
    assert robot.servo_armature == pytest.approx(0.02 * 21.66, rel=5e-3)
    assert (robot.mass_scale, robot.size_scale) == (5.493, 1.702)


def test_the_board_grows_with_the_robot() -> None:
    scene, ours = scene_of("b2"), scene_of("quadruped")
    board, our_board = (x.model.geom("board/board") for x in (scene, ours))
    np.testing.assert_allclose(board.size, 1.702 * our_board.size, rtol=1e-6)
    assert board.pos[2] == pytest.approx(-board.size[2]), "it is stood on at the pivot's height"
    heavy, light = (x.model.body("board/board") for x in (scene, ours))
    assert heavy.mass[0] == pytest.approx(5.493 * light.mass[0])
    np.testing.assert_allclose(heavy.inertia, 5.493 * 1.702**2 * light.inertia, rtol=1e-6)
    stiff, soft = (x.model.actuator("board/board_x") for x in (scene, ours))
    assert stiff.gainprm[0] == pytest.approx(5.493 * 1.702**2 * soft.gainprm[0])
    for field in ("dof_damping", "dof_armature"):
        large, small = (
            [
                getattr(x.model, field)[x.model.joint(f"board/board_{axis}").dofadr[0]]
                for axis in "xy"
            ]
            for x in (scene, ours)
        )
        assert large == pytest.approx([5.493 * 1.702**2 * value for value in small])
    far, near = (load_scene(x.config, visual=True).model.camera("main") for x in (scene, ours))
    np.testing.assert_allclose(far.pos, 1.702 * near.pos, rtol=1e-6)


def test_the_boards_size_can_be_said(tmp_path: Path) -> None:
    """1.4 m long, and wide and thick in proportion; its weight stays by the robot's."""
    name = edited(tmp_path / "said", [], board_size="1.4")
    plain = edited(tmp_path / "plain", [])
    scene, ours = scene_of(name), scene_of(plain)
    board, our_board = (x.model.geom("board/board") for x in (scene, ours))
    np.testing.assert_allclose(board.size, [0.7, 0.56, 0.028])
    assert board.pos[2] == pytest.approx(-0.028)
    heavy, light = (x.model.body("board/board") for x in (scene, ours))
    assert heavy.mass[0] == light.mass[0]
    np.testing.assert_allclose(heavy.inertia, 1.4**2 * light.inertia)
    assert our_board.size[0] == 0.5
    assert scene.hash != ours.hash, "a policy of another board is another policy"
    assert robot_xml(name) != robot_xml(plain), "and so is a program"


def test_a_board_that_is_too_small(tmp_path: Path) -> None:
    """Feet at 193 and 142 mm: 1 m of length has 0.8 m of width."""
    name = edited(tmp_path, [], board_size="0.3")
    message = "robot maker: board_size is 0.3 m; for its feet .* it must be at least 0.39"
    with pytest.raises(ConfigError, match=message):
        scene_of(name)


@pytest.mark.parametrize("name", [*MAKERS, "quadruped"])
def test_feet_hold_as_well_as_ours(name: str) -> None:
    """Regularised friction lets every robot creep; a light body for a foot, twice as fast."""
    from mjx_balance.cli.inspection import tilt_board

    assert tilt_board(scene_of(name)).creep < 0.005


def test_a_files_own_numbers_win(tmp_path: Path) -> None:
    said = {
        "servo_stiffness": "300.0",
        "servo_damping": "11.0",
        "servo_armature": "0.03",
        "foot_friction": "0.6",
        "foot_radius": "0.03",
        "hip_torque": "20.0",
        "knee_torque": "40.0",
        "body_height": "0.33",
        "action_max": "0.0025",
    }
    text = bodies.file_text(Path("model.xml"), **said, imu="[0.1, 0.02, 0.03]")
    name = written(tmp_path, bodies.our_spec(), text)
    robot = find_robot(name)
    for field, value in said.items():
        assert getattr(robot, field) == float(value), field
    scene = scene_of(name)
    model = scene.model
    foot = model.geom(f"{ROBOT}{robot.legs[0].foot}")
    assert foot.size[0] == 0.03
    assert model.site(f"{ROBOT}balance_imu").pos.tolist() == [0.1, 0.02, 0.03]
    assert model.pair_friction[0, 0] == 0.6


def strip_spec() -> mujoco.MjSpec:
    """With a neck that carries a head of 2 kg, and a tail that wags."""
    spec = bodies.our_spec()
    for name, mass in (("neck", 2.0), ("tail", 0.5)):
        body = spec.body("trunk").add_body(name=name, pos=[0.2, 0, 0.1])
        body.mass, body.ipos, body.inertia = mass, [0, 0, 0], [0.01] * 3
        body.explicitinertial = True
        body.add_joint(name=f"{name}_joint", type=mujoco.mjtJoint.mjJNT_HINGE)
    return spec


def test_what_is_stripped_is_gone_or_fixed(tmp_path: Path) -> None:
    """A body goes with its weight, a joint leaves the weight."""
    text = bodies.file_text(Path("model.xml"), strip='["neck", "tail_joint"]')
    assert find_robot(written(tmp_path, strip_spec(), text)).total_mass == pytest.approx(15.7)


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
    arm = """
      <body name="arm" pos="0.1 0 0.1">
        <inertial pos="0 0 0" mass="1" diaginertia="0.01 0.01 0.01"/>
        <joint name="arm_joint" type="hinge"/>
        <body name="hand" pos="0 0 0.1">
          <inertial pos="0 0 0" mass="1" diaginertia="0.01 0.01 0.01"/>
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
    name = edited(
        tmp_path,
        [(LEFT_LEG, arm + LEFT_LEG), ("<sensor>", refer + "<sensor>")],
        strip=strip,
    )
    assert find_robot(name).total_mass == pytest.approx(mass)
    assert scene_of(name).model.ntendon == 0


LEFT_LEG = '<body name="LF_hip"'
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


def edited(folder: Path, edits: list[tuple[str, str]], **extra: str) -> str:
    """Path of the file of a robot that is ours with a few words of its model changed."""
    folder.mkdir(exist_ok=True)
    text = (scene_dir() / "quadruped.xml").read_text()
    for old, new in edits:
        text = swapped(old, new)(text)
    (folder / "model.xml").write_text(text)
    (folder / "maker.toml").write_text(bodies.file_text(Path("model.xml"), **extra))
    return str(folder / "maker.toml")


@pytest.mark.parametrize("left", LEFTOVERS)
def test_nothing_of_the_makers_is_left(tmp_path: Path, left: str) -> None:
    """The scene is that of a model without it."""
    extra = {"foot_radius": "0.03", "hip_torque": "20", "knee_torque": "40"}
    name = edited(tmp_path / "left", [LEFTOVERS[left]], **extra)
    plain = edited(tmp_path / "plain", [], **extra)
    assert scene_of(name).hash == scene_of(plain).hash
    found, expected = find_robot(name), find_robot(plain)
    legs = zip(found.legs, expected.legs, strict=True)
    same = [dataclasses.replace(leg, foot=x.foot) for leg, x in legs]
    assert dataclasses.replace(found, legs=tuple(same)) == expected


@pytest.mark.parametrize(
    "edit",
    [
        ("<default>", '<default><site euler="0 1.5 0" pos="1 2 3" material="shell"/>'),
        ('<site name="imu"', '<site name="balance_imu" pos="0.1 0 0" euler="0 1 0"/><site'),
    ],
)
def test_the_imu_is_ours(tmp_path: Path, edit: tuple[str, str]) -> None:
    """At the trunk's origin, along its axes, whatever sites are in its maker's model."""
    scene = scene_of(edited(tmp_path, [edit]))
    model = scene.model
    for name in ("gyro", "accelerometer"):
        site = int(model.sensor(f"{ROBOT}{name}").objid[0])
        assert model.site_pos[site].tolist() == [0, 0, 0]
        assert model.site_quat[site].tolist() == [1, 0, 0, 0]
    np.testing.assert_allclose(scene.stance.imu, [0, 0, 0, 0, 0, 9.81], atol=0.01)


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
    edits = []
    for leg in bodies.LEGS:
        old = f'<geom name="{leg}_rubber"'
        edits += [(old, FEET[kind].format(f"{leg}_paw") + old)]
    feet = {leg: f'foot = "{leg}_paw"' for leg in bodies.LEGS}
    name = edited(tmp_path, edits, foot_radius="0.022", **feet)
    path = Path(name)
    lines = [x for x in path.read_text().splitlines() if not x.endswith('_foot"')]
    path.write_text("\n".join(lines))
    for leg, ours in zip(find_robot(name).legs, robot.legs, strict=True):
        assert (leg.calf, leg.x, leg.y) == pytest.approx((0.213, ours.x, ours.y), abs=1e-9)


@pytest.mark.parametrize(
    ("option", "total", "trunk"),
    [
        ('settotalmass="30.4"', 30.4, 2 * 6.92),
        ('boundmass="0.68"', 15.2 + 4 * (0.68 - 0.24), 6.92),
    ],
)
@pytest.mark.filterwarnings("ignore:compiler attribute")
def test_masses_are_what_the_compiler_makes_them(
    tmp_path: Path, option: str, total: float, trunk: float
) -> None:
    """In the scene too, whose compiler has no such options."""
    name = edited(tmp_path, [("<compiler ", f"<compiler {option} ")])
    robot, model = find_robot(name), scene_of(name).model
    assert (robot.total_mass, robot.trunk_mass) == pytest.approx((total, trunk))
    assert model.body(f"{ROBOT}trunk").mass[0] == pytest.approx(trunk)
    assert model.body(f"{ROBOT}trunk").subtreemass[0] == pytest.approx(total)


KNEES = {
    "none to speak of": ("-9.42 9.42", (-2.7, -0.1)),
    "alike both ways": ("-2.6 2.69", (-2.6, -0.1)),
    "past the thigh": ("-3.5 -0.8", (-2.7, -0.8)),
    "mostly forward": ("-1 2.69", (0.1, 2.69)),
    "a whole turn off": ("-5.585 -3.578", (2 * np.pi - 5.585, 2 * np.pi - 3.578)),
    "two turns off": ("9.866 11.766", (9.866 - 4 * np.pi, 11.766 - 4 * np.pi)),
}


@pytest.mark.parametrize("limits", KNEES)
def test_which_way_knees_point(limits: str, tmp_path: Path) -> None:
    """By their limits; the servos' targets lie within these, and put the feet where told."""
    said, turns = KNEES[limits]
    name = edited(tmp_path, [('range="-2.72 -0.838"', f'range="{said}"')])
    _check_knees(name, [turns] * 4)


def test_a_hip_a_whole_turn_off(tmp_path: Path) -> None:
    name = edited(tmp_path, [('range="-1.5708 3.4907"', 'range="4.7124 9.7739"')])
    _check_knees(name, [(-2.72, -0.838)] * 4)


def test_knees_that_can_do_both_all_point_backward(tmp_path: Path) -> None:
    """Those of the right turn the other way, so that they have more room forward."""
    flips = [(f'name="R{x}_knee" class', f'name="R{x}_knee" axis="0 -1 0" class') for x in "FH"]
    name = edited(tmp_path, [('range="-2.72 -0.838"', 'range="-2.69 2.6"'), *flips])
    _check_knees(name, [(-2.69, -0.1), (-2.6, -0.1)] * 2)


def test_a_file_may_say_which_way_knees_point(tmp_path: Path) -> None:
    """And front knees may point another way than hind ones."""
    forward = dict.fromkeys(("LF", "RF"), 'knee = "forward"')
    name = edited(tmp_path, [('range="-2.72 -0.838"', 'range="-2.6 2.6"')], **forward)
    _check_knees(name, [(0.1, 2.6), (0.1, 2.6), (-2.6, -0.1), (-2.6, -0.1)])


def _check_knees(name: str, turns: list[tuple[float, float]]) -> None:
    scene = scene_of(name)
    model, robot = scene.model, scene.robot
    np.testing.assert_allclose([leg.knee for leg in robot.legs], turns, atol=2e-3)
    data = mujoco.MjData(model)
    for height in np.linspace(*robot.height_range, 5):
        angles = joint_angles(robot, np.full(4, height))
        feet = feet_of(scene, data, angles)
        np.testing.assert_allclose(-feet[:, 2] + robot.foot_radius, height, atol=1e-6)
        np.testing.assert_allclose(foot_heights(robot, angles), height, atol=1e-6)
        for leg, row in zip(robot.legs, angles, strict=True):
            for joint, angle in zip(leg.joints, row, strict=True):
                low, high = model.joint(f"{ROBOT}{joint}").range
                assert low - 1e-6 <= angle <= high + 1e-6, joint


def test_a_trunk_whose_origin_is_behind_all_legs(tmp_path: Path, robot: Robot) -> None:
    """Corners are told apart, and an action turns the body by as much as ours."""
    edits = [(f'"{leg}_hip" pos="{x}', f'"{leg}_hip" pos="{y}') for leg, x, y in SHIFTED]
    found = find_robot(edited(tmp_path, edits))
    assert (found.left, found.front) == (robot.left, robot.front)
    assert found.lever == pytest.approx(0.193)
    assert found.action_max == 0.003
    assert [leg.x for leg in found.legs] == pytest.approx([0.396, 0.396, 0.01, 0.01])


SHIFTED = [
    (leg, f"{x}0.193", f"{0.203 + float(x + '0.193'):.3f}")
    for leg, x in (("LF", ""), ("RF", ""), ("LH", "-"), ("RH", "-"))
]


@pytest.mark.parametrize("kind", ["negative gain", "in the parent's frame"])
def test_torques_of_unusual_motors(kind: str, tmp_path: Path) -> None:
    spec = bodies.with_motors(bodies.our_spec())
    for motor in spec.actuators:
        if kind == "negative gain":
            motor.gainprm[0], motor.ctrlrange = -2, motor.ctrlrange / 2
        else:
            motor.trntype = mujoco.mjtTrn.mjTRN_JOINTINPARENT
    text = bodies.file_text(Path("model.xml"), foot_radius="0.022")
    robot = find_robot(written(tmp_path, spec, text))
    assert (robot.hip_torque, robot.knee_torque) == pytest.approx((23.7, 45.4), rel=1e-5)


def test_the_weakest_motor_of_a_kind_counts(tmp_path: Path) -> None:
    """An abduction has 20 N m, one knee 30: no leg is told to do more."""
    spec = bodies.our_spec()
    for name, torque in (("RH_abduction", 20.0), ("LF_knee", 30.0)):
        [servo] = [x for x in spec.actuators if x.target == name]
        servo.forcerange = [-torque, torque]
    robot = find_robot(written(tmp_path, spec))
    assert (robot.hip_torque, robot.knee_torque) == (20.0, 30.0)


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
    spec = bodies.our_spec()
    for leg in ("LH", "RH"):
        spec.geom(f"{leg}_foot").pos = [0, 0, -0.18]
    robot = find_robot(written(tmp_path, spec))
    height = round(0.022 + 0.77 * (0.426 + 0.393) / 2, 3)
    assert robot.body_height == height
    softer = (0.4095 * height / (0.426 * 0.35)) ** 2
    found = (robot.servo_stiffness, robot.servo_damping, robot.servo_armature)
    assert found == pytest.approx((400 * softer, 16 * softer, 0.02 * softer), rel=3e-3)


@pytest.mark.parametrize(("limits", "end"), [((-2.72, -1.5), 1), ((-1.4, -0.3), 0)])
def test_a_height_leaves_room_for_the_board(
    tmp_path: Path, limits: tuple[float, float], end: int
) -> None:
    """Knees that stay bent or straight: 7 deg below the longest legs, or above the shortest."""
    spec = bodies.our_spec()
    for leg in bodies.LEGS:
        spec.joint(f"{leg}_knee").range = limits
    robot = find_robot(written(tmp_path, spec))
    reach = 0.426 * np.cos(limits[end] / 2) + 0.022
    room = np.tan(np.radians(7)) * (0.193 + 0.142)
    assert robot.body_height == pytest.approx(reach - room if end else reach + room, abs=6e-4)


def test_a_strong_robot_can_be_read_back(tmp_path: Path) -> None:
    """A policy carries its numbers; one of 300 kg on narrow legs has servos of 10,100 N m/rad."""
    name = edited(tmp_path, [], servo_stiffness="10100", knee_torque="20000")
    robot = find_robot(name)
    values = json.loads(json.dumps(dataclasses.asdict(robot)))
    assert from_dict(Robot, values) == robot


def heavy_spec() -> mujoco.MjSpec:
    spec = bodies.our_spec()
    spec.body("trunk").mass = 400
    return spec


def short_spec() -> mujoco.MjSpec:
    spec = bodies.our_spec()
    for leg in bodies.LEGS:
        spec.joint(f"{leg}_knee").range = [-1.2, -1.0]
    return spec


def tied_spec() -> mujoco.MjSpec:
    spec = bodies.our_spec()
    spec.delete(spec.joint("root"))
    return spec


def universal_spec() -> mujoco.MjSpec:
    """One leg's abduction and hip on one body."""
    spec = bodies.our_spec()
    spec.delete(spec.joint("LF_hip"))
    hip = spec.body("LF_hip").add_joint(name="LF_hip", axis=[0, 1, 0])
    hip.type = mujoco.mjtJoint.mjJNT_HINGE
    return spec


def swapped(old: str, new: str) -> Callable[[str], str]:
    def edit(text: str) -> str:
        assert old in text
        return text.replace(old, new, 1)

    return edit


@pytest.mark.parametrize(
    ("spec", "edit", "message"),
    [
        (bodies.our_spec, swapped('"trunk"', '"torso"'), "trunk is 'torso', which its model"),
        (tied_spec, str, "trunk 'trunk' has no free joint"),
        (bodies.our_spec, swapped('"LF_hip"', '"LF_hop"'), "joint 'LF_hop' of leg LF is none"),
        (
            bodies.our_spec,
            swapped('"LF_hip", "LF_knee"', '"LF_knee", "LF_hip"'),
            "joint 'LF_hip' of leg LF does not hang on 'LF_calf'",
        ),
        (
            bodies.our_spec,
            swapped('foot = "LF_foot"', 'foot = "RF_foot"'),
            "foot of leg LF hangs on body 'RF_calf'; it must hang on .* 'LF_calf'",
        ),
        (bodies.our_spec, swapped('"LF_foot"', '"LF_paw"'), "foot of leg LF is 'LF_paw', which"),
        (
            bodies.our_spec,
            lambda text: text + 'side = "left"\n',
            "leg RH is said to be left, but it stands right",
        ),
        (
            bodies.our_spec,
            swapped('"LF_foot"\n', '"LF_foot"\nend = "front"\n'),
            "end is said of some legs only",
        ),
        (
            lambda: _moved("LH_hip", [0.1, 0.0465, 0]),
            str,
            "legs LF and LH both stand front left",
        ),
        (strip_spec, str, "joint 'neck_joint' is in no leg; strip it"),
        (strip_spec, swapped("trunk =", 'strip = ["nose"]\ntrunk ='), "strip names 'nose', which"),
        *(
            (bodies.our_spec, swapped("trunk =", f'strip = ["{name}"]\ntrunk ='), message)
            for name, message in (
                ("world", "strip names 'world', which is, or carries, the trunk"),
                ("trunk", "strip names 'trunk', which is, or carries, the trunk"),
                ("root", "strip names 'root', by which the trunk is free; it must be"),
                ("LF_knee", "strip takes joint 'LF_knee' of leg LF, which the leg needs"),
                ("LF_thigh", "strip takes joint 'LF_hip' of leg LF, which the leg needs"),
            )
        ),
        *(
            (bodies.our_spec, swapped("model.xml", f"{package}:m.xml"), f"'{package}' is not inst")
            for package in ("no_such.part", "./here", "__main__", "my robot")
        ),
        (bodies.our_spec, swapped('trunk = "trunk"', 'trunk = "world"'), "trunk is 'world', which"),
        (
            bodies.our_spec,
            lambda text: text + 'knee = "forward"\n',
            "joints 'RH_hip' and 'RH_knee' of leg RH cannot turn far enough .* the knee forward: "
            "the thigh turns from -90 to 200 deg, the calf against it from -156 to -48 deg",
        ),
        (
            lambda: _range("LH_knee", [0.8, 2.7]),
            str,
            "knees of legs LH and RH would point different ways, that of LH forward; say knee of b",
        ),
        (
            lambda: _range("RF_abduction", [0.1, 1.0]),
            str,
            "joint 'RF_abduction' of leg RF turns the hip's axis from 6 to 57 deg off level",
        ),
        (
            universal_spec,
            str,
            "joint 'LF_hip' of leg LF is on body 'LF_hip', as the one before it",
        ),
        (
            bodies.our_spec,
            lambda text: _ends(text, {"LF": "front", "RF": "hind", "LH": "front", "RH": "hind"}),
            "legs LF and LH are said to be front, but they stand at different ends",
        ),
        (lambda: _weighing(1e-4), str, "it weighs 0.00152 kg"),
        (
            lambda: _weighing(1e5),
            str,
            r"servo_stiffness is 4\d{7}.0; it must be at most 10000000",
        ),
        (short_spec, str, "too short for the board: its legs reach from 0.3"),
        (
            lambda: _axis("RF_knee", [0, 0, 1]),
            str,
            r"joint 'RF_knee' of leg RF turns about \(0.00, 0.00, 1.00\)",
        ),
        (
            lambda: _axis("RF_abduction", [0, 1, 0]),
            str,
            "joint 'RF_abduction' of leg RF turns about",
        ),
        (bodies.our_spec, swapped("trunk =", 'imu = "LF_foot"\ntrunk ='), "imu 'LF_foot' is on"),
        (bodies.our_spec, swapped("trunk =", 'imu = "eye"\ntrunk ='), "imu is 'eye', which"),
        (bodies.our_spec, swapped("model.xml", "gone.xml"), "but there is no file .*gone.xml"),
        (bodies.our_spec, swapped("model.xml", "maker.toml"), "maker.toml cannot be read"),
        (
            bodies.our_spec,
            swapped("model.xml", "no_such_package:a.xml"),
            "the Python package 'no_such_package' is not installed",
        ),
    ],
)
def test_what_does_not_fit_is_named(
    spec: Callable[[], mujoco.MjSpec], edit: Callable[[str], str], message: str, tmp_path: Path
) -> None:
    name = written(tmp_path, spec(), edit(bodies.file_text(Path("model.xml"))))
    with pytest.raises(RobotError, match=message) as caught:
        find_robot(name)
    assert str(caught.value).count("\n") == 0
    with pytest.raises(ConfigError, match=message):
        for_robot(preset("default"), name)


def _moved(body: str, pos: list[float]) -> mujoco.MjSpec:
    spec = bodies.our_spec()
    spec.body(body).pos = pos
    return spec


def _axis(joint: str, axis: list[float]) -> mujoco.MjSpec:
    spec = bodies.our_spec()
    spec.joint(joint).axis = axis
    return spec


@pytest.mark.parametrize(
    ("old", "new", "message"),
    [
        ('name="LF_knee" class="knee"/>', 'nom="LF_knee"/>', "'nom'; Element 'joint', line "),
        ("0.0012 0.0012", "1 0.0012", "cannot be compiled: .*inertia .*; Element name 'LF_calf'"),
    ],
)
def test_mujocos_words_name_the_element(tmp_path: Path, old: str, new: str, message: str) -> None:
    """In one line: it writes them below its complaint."""
    text = (scene_dir() / "quadruped.xml").read_text()
    (tmp_path / "model.xml").write_text(swapped(old, new)(text))
    (tmp_path / "maker.toml").write_text(bodies.file_text(Path("model.xml")))
    with pytest.raises(RobotError, match=message) as caught:
        find_robot(str(tmp_path / "maker.toml"))
    assert "\n" not in str(caught.value)
    with pytest.raises(RobotError, match="Element") as caught:
        draft("model.xml", tmp_path / "model.xml")
    assert "\n" not in str(caught.value)


def _range(joint: str, limits: list[float]) -> mujoco.MjSpec:
    spec = bodies.our_spec()
    spec.joint(joint).range = limits
    return spec


def _weighing(share: float) -> mujoco.MjSpec:
    """Its own weight times this."""
    spec = bodies.our_spec()
    for body in spec.bodies[1:]:
        body.mass, body.inertia = body.mass * share, body.inertia * share
    return spec


def _ends(text: str, ends: dict[str, str]) -> str:
    for leg, end in ends.items():
        text = swapped(f'"{leg}_foot"', f'"{leg}_foot"\nend = "{end}"')(text)
    return text


def _headed() -> mujoco.MjSpec:
    """The trunk's weight half a metre ahead: 6.92 of 15.2 kg, the legs' own 1 mm behind."""
    spec = bodies.our_spec()
    spec.body("trunk").ipos = [0.5, 0, 0]
    return spec


@pytest.mark.parametrize(
    ("spec", "said", "message"),
    [
        (_headed, {}, "its centre of mass is 22[678] mm ahead of .* stand from -193 to 193 mm"),
        (
            bodies.our_spec,
            {"servo_stiffness": "30", "knee_torque": "500", "hip_torque": "500"},
            "with servo_stiffness 30 N m/rad: leave out servo_stiffness of its file",
        ),
    ],
)
def test_why_it_does_not_stand(
    spec: Callable[[], mujoco.MjSpec], said: dict[str, str], message: str, tmp_path: Path
) -> None:
    text = bodies.file_text(Path("model.xml"), **{"knee_torque": "500", "hip_torque": "500"} | said)
    with pytest.raises(ConfigError, match=message):
        scene_of(written(tmp_path, spec(), text))


def test_too_heavy_for_its_servos(tmp_path: Path) -> None:
    name = written(tmp_path, heavy_spec())
    with pytest.raises(
        ConfigError, match=r"weighs 408\.3 kg, too much for its servos: '.._(hip|knee)'"
    ):
        scene_of(name)


def test_an_unlimited_servo_has_no_limit(tmp_path: Path) -> None:
    spec = bodies.our_spec()
    for servo in [*spec.actuators]:
        spec.delete(servo)
    assert find_robot(written(tmp_path, spec)).knee_torque == 1e4


def test_a_spec_is_new_each_time(robot: Robot) -> None:
    """Whoever attaches one owns it."""
    first = robot_spec("quadruped")
    first.body("trunk").mass = 1.0
    assert robot_spec("quadruped").body("trunk").mass == 6.92
