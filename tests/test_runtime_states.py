"""The runtime's states: standing up, faults and what follows, gains, other sensors, the log."""

import json
import math
import re
import shutil
from collections.abc import Callable
from pathlib import Path
from typing import Any

import mujoco
import numpy as np
import pytest
import safetensors.numpy
from fixtures.policies import rewrite
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.spatial.transform import Rotation

from mjx_balance.cli import main
from mjx_balance.evaluation.rollout import policy_scene
from mjx_balance.policy.file import find_policy, load_policy, read_policy
from mjx_balance.policy.manifest import PolicyError, make_manifest
from mjx_balance.robots.catalogue import find_robot
from mjx_balance.runtime import (
    KNEE_SLACK,
    LYING_SLACK,
    RESPONSES,
    Controller,
    Fault,
    PolicyFileError,
    State,
)
from mjx_balance.sim.scene import build_model
from mjx_balance.task.attitude import body_tilt
from mjx_balance.task.kinematics import joint_angles

REPO = Path(__file__).parent.parent
BEST, REAL = REPO / "policies/best.safetensors", REPO / "policies/real.safetensors"
ROBOT = find_robot("quadruped")
CROUCH = joint_angles(ROBOT, np.full(4, 0.2))
STIFFNESS, DAMPING = 400.0, 16.0  #: of our robot, scenes/quadruped.xml


class Rig:
    """A controller, and a robot whose joints are at their targets."""

    def __init__(self, path: Path = BEST, **options: Any):
        self.now = 0.0
        options = {"gains": True} | options
        self.controller = Controller(path, lambda: self.now, **options)
        self.rng, self.joints = np.random.default_rng(0), CROUCH

    def step(self, count: int = 1, after: float = 0.004, **readings: Any) -> np.ndarray:
        """Calls with noisy readings of a robot at rest, or with those given; the last targets."""
        for _ in range(count):
            imu = self.rng.normal((0, 0, 0, 0, 0, 9.81), (*[0.002] * 3, *[0.02] * 3))
            self.now += after
            sensors = {"joint_positions": self.joints, "gyro": imu[:3], "accelerometer": imu[3:]}
            targets = self.controller.step(**(sensors | readings))
            if self.controller.state is not State.PASSIVE:
                self.joints = targets
        return self.controller.targets

    def stand(self) -> list[tuple[np.ndarray, Any, Any]]:
        """Targets, stiffness and torque of every sample until it balances."""
        self.step()
        self.controller.stand()
        samples = []
        while self.controller.state is not State.BALANCING:
            samples.append((self.step(), self.controller.stiffness, self.controller.torque))
            assert self.controller.state in (State.STANDING_UP, State.BALANCING)
            assert len(samples) < 5_000
        return samples


@pytest.fixture
def rig() -> Rig:
    """The shipped policy, PASSIVE."""
    return Rig()


@pytest.fixture
def trimmed(tmp_path: Path) -> Path:
    """The shipped policy, whose trim was lost and measured again."""
    path = tmp_path / "p.safetensors"
    shutil.copy(BEST, path)
    rewrite(path, lambda w, m: m.pop("leg_trim_rad"))
    assert Controller(path).torque is None
    assert main(["export", str(path), "--trim", "--out", str(path)]) == 0
    return path


def test_a_passive_controller_only_looks(rig: Rig) -> None:
    controller = rig.controller
    assert (controller.state, controller.reason) == (State.PASSIVE, "")
    np.testing.assert_array_equal(np.asarray(controller.stiffness), np.zeros((4, 3)))
    np.testing.assert_array_equal(np.asarray(controller.damping), np.zeros((4, 3)))
    np.testing.assert_array_equal(rig.step(), CROUCH)
    rig.step(after=7.0)
    rig.step(gyro=[math.nan, 0, 0])
    assert (controller.state, controller.fault) == (State.PASSIVE, Fault.NONE)
    assert controller.reason.startswith("gyro x reads nan")
    rig.step(gyro=[0])
    assert "have shapes" in controller.reason
    rig.step()
    assert controller.reason == ""


