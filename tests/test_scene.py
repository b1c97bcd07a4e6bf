"""The compiled model is the robot of the config, and it stands on a board that obeys."""

import copy
import dataclasses
from pathlib import Path

import mujoco
import numpy as np
import pytest
from mjx_balance.plant import standing_heights
from mjx_balance.task.legs import joint_angles

from mjx_balance.config import Config, ConfigError
from mjx_balance.scene import (
    BOARD,
    ROBOT,
    Scene,
    build_model,
    load_scene,
    robot_numbers,
    scene_dir,
    scene_hash,
)

LEGS = ("LF", "RF", "LH", "RH")
GEOM = mujoco.mjtGeom
PRIMITIVES = (
    GEOM.mjGEOM_PLANE,
    GEOM.mjGEOM_SPHERE,
    GEOM.mjGEOM_CAPSULE,
    GEOM.mjGEOM_ELLIPSOID,
    GEOM.mjGEOM_CYLINDER,
    GEOM.mjGEOM_BOX,
)


def standing(config: Config, scene: Scene) -> mujoco.MjData:
    """The robot at rest on the level board, its legs held."""
    data = mujoco.MjData(scene.model)
    data.qpos[:], data.qvel[:] = scene.stance.qpos, scene.stance.qvel
    data.qacc_warmstart[:] = scene.stance.qacc_warmstart
    angles = joint_angles(config.robot, standing_heights(config))
    data.ctrl[scene.leg_ctrl] = angles + scene.stance.leg_trim
    return data


def test_model_has_the_configs_numbers(config: Config, scene: Scene) -> None:
    for name, modelled in robot_numbers(config.robot, scene.model).items():
        assert modelled == pytest.approx(getattr(config.robot, name)), name


def test_model_by_independent_measure(scene: Scene) -> None:
    """Degrees of freedom, servos and masses, without the package's own reader."""
    model = scene.model
    assert (model.nu, model.nv, model.nq) == (14, 20, 21)
    assert model.opt.timestep == 0.004
    robot = [k for k in range(model.nbody) if model.body(k).name.startswith(ROBOT)]
    assert len(robot) == 13
    assert model.body_mass[robot].sum() == pytest.approx(15.2)
    np.testing.assert_array_equal(model.opt.gravity, (0, 0, -9.81))
    assert model.opt.disableflags & mujoco.mjtDisableBit.mjDSBL_AUTORESET


def test_every_leg_has_three_limited_servos(scene: Scene) -> None:
    for k, leg in enumerate(LEGS):
        for j, (joint, torque) in enumerate((("abduction", 23.7), ("hip", 23.7), ("knee", 45.4))):
            servo = scene.model.actuator(f"{ROBOT}{leg}_{joint}")
            assert servo.id == scene.leg_ctrl[k, j]
            assert servo.trnid[0] == scene.model.joint(f"{ROBOT}{leg}_{joint}").id
            assert scene.model.jnt_qposadr[servo.trnid[0]] == scene.leg_qpos[k, j]
            assert scene.model.actuator_forcelimited[servo.id]
            assert servo.forcerange.tolist() == [-torque, torque]
            assert (servo.gainprm[0], servo.biasprm[1]) == (400.0, -400.0)


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
    model = build_model(config, visual)
    assert not model.geom_contype.any()
    assert not model.geom_conaffinity.any()
    pairs = [
        {model.geom(a).name, model.geom(b).name}
        for a, b in zip(model.pair_geom1, model.pair_geom2, strict=True)
    ]
    assert len(pairs) == 4
    for leg in LEGS:
        assert {f"{ROBOT}{leg}_foot", f"{BOARD}board"} in pairs
    np.testing.assert_allclose(model.pair_friction[:, :2], config.robot.foot_friction)


def test_robot_stands_at_its_height_at_rest(config: Config, scene: Scene) -> None:
    stance = scene.stance
    root = scene.model.joint(f"{ROBOT}root").qposadr[0]
    assert stance.qpos[root + 2] == pytest.approx(0.35, abs=1.5e-3)
    assert np.abs(stance.qvel).max() < 1e-3
    assert abs(stance.qpos[scene.trunk_quat[0]]) == pytest.approx(1, abs=1e-6)
    np.testing.assert_allclose(stance.imu, (0, 0, 0, 0, 0, 9.81), atol=5e-3)
    wanted = joint_angles(config.robot, standing_heights(config))
    np.testing.assert_allclose(stance.qpos[scene.leg_qpos], wanted, atol=1e-3)


def test_robot_keeps_standing_on_the_level_board(config: Config, scene: Scene) -> None:
    """10 s: it neither sinks nor creeps."""
    data = standing(config, scene)
    mujoco.mj_step(scene.model, data, nstep=2500)
    np.testing.assert_allclose(data.qpos, scene.stance.qpos, atol=1e-3)


@pytest.mark.parametrize("goal", [(7.0, 7.0), (-7.0, 7.0)])
def test_board_follows_its_command_under_the_robot(
    config: Config, scene: Scene, goal: tuple[float, float]
) -> None:
    """A ramp of 3.5 deg/s on both axes at once, then 2 s of rest: 0.1 deg at every step."""
    data = standing(config, scene)
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


@pytest.mark.parametrize(
    "array",
    [
        "body_mass",
        "body_inertia",
        "actuator_gainprm",
        "actuator_forcerange",
        "dof_damping",
        "pair_friction",
        "jnt_range",
        "geom_size",
    ],
)
def test_hash_sees_a_change_of_one_percent(scene: Scene, array: str) -> None:
    model = copy.copy(scene.model)
    getattr(model, array)[...] *= 1.01
    assert scene_hash(model) != scene.hash


@pytest.mark.parametrize("option", ["impratio", "disableflags", "cone"])
def test_hash_sees_a_change_of_the_solvers_model(scene: Scene, option: str) -> None:
    """E.g. impratio sets how far feet creep on a slope (scenes/scene.xml)."""
    model = copy.copy(scene.model)
    setattr(model.opt, option, getattr(model.opt, option) + 1)
    assert scene_hash(model) != scene.hash


@pytest.mark.parametrize("name", ["thigh", "foot_radius", "total_mass", "knee_torque"])
def test_config_that_disagrees_with_the_robot_is_refused(config: Config, name: str) -> None:
    value = 1.05 * getattr(config.robot, name)
    robot = dataclasses.replace(config.robot, **{name: value})
    with pytest.raises(ConfigError, match=rf"{name} is {value}, but the robot .* has"):
        build_model(dataclasses.replace(config, robot=robot))


@pytest.mark.parametrize("path", sorted(scene_dir().glob("*.xml")), ids=lambda path: path.stem)
def test_scene_file_stands_alone_and_is_primitive(path: Path) -> None:
    """No meshes to download; what is only looked at has no mass."""
    spec = mujoco.MjSpec.from_file(str(path))
    model = spec.compile()
    assert model.nmesh == model.nhfield == model.nskin == 0
    assert set(model.geom_type) <= {int(kind) for kind in PRIMITIVES}
    assert not [geom.name for geom in spec.geoms if geom.mass > 0]


def test_scene_is_made_of_these_files() -> None:
    assert {p.name for p in scene_dir().glob("*.xml")} == {
        "board.xml",
        "quadruped.xml",
        "scene.xml",
    }
