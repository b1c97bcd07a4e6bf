"""Body tilt, failure and the three rewards of paper 3.2, by hand."""

import types

import jax.numpy as jnp
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.spatial.transform import Rotation

from mjx_balance.config import TaskConfig
from mjx_balance.task.attitude import body_tilt, roll_pitch
from mjx_balance.task.reward import failed, reward_terms

TASK = TaskConfig()


def rotation(axis: tuple[float, float, float], angle: float) -> np.ndarray:
    """(4,) quaternion of a turn of `angle` deg about a unit axis."""
    half = np.radians(angle) / 2
    return np.asarray([np.cos(half), *(np.sin(half) * np.asarray(axis))])


def product(p: np.ndarray, q: np.ndarray) -> np.ndarray:
    """(4,) quaternion of q followed by p."""
    w = p[0] * q[0] - p[1:] @ q[1:]
    return np.asarray([w, *(p[0] * q[1:] + q[0] * p[1:] + np.cross(p[1:], q[1:]))])


@pytest.mark.parametrize("angle", [0.0, 0.01, 1.0, 6.0, 90.0, 179.0])
@pytest.mark.parametrize("axis", [(1.0, 0.0, 0.0), (0.0, -1.0, 0.0), (0.6, 0.8, 0.0)])
def test_tilt_about_a_level_axis_is_its_angle_even_in_float32(
    xp: types.ModuleType, axis: tuple[float, float, float], angle: float
) -> None:
    quat = xp.asarray(rotation(axis, angle), dtype=xp.float32)
    assert float(body_tilt(quat)) == pytest.approx(angle, rel=1e-4, abs=1e-4)


@pytest.mark.parametrize("yaw", [0.0, 90.0, 200.0])
def test_turning_on_the_spot_is_no_tilt(yaw: float) -> None:
    turn = rotation((0, 0, 1), yaw)
    assert body_tilt(turn) == pytest.approx(0, abs=1e-6)
    for quat in (
        product(turn, rotation((1, 0, 0), 5.0)),
        product(rotation((1, 0, 0), 5.0), turn),
    ):
        assert body_tilt(quat) == pytest.approx(5.0)


def test_tilt_is_the_angle_between_the_z_axes() -> None:
    """3 deg of roll on 4 deg of pitch: acos(cos 3 cos 4) = 4.9985 deg, not 5 nor 7."""
    quat = product(rotation((0, 1, 0), 4.0), rotation((1, 0, 0), 3.0))
    assert body_tilt(quat) == pytest.approx(4.9985, abs=1e-4)


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


def test_tilt_near_the_upright_is_good_to_a_ten_thousandth_in_float32(
    xp: types.ModuleType,
) -> None:
    """Body leaning by 0 to 0.1 deg, whatever its heading; an arccosine is off by 0.02 deg."""
    rng = np.random.default_rng(0)
    lean = np.linspace(0, 0.1, 50)
    turn = Rotation.from_euler("ZX", np.stack((rng.uniform(-180, 180, 50), lean), -1), degrees=True)
    quat = turn.as_quat(scalar_first=True).astype(np.float32)
    np.testing.assert_allclose(body_tilt(xp.asarray(quat)), lean, atol=1e-4)


@settings(deadline=None, max_examples=200)
@given(
    yaw=st.floats(-180, 180),
    pitch=st.floats(-89, 89),
    roll=st.floats(-179.9, 179.9),
)
def test_roll_and_pitch_of_any_orientation(yaw: float, pitch: float, roll: float) -> None:
    """Yaw, then pitch about the turned y axis, then roll about the twice turned x axis."""
    turn = Rotation.from_euler("ZYX", (yaw, pitch, roll), degrees=True)
    got = roll_pitch(turn.as_quat(scalar_first=True))
    np.testing.assert_allclose(got, (roll, pitch), atol=1e-5)


def test_roll_and_pitch_of_a_batch_and_of_a_nose_dive() -> None:
    """Leaning right is positive roll, nose down positive pitch; 90 deg of it is still a number."""
    quat = np.stack([rotation((1, 0, 0), 3.0), rotation((0, 1, 0), 4.0), rotation((0, 1, 0), 90)])
    quat[2] *= 1 + 1e-9
    roll, pitch = roll_pitch(quat[None])
    np.testing.assert_allclose(roll[0, :2], (3, 0), atol=1e-9)
    np.testing.assert_allclose(pitch[0], (0, 4, 90), atol=1e-9)