def test_it_stands_up_smoothly_and_then_balances(rig: Rig) -> None:
    """Stiffness in a second, then feet that stay under the hips, then the policy."""
    samples = rig.stand()
    path = np.stack([CROUCH, *(targets for targets, _, _ in samples)])
    stiffness = np.stack([stiffness for _, stiffness, _ in samples])
    np.testing.assert_allclose(stiffness[[0, 125, 250, -1], 0, 0], (0, 200, 400, 400))
    assert (np.diff(stiffness, axis=0) >= 0).all()
    np.testing.assert_array_equal(path[:252], np.broadcast_to(CROUCH, (252, 4, 3)))
    assert np.abs(np.diff(path, axis=0)).max() <= 1.0 * 0.004 + 1e-12
    assert np.abs(np.diff(path, 2, axis=0)).max() < 10 * 0.004**2, "rad/s^2"
    up = next(k for k, targets in enumerate(path) if np.ptp(targets - path[-2]) < 1e-9)
    hip, knee = path[:up, :, 1], path[:up, :, 2]
    thigh, calf = ROBOT.each("thigh"), ROBOT.each("calf")
    assert np.abs(thigh * np.sin(hip) + calf * np.sin(hip + knee)).max() < 1e-9, "m"
    standing = joint_angles(ROBOT, np.full(4, 0.35))
    np.testing.assert_allclose(path[-2], standing, atol=1e-12)
    np.testing.assert_array_equal(np.asarray(rig.controller.damping), np.full((4, 3), DAMPING))
    # From 0.2 to 0.35 m knees turn by the change of 2 acos(l / 2a); 15/8 of that at 1 rad/s.
    turns = [2 * math.acos((h - ROBOT.foot_radius) / 2 / ROBOT.legs[0].thigh) for h in (0.2, 0.35)]
    seconds = 15 / 8 * (turns[0] - turns[1])
    assert up == pytest.approx((1 + 0.5 + seconds) / 0.004, abs=3), "the fold has no way: 0.5 s"
    assert len(samples) <= up + 100
    assert rig.controller.action is not None


@settings(max_examples=10, deadline=None)
@given(shares=st.lists(st.floats(0, 1), min_size=12, max_size=12))
def test_it_stands_up_from_any_pose_without_a_jump(shares: list[float]) -> None:
    """Of all that the joints can read: never beyond their range nor faster than 1 rad/s."""
    rig = Rig()
    low, high = rig.controller.model.legs.limits()
    beyond = np.tile((0.0, 0.0, LYING_SLACK - KNEE_SLACK), 4)
    rig.joints = (low - beyond + np.asarray(shares) * (high - low + 2 * beyond)).reshape(4, 3)
    first = np.clip(rig.joints, low.reshape(4, 3), high.reshape(4, 3))
    path = np.stack([first, *(targets for targets, _, _ in rig.stand())])
    assert np.abs(np.diff(path, axis=0)).max() <= 0.004 + 1e-12
    assert (path >= low.reshape(4, 3) - 1e-9).all()
    assert (path <= high.reshape(4, 3) + 1e-9).all()
    np.testing.assert_allclose(path[-2], joint_angles(ROBOT, np.full(4, 0.35)), atol=1e-12)


@pytest.mark.parametrize("end", [0, 1])
def test_it_stands_up_with_knees_that_press_on_their_stops(end: int, rig: Rig) -> None:
    """They read 0.25 rad beyond their range, and all the time the same until the legs pull."""
    controller = rig.controller
    lying, stops = CROUCH.copy(), ROBOT.legs[0].knee[end]
    lying[:, 2] = stops + (0.25 if end else -0.25)
    rig.joints = lying
    rig.step()
    assert controller.reason == ""
    np.testing.assert_allclose(controller.targets[:, 2], stops + (0.1 if end else -0.1))
    controller.stand()
    for _ in range(300):
        rig.step(joint_positions=lying)
    rig.step(2500)
    assert controller.state is State.BALANCING, controller.reason
    beyond = rig.joints.copy()
    beyond[2, 2] = stops + (0.11 if end else -0.11)
    rig.step(joint_positions=beyond)
    assert (controller.state, controller.fault) == (State.HOLDING, Fault.READING)


def test_knees_that_read_more_than_a_stop_allows_do_not_stand_up(rig: Rig) -> None:
    controller, wrong = rig.controller, CROUCH.copy()
    wrong[1, 2] = ROBOT.legs[1].knee[0] - 0.31
    rig.step(joint_positions=wrong)
    assert re.match("RF_knee reads .*, which is not between", controller.reason)
    np.testing.assert_array_equal(controller.targets, joint_angles(ROBOT, np.full(4, 0.35)))
    controller.stand()
    rig.step(joint_positions=wrong)
    assert (controller.state, controller.fault) == (State.HOLDING, Fault.READING)


