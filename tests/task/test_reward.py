"""Body tilt, failure and the reward's terms, by hand."""

import types

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.spatial.transform import Rotation

from mjx_balance.config import TaskConfig
from mjx_balance.task.attitude import body_tilt, roll_pitch
from mjx_balance.task.reward import RewardInputs, failed, reward_rows, reward_terms

TASK = TaskConfig()
PAPER = ("level", "toward", "fail")


def quaternion(axis: tuple[float, float, float], angle: float) -> np.ndarray:
    """(4,) of a turn by `angle` deg about a unit axis."""
    return Rotation.from_rotvec(np.radians(angle) * np.asarray(axis)).as_quat(scalar_first=True)


QUATERNIONS = (
    st.tuples(*[st.floats(-1, 1)] * 4)
    .map(np.asarray)
    .filter(lambda q: np.linalg.norm(q) > 0.1)
    .map(lambda q: q / np.linalg.norm(q))
)


@settings(deadline=None, max_examples=200)
@given(quat=QUATERNIONS)
def test_tilt_of_any_orientation(quat: np.ndarray) -> None:
    """The angle of the turned z axis, by another library; a quaternion and its negative alike."""
    z = Rotation.from_quat(quat, scalar_first=True).apply((0, 0, 1))
    angle = np.degrees(np.arctan2(np.hypot(z[0], z[1]), z[2]))
    assert body_tilt(quat) == pytest.approx(angle, abs=1e-5)
    assert body_tilt(-quat) == pytest.approx(angle, abs=1e-5)


def test_tilt_near_the_upright_is_good_to_a_ten_thousandth_in_float32(xp: types.ModuleType) -> None:
    """Body leaning by 0 to 0.1 deg, whatever its heading; an arccosine is off by 0.02 deg."""
    rng = np.random.default_rng(0)
    lean = np.linspace(0, 0.1, 50)
    turn = Rotation.from_euler("ZX", np.stack((rng.uniform(-180, 180, 50), lean), -1), degrees=True)
    quat = turn.as_quat(scalar_first=True).astype(np.float32)
    np.testing.assert_allclose(body_tilt(xp.asarray(quat)), lean, atol=1e-4)
    lean = np.asarray([1.0, 6.0, 90.0, 179.0])
    quat = Rotation.from_euler("y", lean[:, None], degrees=True).as_quat(scalar_first=True)
    np.testing.assert_allclose(body_tilt(xp.asarray(quat, "float32")), lean, rtol=1e-4)


@settings(deadline=None, max_examples=200)
@given(yaw=st.floats(-180, 180), pitch=st.floats(-89, 89), roll=st.floats(-179.9, 179.9))
def test_roll_and_pitch_of_any_orientation(yaw: float, pitch: float, roll: float) -> None:
    """Yaw, then pitch about the turned y axis, then roll about the twice turned x axis."""
    turn = Rotation.from_euler("ZYX", (yaw, pitch, roll), degrees=True)
    got = roll_pitch(turn.as_quat(scalar_first=True))
    np.testing.assert_allclose(got, (roll, pitch), atol=1e-5)


def test_roll_and_pitch_of_a_batch_and_of_a_nose_dive() -> None:
    """Leaning right is positive roll, nose down positive pitch; 90 deg of it is still a number."""
    turns = ((1, 0, 0), 3.0), ((0, 1, 0), 4.0), ((0, 1, 0), 90.0)
    quat = np.stack([quaternion(*turn) for turn in turns])
    quat[2] *= 1 + 1e-9
    roll, pitch = roll_pitch(quat[None])
    np.testing.assert_allclose(roll[0, :2], (3, 0), atol=1e-9)
    np.testing.assert_allclose(pitch[0], (0, 4, 90), atol=1e-9)


def test_failure_is_beyond_6_deg_or_no_number(xp: types.ModuleType) -> None:
    tilts = xp.asarray([0.0, 6.0, 6.0001, 90.0, np.nan, np.inf])
    assert failed(TASK, tilts).tolist() == [False, False, True, True, True, True]
    assert failed(TaskConfig(fail_tilt=3.0), xp.asarray([2.9, 3.1])).tolist() == [False, True]
    assert failed(TASK, body_tilt(xp.asarray([[np.nan] * 4, [1.0, 0, 0, 0]]))).tolist() == [1, 0]


BY_HAND = {
    # Tilt before, after, fall -> level, toward, fail.
    (0.0, 0.0, 0.0): (0.4, 0.0, 0.0),
    (1.0, 1.0, 0.0): (0.0892521, 0.0, 0.0),  # 0.4 exp(-1.5)
    (6.0, 6.0, 0.0): (4.93639e-5, 0.0, 0.0),
    (1.0, 0.5, 0.0): (0.188947, 0.2, 0.0),  # 0.4 per degree toward the horizontal
    (0.5, 1.0, 0.0): (0.0892521, -0.2, 0.0),
    (5.0, 2.0, 0.0): (0.0199148, 0.4, 0.0),  # no more than 0.4 either way
    (0.0, 2.0, 1.0): (0.0199148, -0.4, -0.5),
}


def test_the_papers_rewards_by_hand(xp: types.ModuleType) -> None:
    """Eq. 4, Fig. 5, and half a point for a fall."""
    terms = reward_terms(TASK, RewardInputs(*xp.asarray(list(BY_HAND)).T))
    got = np.stack([terms[name] for name in PAPER], axis=-1)
    np.testing.assert_allclose(got, list(BY_HAND.values()), rtol=1e-5)


def test_every_constant_is_the_configs() -> None:
    """2 deg after 3.5: 0.7 e^(-0.3 * 2) = 0.384168; 0.6 * 1.5 / 2 = 0.45; a fall 0.9."""
    task = TaskConfig(
        reward_level=0.7,
        reward_sharpness=0.3,
        reward_toward=0.6,
        reward_toward_scale=2.0,
        reward_fail=-0.9,
    )
    terms = reward_terms(task, RewardInputs(*map(np.asarray, (3.5, 2.0, 1.0))))
    np.testing.assert_allclose([terms[name] for name in PAPER], (0.384168, 0.45, -0.9), atol=1e-6)
    assert {row.name: row.weight for row in reward_rows(task)}["toward"] == 0.6
