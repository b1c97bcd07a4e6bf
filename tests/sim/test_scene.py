"""The compiled model is the robot of the config, and it stands on a board that obeys."""

import copy
import dataclasses
import math
from pathlib import Path
from typing import Any

import jax.numpy as jnp
import mujoco
import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from mjx_balance.config import Config, ConfigError
from mjx_balance.robots.catalogue import SHIPPED, Robot
from mjx_balance.sim.scene import (
    BOARD,
    ROBOT,
    Scene,
    build_model,
    load_scene,
    scene_dir,
    scene_hash,
)

LEGS = ("LF", "RF", "LH", "RH")
LEAN = float(np.arccos(0.164 / 0.213))
STANDING = np.tile((0.0, LEAN, -2 * LEAN), (4, 1))
"""Abduction, hip and knee of 0.35 m: 0.328 m between two links of 0.213 m."""


def with_task(config: Config, **values: Any) -> Config:
    return dataclasses.replace(config, task=dataclasses.replace(config.task, **values))


def standing(scene: Scene) -> mujoco.MjData:
    """The robot at rest on the level board, its legs held."""
    data = mujoco.MjData(scene.model)
    data.qpos[:], data.qvel[:] = scene.stance.qpos, scene.stance.qvel
    data.qacc_warmstart[:] = scene.stance.qacc_warmstart
    data.ctrl[scene.leg_ctrl] = STANDING + scene.stance.leg_trim
    return data


def test_model_has_the_robots_numbers(robot: Robot, scene: Scene) -> None:
    """A Unitree Go2's published dimensions; gains chosen."""
    assert tuple(leg.name for leg in robot.legs) == LEGS
    for leg in robot.legs:
        side, end = (1 if leg.name[0] == "L" else -1), (1 if leg.name[1] == "F" else -1)
        assert (leg.left, leg.front) == (side > 0, end > 0)
        at = (leg.x, leg.y, leg.axis_height, leg.drop, leg.offset)
        expected = (0.193 * end, 0.142 * side, 0, 0, 0.0955 * side)
        assert at == pytest.approx(expected, abs=1e-9)
        assert (leg.thigh, leg.calf, *leg.knee) == (0.213, 0.213, -2.72, -0.838)
        assert (leg.signs, leg.zeros) == ((1, 1, 1), (0, 0, 0))
    assert (robot.foot_radius, robot.trunk_mass, robot.total_mass) == (0.022, 6.92, 15.2)
    assert (robot.hip_torque, robot.knee_torque) == (23.7, 45.4)
    gains = (robot.servo_stiffness, robot.servo_damping, robot.servo_armature)
    assert gains == (400.0, 16.0, 0.02)
    damped = scene.model.dof_damping[scene.model.jnt_dofadr[scene.model.joint("robot/LF_hip").id]]
    assert np.ravel(damped)[0] == 16.0
    assert (robot.body_height, robot.action_max) == (0.35, 0.003)
    assert (robot.mass_scale, robot.size_scale) == (1.0, 1.0)
    parts = [body for k in range(scene.model.nbody) if ROBOT in (body := scene.model.body(k)).name]
    assert len(parts) == 13
    assert sum(body.mass[0] for body in parts) == pytest.approx(15.2)


def test_addresses_are_those_of_the_names(scene: Scene) -> None:
    """Every joint, servo and sensor, looked up the C way."""
    model, kinds = scene.model, mujoco.mjtObj

    def find(kind: mujoco.mjtObj, name: str) -> int:
        number = mujoco.mj_name2id(model, kind, name)
        assert number >= 0, name
        return number

    for k, leg in enumerate(LEGS):
        for j, joint in enumerate(("abduction", "hip", "knee")):
            name = f"robot/{leg}_{joint}"
            at = model.jnt_qposadr[find(kinds.mjOBJ_JOINT, name)]
            assert scene.leg_qpos[k, j] == at
            assert scene.leg_ctrl[k, j] == find(kinds.mjOBJ_ACTUATOR, name)
            servo = model.actuator(name)
            assert servo.trnid[0] == model.joint(name).id
            torque = 45.4 if joint == "knee" else 23.7
            assert (*servo.forcelimited, *servo.forcerange) == (1, -torque, torque)
            assert (servo.gainprm[0], servo.biasprm[1]) == (400.0, -400.0)
    for k, name in enumerate(("board/board_x", "board/board_y")):
        joint, servo = find(kinds.mjOBJ_JOINT, name), find(kinds.mjOBJ_ACTUATOR, name)
        assert scene.board_qpos[k] == model.jnt_qposadr[joint]
        assert scene.board_ctrl[k] == servo
        assert model.actuator_trnid[servo, 0] == joint
        np.testing.assert_array_equal(model.jnt_axis[joint], np.eye(3)[k])
    root = find(kinds.mjOBJ_JOINT, "robot/root")
    np.testing.assert_array_equal(scene.trunk_quat, model.jnt_qposadr[root] + np.arange(3, 7))
    np.testing.assert_array_equal(scene.trunk_velocity, model.jnt_dofadr[root] + np.arange(2))
    assert scene.trunk == find(kinds.mjOBJ_BODY, "robot/trunk")
    gyro, accel = (
        model.sensor_adr[find(kinds.mjOBJ_SENSOR, f"robot/{name}")]
        for name in ("gyro", "accelerometer")
    )
    assert scene.imu.tolist() == [gyro, gyro + 1, gyro + 2, accel, accel + 1, accel + 2]
    site = find(kinds.mjOBJ_SITE, "robot/imu")
    assert (model.sensor_objid == site).all()