def test_who_holds_with_a_knee_on_its_stop_still_notices_a_fall(rig: Rig) -> None:
    lying = CROUCH.copy()
    lying[3, 2] = ROBOT.legs[3].knee[0] - 0.25
    rig.controller.hold("it lies")
    rig.step(51, joint_positions=lying, accelerometer=[0, 9.81, 0])
    assert (rig.controller.state, rig.controller.fault) == (State.DAMPING, Fault.LEAN)


def test_it_waits_until_the_robot_is_still(rig: Rig) -> None:
    """Somebody shakes it: it balances 50 to 100 samples after the last reading above 0.1."""
    rig.step()
    rig.controller.stand()
    for k in range(1500):
        rig.step(gyro=[0, 0, 0.11 + 0.001 * (k % 7)] if k % 40 == 0 else [0.001 * (k % 9), 0, 0])
    assert rig.controller.state is State.STANDING_UP
    rig.step(49)
    assert rig.controller.state is State.STANDING_UP
    rig.step(51)
    assert rig.controller.state is State.BALANCING


def test_after_standing_up_it_decides_as_one_that_stood(tmp_path: Path) -> None:
    """Its first sample is the mean of the still ones: inputs with a long memory begin with that."""
    rig, imu = Rig(REAL), []

    def observe(*arguments: Any) -> None:
        imu.append(np.concatenate(arguments[1:]))

    rig.step()
    rig.controller.stand()
    while rig.controller.state is not State.BALANCING:
        sample = rig.rng.normal((0, 0, 0, 0, 0, 9.81), (*[0.002] * 3, *[0.02] * 3))
        observe(None, sample[:3], sample[3:])
        rig.step(gyro=sample[:3], accelerometer=sample[3:])
    mean = np.mean(imu[-50:], axis=0)
    standing = joint_angles(ROBOT, np.full(4, 0.35))
    other = Controller(REAL, lambda: rig.now)
    other.step(standing, mean[:3], mean[3:])
    np.testing.assert_allclose(
        np.asarray(rig.controller.command), np.asarray(other.command), atol=1e-12
    )
    for _ in range(120):
        sample = rig.rng.normal((0.01, 0, 0, 0, 0, 9.81), (*[0.002] * 3, *[0.02] * 3))
        rig.step(joint_positions=standing, gyro=sample[:3], accelerometer=sample[3:])
        expected = other.step(standing, sample[:3], sample[3:])
        np.testing.assert_allclose(rig.controller.targets, expected, rtol=0, atol=1e-12)


def test_stand_works_without_gains_too(rig: Rig) -> None:
    """Position servos: the same way, at full stiffness; and only before the first sample."""
    rig = Rig(gains=False)
    assert rig.controller.state is State.STANDING
    rig.controller.stand()
    rig.step()
    np.testing.assert_array_equal(rig.controller.targets, CROUCH)
    np.testing.assert_array_equal(np.asarray(rig.controller.stiffness), np.full((4, 3), STIFFNESS))
    rig.step(1500)
    assert rig.controller.state is State.BALANCING
    rig.controller.stand()
    assert rig.controller.state is State.BALANCING


@pytest.mark.parametrize(
    "readings",
    [
        {"quaternion": [0.7071, 0.7071, 0, 0]},
        {"quaternion": [0, 0, 0, 0]},
        {"accelerometer": [0, 9.81, 0]},
        {"gyro": [0, math.nan, 0]},
        {"torques": [1, 2]},
    ],
    ids=str,
)
def test_a_fault_at_the_first_sample_moves_no_leg(readings: dict[str, Any]) -> None:
    """Position servos, and a robot that lies: a target beyond its own pose would make it jump."""
    rig = Rig(gains=False)
    rig.controller.stand()
    np.testing.assert_array_equal(rig.step(**readings), CROUCH)
    assert rig.controller.state is State.HOLDING
    np.testing.assert_array_equal(rig.step(joint_positions=0.9 * CROUCH), CROUCH)


def test_a_clock_without_time_at_the_first_sample_moves_no_leg() -> None:
    controller = Controller(BEST, lambda: 1 / 0)
    controller.stand()
    targets = controller.step(CROUCH, np.zeros(3), np.asarray([0, 0, 9.81]))
    assert controller.fault is Fault.CLOCK
    np.testing.assert_array_equal(targets, CROUCH)


@pytest.mark.parametrize("act", ["hold", "damp"])
def test_a_button_before_the_first_sample_moves_no_leg(act: str) -> None:
    rig = Rig(gains=False)
    rig.controller.stand()
    getattr(rig.controller, act)("the button")
    np.testing.assert_array_equal(rig.step(), CROUCH)
    np.testing.assert_array_equal(rig.step(joint_positions=0.9 * CROUCH), CROUCH)


