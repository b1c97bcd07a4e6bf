"""Leg kinematics agree with hand calculation and with MuJoCo."""

import dataclasses
import types

import jax.numpy as jnp
import mujoco
import numpy as np
import pytest
from mjx_balance.task.legs import foot_heights, joint_angles, ramp

from mjx_balance.config import Config, RobotConfig, TaskConfig
from mjx_balance.scene import ROBOT, Scene

ROBOTS = (RobotConfig(), RobotConfig(calf=0.19), RobotConfig(thigh=0.18, calf=0.23))


def heights_of(robot: RobotConfig) -> np.ndarray:
    """(25, 4) heights over the whole reach of the legs."""
    return np.linspace(*robot.height_range, 100).reshape(25, 4)


def foot_sites(config: Config, scene: Scene, angles: np.ndarray) -> np.ndarray:
    """(legs, 3) foot centres that MuJoCo sees from the trunk, m."""
    data = mujoco.MjData(scene.model)
    data.qpos[scene.leg_qpos] = angles
    mujoco.mj_kinematics(scene.model, data)
    sites = [data.site(f"{ROBOT}{leg}_foot").xpos for leg in config.robot.legs]
    return np.asarray(sites) - data.body(f"{ROBOT}trunk").xpos


@pytest.mark.parametrize("robot", ROBOTS)
def test_forward_inverts_inverse_over_the_whole_reach(
    xp: types.ModuleType, robot: RobotConfig
) -> None:
    heights = heights_of(robot)
    got = foot_heights(robot, joint_angles(robot, xp.asarray(heights)))
    np.testing.assert_allclose(got, heights, atol=1e-6)


@pytest.mark.parametrize("robot", ROBOTS)
def test_the_reach_ends_at_the_knee_limits(robot: RobotConfig) -> None:
    knee = joint_angles(robot, heights_of(robot))[..., 2].ravel()
    assert (knee[0], knee[-1]) == pytest.approx((robot.knee_min, robot.knee_max))
    assert (np.diff(knee) > 0).all(), "longer legs have straighter knees"


def test_standing_angles_by_hand() -> None:
    """0.328 m between two links of 0.213 m: each leans acos(0.164 / 0.213) = 0.6920 rad."""
    angles = joint_angles(RobotConfig(), np.full(4, 0.35))
    np.testing.assert_allclose(angles, np.tile((0.0, 0.69203, -1.38406), (4, 1)), atol=1e-5)


def test_a_straight_leg_is_both_links_and_the_foot_long() -> None:
    assert foot_heights(RobotConfig(), np.zeros((4, 3))) == pytest.approx(0.448)


def test_forward_kinematics_agree_with_mujoco(config: Config, scene: Scene) -> None:
    """Any angles, abduction to either side included."""
    rng = np.random.default_rng(0)
    for _ in range(20):
        angles = rng.uniform((-1.0, -0.5, -2.7), (1.0, 2.0, -0.9), (4, 3))
        below = -foot_sites(config, scene, angles)[:, 2] + config.robot.foot_radius
        np.testing.assert_allclose(foot_heights(config.robot, angles), below, atol=1e-9)


def test_abduction_moves_left_and_right_feet_opposite_ways() -> None:
    """A straight leg abducted by 90 deg has its foot at the height of the hip offset."""
    angles = np.tile((np.pi / 2, 0.0, 0.0), (4, 1))
    expected = 0.022 + 0.0955 * np.asarray([-1, 1, -1, 1])
    np.testing.assert_allclose(foot_heights(RobotConfig(), angles), expected, atol=1e-9)


def test_feet_move_straight_up_and_down_under_their_hips(config: Config, scene: Scene) -> None:
    corners = np.asarray([(0.193, 0.142), (0.193, -0.142), (-0.193, 0.142), (-0.193, -0.142)])
    for height in (0.30, 0.35, 0.40):
        feet = foot_sites(config, scene, joint_angles(config.robot, np.full(4, height)))
        np.testing.assert_allclose(feet[:, :2], corners, atol=1e-9)
        np.testing.assert_allclose(feet[:, 2], 0.022 - height, atol=1e-9)


def test_ramp_is_a_line_then_rest(xp: types.ModuleType) -> None:
    """0.4 of 50 physics steps: half way after 10, there after 20, exactly."""
    before, after = xp.asarray([0.30, 0.31, 0.32, 0.33]), xp.asarray([0.32, 0.31, 0.30, 0.36])
    got = np.asarray(ramp(dataclasses.replace(TaskConfig(), action_ramp=0.4), before, after))
    assert got.shape == (50, 4)
    np.testing.assert_allclose(got[0], [0.301, 0.31, 0.319, 0.3315], atol=1e-6)
    np.testing.assert_allclose(got[9], [0.31, 0.31, 0.31, 0.345], atol=1e-6)
    assert not (got[18] == np.asarray(after)).all()
    assert (got[19:] == np.asarray(after)).all()


@pytest.mark.parametrize(("share", "steps"), [(1.0, 50), (0.001, 1)])
def test_ramp_lasts_its_share_of_the_decision(share: float, steps: int) -> None:
    task = dataclasses.replace(TaskConfig(), action_ramp=share)
    got = ramp(task, np.zeros(4), np.ones(4))
    assert int((got[:, 0] < 1).sum()) == steps - 1
    assert (got[-1] == 1).all()


def test_ramps_of_a_batch_equal_a_loop(xp: types.ModuleType) -> None:
    rng = np.random.default_rng(0)
    before, after = xp.asarray(rng.uniform(0.2, 0.4, (2, 3, 4)))
    loop = [ramp(TaskConfig(), before[k], after[k]) for k in range(3)]
    np.testing.assert_allclose(ramp(TaskConfig(), before, after), np.stack(loop))


def test_numpy_and_jax_agree() -> None:
    robot, heights = RobotConfig(), heights_of(RobotConfig())[1:]
    angles = joint_angles(robot, heights)
    np.testing.assert_allclose(joint_angles(robot, jnp.asarray(heights)), angles, atol=2e-6)
    angles[..., 0] = np.linspace(-1, 1, 4)
    jaxed = foot_heights(robot, jnp.asarray(angles))
    np.testing.assert_allclose(jaxed, foot_heights(robot, angles), atol=1e-6)