def test_imu_tells_turning_and_leaning_by_sign(scene: Scene) -> None:
    """Rolling right reads +x; held nose down by 10 deg gravity reads +-9.81 sin 10 on x."""
    data = mujoco.MjData(scene.model)
    root = scene.trunk_quat[0] - 3
    data.qpos[root : root + 3] = (0, 0, 1)
    nose_down = Rotation.from_euler("y", 10, degrees=True)
    data.qpos[scene.trunk_quat] = nose_down.as_quat(scalar_first=True)
    free = scene.model.jnt_dofadr[scene.model.joint("robot/root").id]
    data.qvel[free + 3 : free + 6] = (0.1, 0.2, 0.3)
    mujoco.mj_forward(scene.model, data)
    # In free fall an accelerometer reads nothing; gravity is what the ground adds.
    data.qacc[:] = 0
    mujoco.mj_rnePostConstraint(scene.model, data)
    mujoco.mj_sensorVel(scene.model, data)
    mujoco.mj_sensorAcc(scene.model, data)
    gyro, accel = data.sensordata[scene.imu[:3]], data.sensordata[scene.imu[3:]]
    np.testing.assert_allclose(gyro, (0.1, 0.2, 0.3), atol=1e-9)
    up = nose_down.inv().apply((0, 0, 9.81))
    np.testing.assert_allclose(accel, up, atol=1e-6)
    assert accel[0] == pytest.approx(-9.81 * np.sin(np.radians(10)), abs=1e-6)


def test_legs_are_mirror_images_of_the_left_front(scene: Scene) -> None:
    """The config describes one leg, so the other three must be the same."""
    model = scene.model
    for leg in LEGS:
        mirror = np.asarray([1.0, 1.0 if leg[0] == "L" else -1.0, 1.0])
        for part in ("hip", "thigh", "calf"):
            first, other = model.body(f"{ROBOT}LF_{part}"), model.body(f"{ROBOT}{leg}_{part}")
            np.testing.assert_array_equal(other.mass, first.mass)
            np.testing.assert_array_equal(other.inertia, first.inertia)
            np.testing.assert_array_equal(other.ipos, first.ipos * mirror)
            place = first.pos * mirror
            if part == "hip":
                place = place * (1 if leg[1] == "F" else -1, 1, 1)
            np.testing.assert_array_equal(other.pos, place)


@pytest.mark.parametrize("visual", [False, True])
def test_only_feet_and_board_collide(config: Config, visual: bool) -> None:
    model = build_model(config.task, config.robot, visual)
    assert (model.nu, model.nv, model.nq) == (14, 20, 21)
    np.testing.assert_array_equal(model.opt.gravity, (0, 0, -9.81))
    assert model.opt.disableflags & mujoco.mjtDisableBit.mjDSBL_AUTORESET
    assert not model.geom_contype.any()
    assert not model.geom_conaffinity.any()
    pairs = [
        {model.geom(a).name, model.geom(b).name}
        for a, b in zip(model.pair_geom1, model.pair_geom2, strict=True)
    ]
    assert len(pairs) == 4
    for leg in LEGS:
        assert {f"{ROBOT}{leg}_foot", f"{BOARD}board"} in pairs
    np.testing.assert_allclose(model.pair_friction[:, :2], 0.8)