def test_a_joint_without_a_reading_at_first_waits_for_one() -> None:
    """All others stay where they are; it goes to its standing angle until it reads a number."""
    rig, expected = Rig(gains=False), CROUCH.copy()
    rig.controller.stand()
    expected[2, 1] = joint_angles(ROBOT, np.full(4, 0.35))[2, 1]
    first = np.where(expected == CROUCH, CROUCH, math.nan)
    np.testing.assert_array_equal(rig.step(joint_positions=first), expected)
    assert (rig.controller.state, rig.controller.fault) == (State.HOLDING, Fault.READING)
    np.testing.assert_array_equal(rig.step(joint_positions=CROUCH), CROUCH)
    np.testing.assert_array_equal(rig.step(joint_positions=expected), CROUCH)


def test_without_gains_a_first_sample_of_another_shape_is_refused() -> None:
    """Whether it stands or stands up: there are no targets that are safe."""
    for acts in ((), ("stand",)):
        rig = Rig(gains=False)
        for act in acts:
            getattr(rig.controller, act)()
        with pytest.raises(ValueError, match="have shapes"):
            rig.step(joint_positions=np.zeros(12))


def far(rig: Rig) -> np.ndarray:
    """Joints of which one is 0.6 rad from its target."""
    joints = rig.controller.targets
    joints[1, 1] += 0.6
    return joints


HOT = np.where(np.arange(12).reshape(4, 3) == 7, 81.0, 40.0)
STRAINED = np.where(np.arange(12).reshape(4, 3) == 5, -43.2, 0.0)
STRAINED_HIP = np.where(np.arange(12).reshape(4, 3) == 4, 22.6, 0.0)
FAULTS: dict[str, tuple[int, Callable[[Rig], dict[str, Any]], Fault, str]] = {
    "no number": (1, lambda r: {"gyro": [0, math.nan, 0]}, Fault.READING, "gyro y reads nan"),
    "short": (1, lambda r: {"gyro": [0, 0]}, Fault.READING, "have shapes"),
    "late": (1, lambda r: {"after": 0.021}, Fault.LATE, "a sample came 0.021 s after"),
    "slow": (50, lambda r: {"after": 0.005}, Fault.RATE, "50 samples took 0.2"),
    "dead": (
        *(50, lambda r: {"gyro": [0, 0, 0], "accelerometer": [0, 0, 9.81]}),
        *(Fault.STALE, "the IMU repeats itself"),
    ),
    "lifted": (50, lambda r: {"accelerometer": [0, 0, r.now]}, Fault.WEIGHT, "gives"),
    "on its side": (
        *(50, lambda r: {"accelerometer": [0.01 * r.now, 9.81, 0]}),
        *(Fault.LEAN, "leans by 90 deg"),
    ),
    "falling": (50, lambda r: {"gyro": [1.2, 0.001 * r.now, 0]}, Fault.TUMBLING, "1.2 rad/s"),
    "blocked": (50, lambda r: {"joint_positions": far(r)}, Fault.AWAY, "RF_hip is 0.6 rad from"),
    "upside down": (1, lambda r: {"quaternion": [0, 1, 0, 0]}, Fault.TILT, "tilted by 180 deg"),
    "no turn": (1, lambda r: {"quaternion": [0, 0, 0, 0]}, Fault.READING, "of norm 1"),
    "hot": (
        *(50, lambda r: {"temperatures": HOT}),
        *(Fault.TEMPERATURE, "temperatures of LH_hip are 81 deg C .*, more than 80"),
    ),
    "strained": (
        *(50, lambda r: {"torques": STRAINED}),
        *(Fault.TORQUE, r"torques of RF_knee are 43.2 N m .* more than 43.1"),
    ),
    "strained hip": (50, lambda r: {"torques": STRAINED_HIP}, Fault.TORQUE, "RF_hip .* than 22.5"),
    "no torque": (
        *(1, lambda r: {"torques": np.where(STRAINED, np.nan, 0.0)}),
        *(Fault.READING, "torques of RF_knee are nan; they must be finite"),
    ),
    "no end of heat": (
        *(1, lambda r: {"temperatures": np.where(STRAINED, np.inf, 0.0)}),
        *(Fault.READING, "temperatures of RF_knee are inf; they must be finite"),
    ),
    "two torques": (1, lambda r: {"torques": [1, 2]}, Fault.READING, r"\(2,\); it must be"),
}
DAMPS = {"lifted", "on its side", "falling", "blocked", "upside down", "hot", "strained"}
DAMPS |= {"strained hip"}