@pytest.mark.parametrize(
    ("tilt", "fell"),
    [(0.0, False), (6.0, False), (6.0001, True), (90.0, True), (np.nan, True), (np.inf, True)],
)
def test_failure_is_beyond_6_deg_or_no_number(
    xp: types.ModuleType, tilt: float, fell: bool
) -> None:
    assert bool(failed(TASK, xp.asarray(tilt))) is fell


def test_a_broken_orientation_is_a_failure(xp: types.ModuleType) -> None:
    assert failed(TASK, body_tilt(xp.asarray([[np.nan] * 4, [1.0, 0, 0, 0]]))).tolist() == [1, 0]


@pytest.mark.parametrize(
    ("tilt", "reward"), [(0.0, 0.4), (1.0, 0.0892521), (6.0, 4.93639e-5), (2.0, 0.0199148)]
)
def test_level_reward_by_hand(xp: types.ModuleType, tilt: float, reward: float) -> None:
    """Eq. 4: 0.4 exp(-1.5 tilt)."""
    terms = reward_terms(TASK, xp.asarray(tilt), xp.asarray(tilt), xp.asarray(0.0))
    assert float(terms["level"]) == pytest.approx(reward, rel=1e-5)
    assert float(terms["toward"]) == float(terms["fail"]) == 0


@pytest.mark.parametrize(
    ("before", "after", "reward"),
    [(1.0, 0.5, 0.2), (0.5, 1.0, -0.2), (5.0, 1.0, 0.4), (0.0, 3.0, -0.4), (2.0, 1.0, 0.4)],
)
def test_toward_reward_by_hand(
    xp: types.ModuleType, before: float, after: float, reward: float
) -> None:
    """Fig. 5: 0.4 per degree toward the horizontal, no more than 0.4 either way."""
    terms = reward_terms(TASK, xp.asarray(before), xp.asarray(after), xp.asarray(0.0))
    assert float(terms["toward"]) == pytest.approx(reward)


def test_every_constant_is_the_configs() -> None:
    """2 deg after 3.5: 0.7 e^(-0.3 * 2) = 0.384168; 0.6 * 1.5 / 2 = 0.45; a fall 0.9."""
    task = TaskConfig(
        reward_level=0.7,
        reward_sharpness=0.3,
        reward_toward=0.6,
        reward_toward_scale=2.0,
        reward_fail=-0.9,
        fail_tilt=3.0,
    )
    terms = reward_terms(task, np.asarray(3.5), np.asarray(2.0), np.asarray(1.0))
    assert list(terms) == ["level", "toward", "fail"]
    got = [float(value) for value in terms.values()]
    np.testing.assert_allclose(got, (0.384168, 0.45, -0.9), atol=1e-6)
    assert failed(task, np.asarray([2.9, 3.0, 3.1])).tolist() == [False, False, True]


def test_toward_reward_has_its_own_weight_and_scale() -> None:
    task = TaskConfig(reward_toward=0.3, reward_toward_scale=2.0)
    terms = reward_terms(task, np.asarray([1.0, 9.0]), np.asarray([0.0, 0.0]), np.zeros(2))
    np.testing.assert_allclose(terms["toward"], [0.15, 0.3])


def test_a_fall_costs_half(xp: types.ModuleType) -> None:
    tilt, fell = xp.asarray([7.0, 1.0]), xp.asarray([1.0, 0.0])
    terms = reward_terms(TASK, tilt, tilt, fell)
    assert terms["fail"].tolist() == [-0.5, 0.0]


def test_numpy_and_jax_agree() -> None:
    rng = np.random.default_rng(0)
    before, after = rng.uniform(0, 8, (2, 100))
    fell = (after > 6).astype(float)
    ours = reward_terms(TASK, before, after, fell)
    theirs = reward_terms(TASK, jnp.asarray(before), jnp.asarray(after), jnp.asarray(fell))
    for name, value in ours.items():
        np.testing.assert_allclose(theirs[name], value, atol=1e-6)