def test_robot_stands_level_at_its_height_at_rest(scene: Scene) -> None:
    """By the places of things: feet on the board, hips level, legs where they were told to be."""
    stance, data = scene.stance, standing(scene)
    mujoco.mj_kinematics(scene.model, data)
    trunk = data.body("robot/trunk")
    assert trunk.xpos[2] == pytest.approx(0.35, abs=1.5e-3)
    np.testing.assert_allclose(trunk.xpos[:2], 0, atol=2e-3)
    assert trunk.xmat[8] == pytest.approx(1, abs=1e-6)
    assert trunk.xmat[0] == pytest.approx(1, abs=1e-6)
    for leg in LEGS:
        assert data.site(f"robot/{leg}_foot").xpos[2] == pytest.approx(0.022, abs=1.5e-3)
    np.testing.assert_allclose(stance.qpos[scene.board_qpos], 0, atol=1e-3)
    assert np.abs(stance.qvel).max() < 1e-3
    np.testing.assert_allclose(stance.imu, (0, 0, 0, 0, 0, 9.81), atol=5e-3)
    np.testing.assert_allclose(stance.qpos[scene.leg_qpos], STANDING, atol=2e-4)


def test_trim_is_what_the_load_bends_the_servos_by(scene: Scene) -> None:
    """A servo of 400 N m/rad that carries a torque stands torque / 400 off its target."""
    data = standing(scene)
    mujoco.mj_forward(scene.model, data)
    torque = data.actuator_force[scene.leg_ctrl]
    assert np.abs(torque[:, 2]).min() > 1, "knees carry the robot"
    np.testing.assert_allclose(torque / 400, scene.stance.leg_trim, atol=2e-4)
    upward = sum(np.ravel(data.contact[k].frame)[2] for k in range(data.ncon))
    assert data.ncon == 4
    assert abs(upward) == pytest.approx(4, abs=1e-3)


def test_stance_goes_on_as_if_nothing_had_begun(scene: Scene) -> None:
    """The first step reads what the last of the settling read; in 10 s it does not creep."""
    data = standing(scene)
    mujoco.mj_step(scene.model, data)
    np.testing.assert_allclose(data.sensordata[scene.imu], scene.stance.imu, atol=1e-4)
    np.testing.assert_allclose(data.qacc_warmstart, scene.stance.qacc_warmstart, atol=1e-3)
    np.testing.assert_allclose(data.qpos, scene.stance.qpos, atol=1e-6)
    mujoco.mj_step(scene.model, data, nstep=2500)
    np.testing.assert_allclose(data.qpos, scene.stance.qpos, atol=1e-3)


@pytest.mark.parametrize("height", [0.25, 0.38])
def test_robot_stands_at_the_height_it_is_told(config: Config, height: float) -> None:
    scene = load_scene(with_task(config, body_height=height, max_incline=5.0))
    root = scene.model.joint(f"{ROBOT}root").qposadr[0]
    assert scene.stance.qpos[root + 2] == pytest.approx(height, abs=2e-3)
    assert scene.model.body(f"{ROBOT}trunk").pos[2] == pytest.approx(height)


def test_model_takes_its_numbers_from_config_and_robot(config: Config, tmp_path: Path) -> None:
    """Time step and friction; rolling friction and contact stiffness stay as they are."""
    text = (SHIPPED / "quadruped.toml").read_text()
    (tmp_path / "a.toml").write_text(text.replace("friction = 0.8", "friction = 0.55"))
    model = build_model(with_task(config, sim_dt=0.002).task, str(tmp_path / "a.toml"))
    assert model.opt.timestep == 0.002
    np.testing.assert_allclose(model.pair_friction, [(0.55, 0.55, 0.005, 0.0001, 0.0001)] * 4)
    np.testing.assert_allclose(model.pair_solref, [(0.01, 1)] * 4)
    assert model.pair_dim.tolist() == [3] * 4
    assert model.opt.cone == mujoco.mjtCone.mjCONE_ELLIPTIC