@pytest.mark.parametrize("gains", [True, False])
@pytest.mark.parametrize("name", FAULTS)
def test_a_fault_leads_to_its_state(name: str, gains: bool) -> None:
    """Who falls or strains a servo damps; who lacks knowledge holds; without gains all hold."""
    count, readings, fault, reason = FAULTS[name]
    rig = Rig(gains=gains, max_temperature=80.0)
    controller = rig.controller
    rig.joints = joint_angles(ROBOT, np.full(4, 0.35))
    if gains:
        rig.stand()
    else:
        rig.step()
    rig.step(50)
    last = controller.targets
    for _ in range(count):
        assert controller.state is State.BALANCING
        last = controller.targets
        rig.step(**readings(rig))
    damps = gains and name in DAMPS
    assert controller.state is (State.DAMPING if damps else State.HOLDING)
    assert controller.fault is fault
    assert re.search(reason, controller.reason), controller.reason
    np.testing.assert_array_equal(controller.targets, last)
    stiffness = 0.0 if damps else STIFFNESS
    np.testing.assert_array_equal(np.asarray(controller.stiffness), np.full((4, 3), stiffness))
    np.testing.assert_array_equal(np.asarray(controller.damping), np.full((4, 3), DAMPING))
    first = controller.reason
    rig.step(120)
    controller.stand()
    np.testing.assert_array_equal(rig.step(), last)
    assert controller.reason == first
    controller.reset()
    assert (controller.fault, controller.reason) == (Fault.NONE, "")
    assert controller.state is (State.PASSIVE if gains else State.STANDING)


def test_who_sets_no_limit_still_needs_temperatures_that_are_numbers(rig: Rig) -> None:
    """A broken thermometer is a reading, not heat: the robot holds and does not sink."""
    rig.stand()
    rig.step(60, temperatures=np.full((4, 3), 1e6))
    assert rig.controller.state is State.BALANCING
    rig.step(temperatures=np.full((4, 3), np.nan))
    assert (rig.controller.state, rig.controller.fault) == (State.HOLDING, Fault.READING)


def test_the_page_has_the_table_of_faults() -> None:
    rows = re.findall(
        r"^\| `(\w+)` \|[^|]*\| `(\w+)` \|", (REPO / "docs/deploy.md").read_text(), re.M
    )
    assert dict(rows) == {fault.name: RESPONSES[fault].name for fault in Fault if fault}


def test_who_holds_keeps_the_gains_and_still_notices_a_fall(rig: Rig) -> None:
    """In the middle of standing up: half of the stiffness stays half; then it falls over."""
    controller = rig.controller
    rig.step()
    controller.stand()
    rig.step(126)
    controller.hold("the button was pressed")
    half = np.full((4, 3), STIFFNESS / 2)
    rig.step(50)
    np.testing.assert_allclose(np.asarray(controller.stiffness), half)
    rig.step(20, accelerometer=[0, 9.81, 0])
    assert (controller.state, controller.fault) == (State.HOLDING, Fault.HELD)
    rig.step(30, accelerometer=[0, 9.81, 0])
    assert (controller.state, controller.fault) == (State.DAMPING, Fault.LEAN)
    controller.hold("again")
    assert controller.state is State.DAMPING
    np.testing.assert_array_equal(np.asarray(controller.stiffness), np.zeros((4, 3)))


@pytest.mark.parametrize(
    "bad",
    [
        {"joint_positions": np.full((4, 3), math.nan)},
        {"joint_positions": None},
        {"gyro": [0, 0, math.nan]},
        {"gyro": [0]},
        {"quaternion": [0, 0, 0, 0]},
        {"accelerometer": [0, 0, math.nan], "quaternion": [0.7071, 0.7071, 0, 0]},
        {"accelerometer": None, "quaternion": [0.7071, 0.7071, 0, 0]},
    ],
    ids=str,
)
def test_a_bad_reading_hides_no_fall_from_who_holds(bad: dict[str, Any], rig: Rig) -> None:
    """A cable breaks, and the robot holds. Then it lies on its side, as another sensor says."""
    rig.stand()
    first: dict[str, Any] = {"quaternion": [0, 0, 0, 0]} if "quaternion" in bad else bad
    side: dict[str, Any] = {"accelerometer": [0, 9.81, 0]}
    rig.step(**first)
    assert (rig.controller.state, rig.controller.fault) == (State.HOLDING, Fault.READING)
    rig.step(60, **first)
    assert rig.controller.state is State.HOLDING
    rig.step(101, **(side | bad))
    assert rig.controller.state is State.DAMPING
    assert rig.controller.fault is (Fault.TILT if "accelerometer" in bad else Fault.LEAN)


