"""Leg kinematics agree with hand calculation and with MuJoCo."""

import types

import mujoco
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from mjx_balance.config import TaskConfig
from mjx_balance.robots.catalogue import Robot
from mjx_balance.sim.scene import ROBOT, Scene
from mjx_balance.task.kinematics import foot_heights, joint_angles, ramp

LINKS = ((0.213, 0.213), (0.213, 0.19), (0.18, 0.23))
"""Thigh and calf, m."""


@pytest.fixture(params=LINKS, ids=str)
def any_robot(robot: Robot, request: pytest.FixtureRequest, bodies: types.ModuleType) -> Robot:
    """Robots with legs of other proportions too."""
    thigh, calf = request.param
    return bodies.with_legs(robot, thigh=thigh, calf=calf)


def heights_of(robot: Robot) -> np.ndarray:
    """(25, 4) heights over the whole reach of the legs."""
    return np.linspace(*robot.height_range, 100).reshape(25, 4)


def foot_sites(scene: Scene, angles: np.ndarray) -> np.ndarray:
    """(legs, 3) foot centres that MuJoCo sees from the trunk, m; joints addressed by name."""
    data = mujoco.MjData(scene.model)
    for leg, name in enumerate(("LF", "RF", "LH", "RH")):
        for k, joint in enumerate(("abduction", "hip", "knee")):
            data.joint(f"{ROBOT}{name}_{joint}").qpos = angles[leg, k]
    mujoco.mj_kinematics(scene.model, data)
    sites = [data.site(f"{ROBOT}{leg}_foot").xpos for leg in ("LF", "RF", "LH", "RH")]
    return np.asarray(sites) - data.body(f"{ROBOT}trunk").xpos


def test_forward_inverts_inverse_over_the_whole_reach(
    xp: types.ModuleType, any_robot: Robot
) -> None:
    heights = heights_of(any_robot)
    got = foot_heights(any_robot, joint_angles(any_robot, xp.asarray(heights)))
    np.testing.assert_allclose(got, heights, atol=1e-6)


def test_the_reach_ends_at_the_knee_limits(any_robot: Robot) -> None:
    knee = joint_angles(any_robot, heights_of(any_robot))[..., 2].ravel()
    assert (knee[0], knee[-1]) == pytest.approx((-2.72, -0.838))
    assert (np.diff(knee) > 0).all(), "longer legs have straighter knees"


def test_standing_angles_by_hand(xp: types.ModuleType, robot: Robot) -> None:
    """0.328 m between two links of 0.213 m: each leans acos(0.164 / 0.213) = 0.6920 rad."""
    angles = joint_angles(robot, xp.full(4, 0.35))
    np.testing.assert_allclose(angles, np.tile((0.0, 0.69203, -1.38406), (4, 1)), atol=1e-5)


def test_forward_kinematics_agree_with_mujoco(
    xp: types.ModuleType, scene: Scene, robot: Robot
) -> None:
    """Any angles, abduction to either side included."""
    rng = np.random.default_rng(0)
    for _ in range(20):
        angles = rng.uniform((-1.0, -0.5, -2.7), (1.0, 2.0, -0.9), (4, 3))
        below = -foot_sites(scene, angles)[:, 2] + robot.foot_radius
        got = foot_heights(robot, xp.asarray(angles))
        np.testing.assert_allclose(got, below, atol=1e-9 if xp is np else 1e-6)


def test_feet_move_straight_up_and_down_under_their_hips(robot: Robot, scene: Scene) -> None:
    corners = np.asarray([(0.193, 0.142), (0.193, -0.142), (-0.193, 0.142), (-0.193, -0.142)])
    for height in (0.30, 0.35, 0.40):
        feet = foot_sites(scene, joint_angles(robot, np.full(4, height)))
        np.testing.assert_allclose(feet[:, :2], corners, atol=1e-9)
        np.testing.assert_allclose(feet[:, 2], 0.022 - height, atol=1e-9)


def test_out_of_reach_is_a_straight_leg_and_a_number(xp: types.ModuleType, robot: Robot) -> None:
    """A straight leg of 0.426 m; a foot that is told to go further stays straight."""
    angles = joint_angles(robot, xp.asarray([0.6, 0.448, 0.35, 0.6]))
    np.testing.assert_allclose(np.asarray(angles)[[0, 1, 3]], 0.0, atol=2e-3)
    assert np.isfinite(angles).all()


@settings(deadline=None, max_examples=50)
@given(share=st.floats(0.001, 1.0), ratio=st.integers(1, 60), data=st.data())
def test_ramp_is_a_walk_of_equal_steps(share: float, ratio: int, data: st.DataObject) -> None:
    """Equal steps until the share of the decision is over, at least one step; then rest."""
    task = TaskConfig(sim_dt=0.01, ctrl_dt=0.01 * ratio, action_ramp=share)
    heights = st.lists(st.floats(0.2, 0.4), min_size=4, max_size=4)
    before, after = np.asarray(data.draw(heights)), np.asarray(data.draw(heights))
    moving = max(1, round(share * ratio))
    walk, at = [], before
    for k in range(ratio):
        at = at + (after - before) / moving if k < moving else after
        walk.append(at)
    got = ramp(task, before, after)
    np.testing.assert_allclose(got, walk, atol=1e-12)
    np.testing.assert_array_equal(got[moving - 1 :], np.tile(after, (ratio - moving + 1, 1)))


def test_late_legs_do_the_same_whole_steps_later(xp: types.ModuleType) -> None:
    """Each of a batch by its own delay; until then they stay where they were."""
    before, after = xp.full((3, 4), 0.30), xp.full((3, 4), 0.35)
    task = TaskConfig(action_ramp=0.4)
    at_once = np.asarray(ramp(task, before, after))
    late = np.asarray(ramp(task, before, after, xp.asarray([0.0, 1.0, 30.0])))
    for got, expected, delay in zip(late, at_once, (0, 1, 30), strict=True):
        np.testing.assert_allclose(got[:delay], 0.30, atol=1e-7)
        np.testing.assert_allclose(got[delay:], expected[: 50 - delay], atol=1e-7)
    assert late.dtype == at_once.dtype


def test_single_precision_stays_single(robot: Robot) -> None:
    """A float64 that slips in would double the memory of every env."""
    heights = np.full((3, 4), 0.35, np.float32)
    assert ramp(TaskConfig(), heights, heights).dtype == np.float32
    assert joint_angles(robot, heights).dtype == np.float32
    assert foot_heights(robot, joint_angles(robot, heights)).dtype == np.float32


def test_ramp_is_a_line_then_rest(xp: types.ModuleType) -> None:
    """0.4 of 50 physics steps: half way after 10, there after 20, exactly."""
    before, after = xp.asarray([0.30, 0.31, 0.32, 0.33]), xp.asarray([0.32, 0.31, 0.30, 0.36])
    batch = xp.stack((after, before)), xp.stack((before, after))
    back, got = np.asarray(ramp(TaskConfig(action_ramp=0.4), *batch))
    np.testing.assert_allclose(back, (before + after) - got, atol=1e-6)
    np.testing.assert_allclose(got[0], [0.301, 0.31, 0.319, 0.3315], atol=1e-6)
    np.testing.assert_allclose(got[9], [0.31, 0.31, 0.31, 0.345], atol=1e-6)
    assert not (got[18] == np.asarray(after)).all()
    assert (got[19:] == np.asarray(after)).all()