def test_robot_that_does_not_come_to_rest_is_refused(
    config: Config, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Steps of 20 ms are too long for contacts of 10 ms: the simulation diverges."""
    monkeypatch.chdir(tmp_path)  # where MuJoCo writes its log
    with pytest.raises(ConfigError, match=r"does not stand still at body_height 0\.35 m with"):
        load_scene(with_task(config, sim_dt=0.02))


def test_robot_that_still_moves_is_refused(config: Config, monkeypatch: pytest.MonkeyPatch) -> None:
    """Upright, but looked at after 40 ms, while it sinks into its servos."""
    monkeypatch.setattr("mjx_balance.sim.scene.SETTLE_STEPS", 5)
    monkeypatch.setattr("mjx_balance.sim.scene.SETTLE_ROUNDS", 1)
    with pytest.raises(ConfigError, match="does not stand still"):
        load_scene(config)


@pytest.mark.parametrize("goal", [(7.0, 7.0), (-7.0, 7.0)])
def test_board_follows_its_command_under_the_robot(scene: Scene, goal: tuple[float, float]) -> None:
    """A ramp of 3.5 deg/s on both axes at once, then 2 s of rest: 0.1 deg at every step."""
    data = standing(scene)
    for k in range(1000):
        command = np.clip(3.5 * 0.004 * (k + 1), 0, 7) * np.sign(goal)
        data.ctrl[scene.board_ctrl] = np.radians(command)
        mujoco.mj_step(scene.model, data)
        np.testing.assert_allclose(np.degrees(data.qpos[scene.board_qpos]), command, atol=0.1)
    np.testing.assert_allclose(np.degrees(data.qpos[scene.board_qpos]), goal, atol=0.1)


def test_looks_do_not_change_the_physics(config: Config, scene: Scene) -> None:
    seen = load_scene(config, visual=True)
    assert seen.model.ngeom > 10 * scene.model.ngeom
    assert seen.hash == scene.hash
    np.testing.assert_allclose(seen.stance.qpos, scene.stance.qpos, atol=1e-12)


PHYSICS = (
    "body_mass body_inertia body_ipos body_iquat body_pos body_quat jnt_type jnt_axis jnt_pos "
    "jnt_range jnt_limited jnt_solref jnt_stiffness qpos0 dof_armature dof_damping "
    "dof_frictionloss actuator_gainprm actuator_biasprm actuator_forcerange actuator_ctrlrange "
    "actuator_gear site_pos site_quat pair_friction pair_solref pair_solimp pair_margin pair_gap "
    "pair_dim pair_solreffriction sensor_type sensor_objid geom_size geom_pos geom_quat "
    "qpos_spring jnt_solimp dof_solref dof_solimp dof_parentid body_gravcomp body_parentid "
    "actuator_trnid actuator_trntype actuator_forcelimited actuator_ctrllimited "
    "actuator_gaintype actuator_biastype actuator_dyntype jnt_actfrclimited geom_type sensor_noise"
).split()
OPTIONS = (
    "timestep gravity integrator cone impratio disableflags solver iterations ls_iterations "
    "tolerance ls_tolerance noslip_iterations enableflags density viscosity wind"
).split()


@pytest.mark.parametrize("array", PHYSICS)
def test_hash_sees_a_change_of_any_number(scene: Scene, array: str) -> None:
    """Of the last entry alone, by a percent or by one."""
    model = copy.copy(scene.model)
    values = getattr(model, array).reshape(-1)
    assert values.size > 0
    where = np.flatnonzero(values)[-1] if values.any() else values.size - 1
    whole = values.dtype.kind in "iub"
    flat = getattr(model, array).reshape(-1)
    flat[where] = 1 - flat[where] if whole else 1.01 * flat[where] + 1e-3 * (flat[where] == 0)
    assert (getattr(model, array) != getattr(scene.model, array)).any()
    assert scene_hash(model) != scene.hash


@pytest.mark.parametrize("option", OPTIONS)
def test_hash_sees_a_change_of_the_engines_options(scene: Scene, option: str) -> None:
    """E.g. impratio sets how far feet creep on a slope; one Newton iteration falls."""
    model = copy.copy(scene.model)
    value = getattr(model.opt, option)
    if isinstance(value, np.ndarray):
        value[-1] += 0.1
    else:
        setattr(model.opt, option, value - 1 if option in ("cone", "solver") else value + 1)
    assert scene_hash(model) != scene.hash


def test_hash_sees_which_geoms_touch(scene: Scene) -> None:
    model = copy.copy(scene.model)
    foot = model.pair_geom2 if len(set(model.pair_geom2)) == 4 else model.pair_geom1
    foot[0] = foot[1]
    assert scene_hash(model) != scene.hash


def test_hash_is_blind_to_looks_and_to_rounding(scene: Scene) -> None:
    """Colours, cameras, lights; masses off by 1e-9, as another compiler may make them."""
    model = copy.copy(scene.model)
    for looks in ("geom_rgba", "cam_pos", "light_diffuse", "mat_rgba", "site_rgba", "site_size"):
        getattr(model, looks)[...] *= 0.5
    model.body_mass[...] *= 1 + 1e-9
    assert scene_hash(model) == scene.hash
    assert len(scene.hash) == 16
    assert int(scene.hash, 16) >= 0


def test_same_scene_same_hash_other_scene_other_hash(config: Config, scene: Scene) -> None:
    assert scene_hash(build_model(config.task, "quadruped")) == scene.hash
    lower = dataclasses.replace(config.task, body_height=0.34)
    assert scene_hash(build_model(lower, "quadruped")) != scene.hash


@pytest.mark.parametrize("path", sorted(scene_dir().glob("*.xml")), ids=lambda path: path.stem)
def test_scene_file_stands_alone_and_is_primitive(path: Path) -> None:
    """No meshes to download; what is only looked at has no mass."""
    spec = mujoco.MjSpec.from_file(str(path))
    model = spec.compile()
    assert model.nmesh == model.nhfield == model.nskin == 0
    assert not [geom.name for geom in spec.geoms if geom.mass > 0]


def test_a_platform_is_in_the_scene_only_if_the_config_asks(config: Config, scene: Scene) -> None:
    """Scenes without one keep the fingerprint that the shipped policies were trained in."""
    assert scene.hash == "010bfb541b4f54bb"
    assert len(scene.platform_qpos) == len(scene.platform_ctrl) == 0
    assert scene.model.nv == 20
    moving = load_scene(with_task(config, platform=True, board_motions=("sea",)))
    assert moving.hash != scene.hash
    assert moving.model.nv == 23
    names = [moving.model.joint(f"platform/{name}") for name in ("surge", "sway", "heave")]
    assert moving.platform_qpos.tolist() == [joint.qposadr[0] for joint in names]
    np.testing.assert_array_equal([joint.axis for joint in names], np.eye(3))
    np.testing.assert_allclose(moving.stance.qpos[moving.platform_qpos[:2]], 0, atol=1e-9)
    sag = (15.2 + 10 + 1) * 9.81 / 2e6  # robot, board and platform on the heave's servo
    assert moving.stance.qpos[moving.platform_qpos[2]] == pytest.approx(-sag, rel=1e-3)
    np.testing.assert_allclose(moving.stance.leg_trim, scene.stance.leg_trim, atol=1e-6)


def test_a_platform_is_as_heavy_for_another_robot(config: Config) -> None:
    """B2 is 5.493 times as heavy as ours: mass, stiffness and damping of the slides, too."""
    task = dataclasses.replace(config.task, platform=True)
    ours, b2 = (build_model(task, robot) for robot in ("quadruped", "b2"))
    for field in ("dof_armature", "dof_damping"):
        np.testing.assert_allclose(getattr(b2, field)[:3], 5.493 * getattr(ours, field)[:3])
    np.testing.assert_allclose(b2.actuator_gainprm[:3, 0], 5.493 * 2e6)


def test_a_start_on_a_tilted_board_is_the_stance_turned_with_the_board(scene: Scene) -> None:
    """The turn is MuJoCo's own of the board's body, gravity that in the turned frame."""
    tilts = np.random.default_rng(0).uniform(-6, 6, (3, 2))
    data, stance = mujoco.MjData(scene.model), scene.stance
    for tilt, qpos, imu, lean in zip(tilts, *scene.start(tilts), strict=True):
        data.qpos[:] = qpos
        mujoco.mj_kinematics(scene.model, data)
        board, trunk = data.body("board/board"), data.body(scene.trunk)
        np.testing.assert_allclose(np.degrees(qpos[scene.board_qpos]), tilt, atol=1e-9)
        turned = board.xmat.reshape(3, 3)
        root = scene.trunk_quat[0] - 3
        np.testing.assert_allclose(trunk.xpos, turned @ stance.qpos[root : root + 3], atol=1e-9)
        level = np.zeros(9)
        mujoco.mju_quat2Mat(level, stance.qpos[scene.trunk_quat])
        np.testing.assert_allclose(
            trunk.xmat.reshape(3, 3), turned @ level.reshape(3, 3), atol=1e-9
        )
        np.testing.assert_allclose(imu[3:], turned.T @ stance.imu[3:], atol=1e-9)
        np.testing.assert_array_equal(imu[:3], stance.imu[:3])
        np.testing.assert_array_equal(qpos[scene.leg_qpos], stance.qpos[scene.leg_qpos])
        upright = math.degrees(math.acos(trunk.xmat[8]))
        np.testing.assert_allclose(lean, upright, atol=1e-6)
    one = scene.start(jnp.asarray(tilts[0], jnp.float32))
    np.testing.assert_allclose(one.qpos, scene.start(tilts).qpos[0], atol=1e-6)
    np.testing.assert_array_equal(scene.start(None).qpos, stance.qpos)