def test_impossible_accelerations_count_for_no_fall(rig: Rig) -> None:
    """One in two readings of an upright robot is upside down and beyond the sensor's range."""
    rig.controller.hold("a look")
    for k in range(200):
        rig.step(accelerometer=[0, 0, -161.0 if k % 2 else 9.81])
    assert rig.controller.state is State.HOLDING


def test_damp_and_hold_from_anywhere() -> None:
    for steps in (0, 1, 300, 2000):
        for gains in (True, False):
            rig = Rig(gains=gains)
            rig.controller.stand()
            rig.step(steps)
            rig.controller.damp("the button")
            expected = State.DAMPING if gains else State.HOLDING
            assert (rig.controller.state, rig.controller.reason) == (expected, "the button")
    rig.controller.reset()
    rig.controller.hold("passive")
    assert rig.controller.state is State.HOLDING


def test_a_robot_on_its_side_does_not_stand_up(rig: Rig) -> None:
    """At once; and one that is laid on its side on the way damps within a decision."""
    rig.step()
    rig.controller.stand()
    rig.step(accelerometer=[0, 9.81, 0])
    assert rig.controller.state is State.DAMPING
    rig.controller.reset()
    rig.joints = CROUCH
    rig.step()
    rig.controller.stand()
    rig.step(500)
    for k in range(100):
        rig.step(accelerometer=[0, 9.81, 0.001 * k])
    assert (rig.controller.state, rig.controller.fault) == (State.DAMPING, Fault.LEAN)


def test_who_tips_onto_its_feet_while_it_stands_up_does_not_fall(rig: Rig) -> None:
    """At the rate at which a balancing robot falls."""
    rig.step()
    rig.controller.stand()
    for k in range(300):
        rig.step(gyro=[1.2, 0, 0.001 * (k % 9)])
    assert rig.controller.state is State.STANDING_UP, rig.controller.reason


@given(
    axis=st.tuples(*[st.floats(-1, 1)] * 2).filter(lambda v: math.hypot(*v) > 0.1),
    tilt=st.floats(0, 180),
    yaw=st.floats(-180, 180),
    scale=st.floats(0.91, 1.09),
)
@settings(deadline=None, max_examples=50)
def test_the_quaternions_tilt_is_the_angle_from_upright(
    axis: tuple[float, float], tilt: float, yaw: float, scale: float
) -> None:
    """Whatever the heading: scipy turns by yaw about z, then by the tilt about a level axis."""
    if abs(tilt - 20) < 1e-6:
        return
    level = np.asarray((*axis, 0.0)) / math.hypot(*axis)
    turn = Rotation.from_rotvec(math.radians(tilt) * level) * Rotation.from_euler(
        "z", math.radians(yaw)
    )
    x, y, z, w = scale * turn.as_quat()
    rig = SHARED
    rig.controller.reset()
    rig.step(quaternion=(w, x, y, z), joint_positions=joint_angles(ROBOT, np.full(4, 0.35)))
    expected = Fault.TILT if tilt > 20 else Fault.NONE
    assert rig.controller.fault is expected, rig.controller.reason


SHARED = Rig(gains=False)


@pytest.mark.parametrize(("rate", "calls"), [(250.0, 1), (500.0, 2), (1000.0, 4)])
def test_faster_samples_are_averaged(rate: float, calls: int) -> None:
    """Samples whose means are those of 250 Hz give its targets; of the joints the last count."""
    slow, fast = Rig(gains=False), Rig(gains=False, sample_rate=rate)
    standing = joint_angles(ROBOT, np.full(4, 0.35))
    rng, before = np.random.default_rng(3), slow.controller.targets
    targets = before
    for k in range(160):
        imu = rng.normal((0.02, 0, 0, 0.1, 0, 9.81), (*[0.01] * 3, *[0.2] * 3))
        joints = standing + rng.normal(0, 0.01, (4, 3))
        slow.now += 0.004
        expected = slow.controller.step(joints, imu[:3], imu[3:])
        noise = rng.normal(0, 0.5, (calls, 6))
        noise -= noise.mean(axis=0)
        count = 1 if k == 0 else calls
        for part in range(count):
            fast.now += 1 / rate
            sample = imu + (noise[part] if count > 1 else 0)
            last = part == count - 1
            reading = joints if last else joints + 0.3
            targets = fast.controller.step(reading, sample[:3], sample[3:])
            if not last:
                np.testing.assert_array_equal(targets, before)
        before = targets
        np.testing.assert_allclose(targets, expected, rtol=0, atol=1e-12)
    assert fast.controller.state is State.BALANCING


@pytest.mark.parametrize("rate", [100.0, 333.0, 625.0, 0.0, -250.0, math.nan, 1e9])
def test_a_rate_that_is_no_multiple_is_refused(rate: float) -> None:
    with pytest.raises(ValueError, match=r"sample_rate is .* Hz; it must be a whole multiple of"):
        Rig(sample_rate=rate)


def test_the_torque_bears_the_robot(trimmed: Path) -> None:
    """As much as MuJoCo's servos give while the robot stands, to 1%."""
    scene = policy_scene(load_policy("best"))
    data = mujoco.MjData(scene.model)
    data.qpos, data.qacc_warmstart = scene.stance.qpos, scene.stance.qacc_warmstart
    controller = Controller(trimmed)
    data.ctrl[scene.leg_ctrl] = controller.targets + scene.stance.leg_trim
    mujoco.mj_step(scene.model, data)
    forces = data.actuator_force[scene.leg_ctrl]
    assert np.abs(forces).max() > 3
    np.testing.assert_allclose(
        np.asarray(controller.torque), forces, atol=0.01 * np.abs(forces).max()
    )
    shipped = np.asarray(Controller(BEST).torque)
    np.testing.assert_allclose(shipped, np.asarray(controller.torque))


def test_the_torque_comes_with_the_weight(trimmed: Path) -> None:
    """None while stiffness comes up, all when it stands, none when it damps."""
    rig = Rig(trimmed)
    torques = np.stack([torque for _, _, torque in rig.stand()])
    np.testing.assert_array_equal(torques[:375], np.zeros((375, 4, 3)))
    full = STIFFNESS * np.asarray(rig.controller.manifest["leg_trim_rad"])
    np.testing.assert_allclose(torques[-1], full)
    assert (np.diff(np.abs(torques), axis=0) >= -1e-12).all()
    rig.controller.damp("enough")
    np.testing.assert_array_equal(np.asarray(rig.controller.torque), np.zeros((4, 3)))


@pytest.mark.parametrize(
    ("trim", "reason"),
    [
        (np.zeros((4, 2)).tolist(), "leg_trim_rad"),
        (np.full((4, 3), 1.1).tolist(), "leg_trim_rad"),
        ([["x"] * 3] * 4, "leg_trim_rad|wrong type"),
        ([[math.nan] * 3] * 4, "leg_trim_rad"),
        ({}, "leg_trim_rad|wrong type"),
    ],
    ids=str,
)
def test_a_trim_that_cannot_be_is_refused(trimmed: Path, trim: Any, reason: str) -> None:
    rewrite(trimmed, lambda w, m: m.update(leg_trim_rad=trim))
    with pytest.raises(PolicyFileError, match=reason):
        Controller(trimmed)
    with pytest.raises(PolicyError, match="leg_trim_rad"):
        load_policy(trimmed)


def test_a_policy_without_gains_runs_without_them(tmp_path: Path) -> None:
    path = tmp_path / "p.safetensors"
    path.write_bytes(BEST.read_bytes())
    rewrite(path, lambda w, m: m["robot"].pop("servo_damping"))
    with pytest.raises(PolicyFileError, match="does not say the stiffness and damping"):
        Controller(path, gains=True)
    controller = Controller(path)
    assert controller.stiffness is controller.damping is controller.torque is None
    rewrite(path, lambda w, m: m["robot"].update(servo_damping=[1, -1, 1]))
    with pytest.raises(PolicyFileError, match="gains below 0"):
        Controller(path)


def test_a_manifest_has_the_trim_that_it_is_given(tmp_path: Path) -> None:
    """As training gives it; without, the manifest is as before."""
    config = load_policy("best").config
    trim = np.arange(12).reshape(4, 3) / 100
    with_trim = make_manifest(config, "0" * 16, {}, trim)
    assert json.loads(json.dumps(with_trim))["leg_trim_rad"][1] == [0.03, 0.04, 0.05]
    without = make_manifest(config, "0" * 16, {})
    assert with_trim.keys() - without.keys() == {"leg_trim_rad"}


class Lying:
    """A robot in MuJoCo whose trunk and legs collide with the board, too; gains as commanded."""

    def __init__(self, name: str, seed: int, tmp_path: Path):
        path = tmp_path / "p.safetensors"
        manifest, weights = read_policy(find_policy(name))
        policy = load_policy(name)
        scene = policy_scene(policy)
        manifest["leg_trim_rad"] = scene.stance.leg_trim.tolist()
        metadata = {"manifest": json.dumps(manifest)}
        safetensors.numpy.save_file(weights, path, metadata=metadata)
        self.model = model = build_model(scene.task, policy.config.robot, visual=True)
        robot, board = scene.robot, model.geom("board/board").id
        for geom in range(model.ngeom):
            body, shape = model.geom_bodyid[geom], model.geom(geom).name
            trunk = model.body(body).name == f"robot/{robot.trunk}"
            if trunk or "thigh" in shape or "shank" in shape:
                model.geom_contype[geom] = model.body_contype[body] = 1
        model.geom_conaffinity[board] = model.body_conaffinity[model.geom_bodyid[board]] = 1
        joints = [[model.joint(f"robot/{x}") for x in leg.joints] for leg in robot.legs]
        ids = [[joint.id for joint in leg] for leg in joints]
        self.servos = [[model.actuator(f"robot/{x}").id for x in leg.joints] for leg in robot.legs]
        self.qpos, self.dofs = model.jnt_qposadr[ids], model.jnt_dofadr[ids]
        self.scene, self.root = scene, scene.trunk_quat[0] - 3
        self.data, self.rng = mujoco.MjData(model), np.random.default_rng(seed)
        lowest = joint_angles(robot, np.full(4, robot.height_range[0] + 0.02))
        self.controller = Controller(path, lambda: self.data.time, gains=True)
        # A model may have no stops, as mini_cheetah's: the knees get those of its legs.
        low, high = np.reshape(self.controller.model.legs.limits(), (2, 4, 3))
        low[:, 2] += KNEE_SLACK
        high[:, 2] -= KNEE_SLACK
        for leg in range(4):
            model.jnt_range[ids[leg][2]] = low[leg, 2], high[leg, 2]
            model.jnt_limited[ids[leg][2]] = 1
        pose = lowest + self.rng.uniform(-1, 1, (4, 3)) * (0.3, 0.9, 0.6)
        self.data.qpos[self.qpos] = np.clip(pose, low + 0.02, high - 0.02)
        self.data.qpos[self.root + 2] = 0.3

    def run(self, seconds: float) -> None:
        controller, data, model = self.controller, self.data, self.model
        for _ in range(round(seconds / 0.004)):
            imu = data.sensordata[self.scene.imu] + self.rng.normal(0, (*[2e-3] * 3, *[0.02] * 3))
            targets = controller.step(data.qpos[self.qpos], imu[:3], imu[3:])
            model.actuator_gainprm[self.servos, 0] = controller.stiffness
            model.actuator_biasprm[self.servos, 1] = -np.asarray(controller.stiffness)
            passive = controller.state is State.PASSIVE  # gears have some friction
            model.dof_damping[self.dofs] = 1.0 if passive else controller.damping
            data.qfrc_applied[self.dofs] = controller.torque
            data.ctrl[self.servos] = targets
            mujoco.mj_step(model, data)

    @property
    def height(self) -> float:
        return float(self.data.qpos[self.root + 2])


LYING = (("go2", 5), ("spot", 8), ("mini_cheetah", 1))


@pytest.mark.parametrize(
    ("name", "seed"),
    [("real", 2), *(pytest.param(*x, marks=pytest.mark.slow) for x in LYING)],
)
def test_a_robot_that_lies_stands_up_in_mujoco(name: str, seed: int, tmp_path: Path) -> None:
    """It drops from 0.3 m on random legs, lies, stands up, balances, and sinks when it damps."""
    lying = Lying(name, seed, tmp_path)
    lying.run(2.0)
    height = lying.scene.task.body_height
    assert lying.height < 0.5 * height
    lying.controller.stand()
    lying.run(8.0)
    assert lying.controller.state is State.BALANCING, lying.controller.reason
    assert lying.height == pytest.approx(height, rel=0.02)
    assert body_tilt(lying.data.qpos[lying.scene.trunk_quat]) < 0.5
    lying.controller.damp("it is enough")
    lying.run(0.05)
    assert lying.height > 0.8 * height, "it does not drop"
    lying.run(6.0)
    assert lying.height < 0.5 * height
