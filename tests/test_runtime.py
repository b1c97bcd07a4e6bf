"""The runtime for a robot: decision for decision what the evaluation does, and safe."""

import ast
import dataclasses
import math
import re
import runpy
import shutil
import subprocess
import sys
import types
from collections.abc import Callable
from pathlib import Path
from typing import Any

import mujoco
import numpy as np
import pytest
import safetensors.numpy
from fixtures.policies import Manifest, Weights, random_policy, rewrite, with_head
from hypothesis import given
from hypothesis import strategies as st

from mjx_balance import runtime
from mjx_balance.config import Config, to_dict
from mjx_balance.errors import shorten
from mjx_balance.evaluation.rollout import observing, policy_scene, run_suite
from mjx_balance.evaluation.suites import draw_suite
from mjx_balance.policy.file import load_policy, save_policy
from mjx_balance.robots.catalogue import Robot, find_robot
from mjx_balance.runtime import ACCEL_MOST, GYRO_MOST, Controller, State
from mjx_balance.task import step, tilt
from mjx_balance.task.attitude import body_tilt
from mjx_balance.task.kinematics import joint_angles

REPO = Path(__file__).parent.parent
BEST = REPO / "policies/best.safetensors"
ANGLES_AGREE = 1e-12
"""rad. Both sides compute in float64, from the same float32 tables and in the same order; what may
differ is the last bits of NumPy's arccos, arctan2 and cos over arrays of other lengths: some 1e-15
of 3 rad. Actions must be equal. The network is float32, and its sums over one observation and over
a batch differ by up to 2e-5 of a level; no decision of these tests is so near to the border of two
levels (3e-4 at the least)."""
OFF_GRID_AGREE = 2e-7
"""rad. There a command has that error, 2e-5 of a level: 6e-9 m. Each of 30 decisions adds its own,
and a leg turns by some 5 rad per m."""


class Rig:
    """A controller and its sensors: every call is one sample period later."""

    def __init__(self, path: Path = BEST):
        self.now = 100.0
        self.controller = Controller(path, lambda: self.now)
        self.standing = self.controller.targets
        self.rng = np.random.default_rng(0)

    def step(
        self,
        joints: np.ndarray | None = None,
        gyro: Any = None,
        accel: Any = None,
        after: float | None = None,
    ) -> np.ndarray:
        """One call with noisy readings of a robot that rolls on its legs, or with those given."""
        noise = self.rng.normal(size=6)
        self.now += self.controller.sample_dt if after is None else after
        return self.controller.step(
            self.controller.targets if joints is None else joints,
            np.array([0.05, -0.02, 0.0]) + 0.002 * noise[:3] if gyro is None else gyro,
            np.array([0.3, 0.5, 9.8]) + 0.02 * noise[3:] if accel is None else accel,
        )

    def steps(self, count: int) -> np.ndarray:
        """The targets of as many calls, (count, legs, 3)."""
        return np.asarray([self.step() for _ in range(count)])


@pytest.fixture
def rig() -> Rig:
    """The shipped policy with a clock of its own."""
    return Rig()


@pytest.mark.parametrize(
    "suite", ["corner", "noise", "push", "latency", "bias", "encoder", "dropout", "continuous"]
)
def test_it_does_what_the_evaluation_does_step_by_step(
    suite: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """On the evaluation's own samples and joint angles, which may err; and off the grid."""
    action, agree, path = "grid", ANGLES_AGREE, tmp_path / "p"
    if suite == "continuous":
        action, agree, suite = suite, OFF_GRID_AGREE, "push"
    policy = load_policy(BEST).with_action(action)
    save_policy(path, safetensors.numpy.load_file(BEST), policy.manifest)
    scene = policy_scene(policy)
    count, decisions, samples = 3, 30, scene.task.sim_steps
    imu, chosen, joints = [], [], []

    def controller(view: Any) -> np.ndarray:
        imu.append(view.imu)
        chosen.append(policy(view.obs))
        return observing(policy)(view)

    def pre_step(*args: Any) -> Any:
        memory, targets = original(*args)
        joints.append(targets.joints)
        return memory, targets

    original = step.pre_step
    monkeypatch.setattr(step, "pre_step", pre_step)
    rollout = run_suite(scene, controller, suite, count, decisions * 0.2, 7, record=True)
    assert not rollout.fell.any()
    assert rollout.qpos is not None
    errors = draw_suite(scene.task, scene.robot, suite, count, decisions * 0.2, 7).errors
    taken: set[int | None] = set()
    for k in range(count):
        readings = np.concatenate([x[k] for x in imu])[samples - 1 :]
        angles = np.concatenate((scene.stance.qpos[None], rollout.qpos[k]))[:, scene.leg_qpos]
        angles = angles if errors is None else angles + errors.encoders[k] + errors.readings[k]
        rig = Rig(path)
        targets, actions = [], []
        for reading, angle in zip(readings, angles, strict=False):
            targets.append(rig.step(angle, reading[:3], reading[3:]))
            actions.append(rig.controller.action)
        assert rig.controller.state is State.BALANCING
        assert actions[::samples] == [int(x[k]) for x in chosen]
        taken |= set(actions)
        expected = np.concatenate([x[k] for x in joints])
        if suite == "latency":  # each action acts a decision later, which the robot cannot know
            targets, expected = targets[:-samples], expected[samples:]
        expected = expected[: len(targets)]
        np.testing.assert_allclose(targets, expected, rtol=0, atol=agree)
        assert len(targets) > (decisions - 2) * samples
    assert len(taken) >= 6, "a policy that always does the same shows little"


LAYOUTS: dict[str, tuple[str, dict[str, Any]]] = {
    "joint": ("joint", {}),
    "factored": ("factored", {"command_lags": (0, 3), "action_ramp": 1.0}),
    "radial": ("radial", {"gyro_lags": (0, 120), "accel_lags": (7, 3), "imu_mean": 4}),
    "levels": ("factored", {"action_levels": 5, "command_lags": (1,), "action_max": 0.02}),
    "rates": ("radial", {"ctrl_dt": 0.05, "sim_dt": 0.005, "action_ramp": 0.01, "imu_mean": 2}),
    "off the grid": ("radial", {"action": "continuous", "command_lags": (0, 1)}),
    "long memory": ("radial", {"mean_times": (0.5, 30.0), "filter_times": (4.0, 0.3)}),
    "every sample": ("radial", {"ctrl_dt": 0.004, "action_ramp": 0.5}),
}


@pytest.fixture(scope="session")
def other_robot(robot: Robot, bodies: Any) -> Robot:
    """Legs of all kinds: other lengths, signs and zeros, knees forward, hips below the trunk."""
    changes: list[dict[str, Any]] = [
        {"signs": (1.0, -1.0, 1.0), "zeros": (0.1, -0.7, 0.3), "drop": 0.04},
        {"knee": (0.8, 2.7), "thigh": 0.19, "calf": 0.22, "axis_height": 0.02},
        {"signs": (-1.0, 1.0, -1.0), "offset": 0.06, "drop": -0.01},
        {"zeros": (0.0, 0.5, -1.0), "offset": -0.05, "calf": 0.2},
    ]
    legs = (bodies.with_legs(robot, **change).legs[k] for k, change in enumerate(changes))
    return dataclasses.replace(robot, legs=tuple(legs), foot_radius=0.03)


@pytest.mark.parametrize("layout", LAYOUTS)
@pytest.mark.parametrize("legs", ["ours", "others"])
def test_it_is_the_tasks_decision_for_any_layout_and_legs(
    layout: str, legs: str, tmp_path: Path, config: Config, other_robot: Robot
) -> None:
    """Random samples and joint angles, through `task/step.py` and through the runtime."""
    head, changes = LAYOUTS[layout]
    config = with_head(config, head, body_height=0.33, **changes)
    policy = random_policy(tmp_path / "p", config)
    task, robot = config.task, find_robot(config.robot)
    if legs == "others":
        robot = other_robot
        rewrite(tmp_path / "p", lambda w, m: m.update(robot=to_dict(robot)))
    rig = Rig(tmp_path / "p")
    rng, agree = np.random.default_rng(1), ANGLES_AGREE
    if task.action == "continuous":
        agree = OFF_GRID_AGREE
    standing = joint_angles(robot, np.full(4, task.body_height))
    level = tilt.Scenario(np.zeros((1, 2)), np.zeros(()), np.asarray(task.board_rate))
    still = np.array([0, 0, 0, 0, 0, 9.81])
    np.testing.assert_allclose(rig.standing, standing, rtol=0, atol=ANGLES_AGREE)
    memory = step.initial_memory(task, robot, still)
    angles, sample = standing, still
    obs = step.observation(task, robot, memory, angles)
    actions = []
    for number in range(24):
        actions.append(int(policy(obs)))
        state = step.EnvState(None, memory, level, np.asarray(number), None, None)
        memory, targets = step.pre_step(task, robot, state, policy.command(obs))
        samples = still + rng.normal(0, (0.02, 0.02, 0.02, 0.2, 0.2, 0.2), (task.sim_steps, 6))
        for k in range(task.sim_steps):
            got = rig.step(angles, sample[:3], sample[3:])
            np.testing.assert_allclose(got, targets.joints[k], rtol=0, atol=agree)
            assert rig.controller.action == actions[-1]
            command = np.asarray(rig.controller.command)
            np.testing.assert_allclose(command, policy.command(obs), rtol=0, atol=1e-8)
            angles, sample = got + rng.normal(0, 0.03, got.shape), samples[k]
        tilts = np.zeros(task.sim_steps)
        motion = step.Motion(samples, tilts, angles[None])
        memory, outcome = step.post_step(task, robot, memory, motion)
        obs = outcome.obs
    assert rig.controller.state is State.BALANCING
    assert len(set(actions)) > 4


@pytest.mark.parametrize("scale", [1e-6, 1e5, 1e6])
@pytest.mark.parametrize("field", ["height_scale", "gyro_scale", "accel_scale"])
def test_it_runs_whatever_scale_a_config_may_have(
    tmp_path: Path, config: Config, field: str, scale: float
) -> None:
    """Which float32 rounds to below its bound."""
    random_policy(tmp_path / "p", with_head(config, "radial", **{field: scale}))
    Rig(tmp_path / "p").steps(51)


def test_legs_are_held_within_their_reach(tmp_path: Path, config: Config, robot: Robot) -> None:
    """Roll by 10 cm per decision: the left legs end at their longest, the right at shortest."""
    config = with_head(config, "joint", action_max=0.1)
    random_policy(tmp_path / "p", config)
    last = config.task.num_actions - 1

    def edit(weights: Weights, manifest: Manifest) -> None:
        weights["head/kernel"][:] = 0
        weights["head/bias"][:] = np.arange(441) == last - 10  # a_x greatest, a_y 0

    rewrite(tmp_path / "p", edit)
    rig = Rig(tmp_path / "p")
    targets = rig.steps(400)[-1]
    low, high = robot.height_range
    expected = joint_angles(robot, np.where(robot.each("left"), high, low))
    np.testing.assert_allclose(targets, expected, rtol=0, atol=1e-9)


def test_states_on_the_way(rig: Rig) -> None:
    controller = rig.controller
    assert (controller.state, controller.reason, controller.action) == (State.STANDING, "", None)
    assert controller.joints[1] == ["RF_abduction", "RF_hip", "RF_knee"]
    assert (controller.sample_dt, controller.decision_samples) == (0.004, 50)
    rig.step()
    assert controller.state is State.BALANCING
    assert controller.state == "balancing"
    controller.hold("the button was pressed")
    controller.hold("something else")
    assert (controller.state, controller.reason) == (State.HOLDING, "the button was pressed")


def test_reset_forgets_everything(rig: Rig) -> None:
    """The same readings after it give the same targets as a new controller's."""
    first = rig.steps(220)
    rig.controller.hold("enough")
    rig.controller.reset()
    assert (rig.controller.state, rig.controller.reason) == (State.STANDING, "")
    assert rig.controller.action is rig.controller.command is None
    np.testing.assert_array_equal(rig.controller.targets, rig.standing)
    rig.rng = np.random.default_rng(0)
    rig.now += 1000.0
    np.testing.assert_array_equal(rig.steps(220), first)


def test_returned_arrays_are_the_callers(rig: Rig) -> None:
    """Adding a trim in place changes nothing inside."""
    expected = Rig().steps(60)
    for k in range(60):
        targets = rig.step()
        np.testing.assert_array_equal(targets, expected[k])
        targets += 1.0
    rig.controller.targets[:] = 0
    rig.controller.hold("a look")
    np.testing.assert_array_equal(rig.step(), expected[-1])


JOINTS = Rig().standing


def bent(value: float) -> np.ndarray:
    """Angles of a robot that stands but for one knee."""
    joints = JOINTS.copy()
    joints[2, 2] = value
    return joints


@pytest.mark.parametrize(
    ("reading", "reason"),
    [
        ({"joints": bent(math.nan)}, "LH_knee reads nan, which is not between"),
        ({"joints": bent(-0.6)}, r"LH_knee reads -0.6, which is not between -2.82 and -0.738"),
        ({"joints": bent(-3.0)}, "LH_knee reads -3"),
        ({"joints": JOINTS + np.array([4.0, 0, 0])}, "LF_abduction reads 4, .* -3.14 and 3.14"),
        ({"gyro": [0, math.nan, 0]}, "gyro y reads nan"),
        ({"gyro": [0, 0, math.inf]}, "gyro z reads inf"),
        ({"gyro": [-GYRO_MOST - 0.1, 0, 0]}, "gyro x reads -35.1, .* -35 and 35"),
        ({"accel": [0, 0, ACCEL_MOST + 1]}, "accelerometer z reads 161, .* -160 and 160"),
        ({"accel": [-math.inf, 0, 9.81]}, "accelerometer x reads -inf"),
        ({"after": 0.021}, r"a sample came 0.021 s after .* within 0.02 s"),
        ({"after": -0.004}, r"a sample came -0.004 s after"),
        ({"after": math.nan}, "the clock gives no time: it gives nan s"),
        ({"after": math.inf}, "the clock gives no time: it gives inf s"),
    ],
)
@pytest.mark.parametrize("at", [52, 100])
def test_what_cannot_be_makes_it_hold(
    rig: Rig, reading: dict[str, Any], reason: str, at: int
) -> None:
    """In the middle of a ramp, and when a decision is due: the last targets stay, for good."""
    last = rig.steps(at)[-1]
    action = rig.controller.action
    np.testing.assert_array_equal(rig.step(**reading), last)
    assert rig.controller.state is State.HOLDING
    assert re.search(reason, rig.controller.reason)
    first = rig.controller.reason
    for targets in rig.steps(120):
        np.testing.assert_array_equal(targets, last)
    assert (rig.controller.reason, rig.controller.action) == (first, action)


HELD = {
    "upside down": ({"accel": [0, 0, -9.81]}, "accelerometer leans by 180 deg"),
    "on its side": ({"accel": [0, 9.81, 0]}, "accelerometer leans by 90 deg .* more than 40"),
    "slipping": ({"accel": [-6.94, 0, 6.94]}, "accelerometer leans by 45 deg"),
    "in free fall": ({"accel": [0, 0.1, 0]}, r"accelerometer gives 0.1\d* m/s\^2 in the mean"),
    "in g": ({"accel": [0, 0, 1]}, r"accelerometer gives 1 m/s\^2 .* it must be 4.91 to 14.7"),
    "too heavy": ({"accel": [0, 0, 15]}, "accelerometer gives 15 m"),
    "in deg/s": ({"gyro": [3.5, 0, 0]}, "gyro gives 3.5 rad/s about x and y .* more than 1.05"),
    "tumbling": ({"gyro": [0, -1.2, 0]}, "gyro gives 1.2 rad/s"),
    "a slack hip": ({"joints": JOINTS + np.eye(4)[:, 2:3] * [0, 0.9, 0]}, r"LH_hip is 0\.\d+ rad"),
}


def feed(rig: Rig, count: int, reading: dict[str, Any]) -> None:
    """So many samples of a reading, each a little different."""
    for k in range(count):
        shaken = {name: np.add(value, 1e-4 * (k % 3)) for name, value in reading.items()}
        rig.step(**shaken)


@pytest.mark.parametrize(("reading", "reason"), HELD.values(), ids=HELD)
def test_who_balances_no_more_holds_at_a_decision(
    rig: Rig, reading: dict[str, Any], reason: str
) -> None:
    """Each sample is one that a sensor can give; a whole decision of them is not."""
    rig.steps(101)
    feed(rig, 49, reading)
    assert rig.controller.state is State.BALANCING
    feed(rig, 1, reading)
    assert rig.controller.state is State.HOLDING
    assert re.search(reason, rig.controller.reason)


@pytest.mark.parametrize(
    ("reading", "reason"),
    [*HELD.values(), ({"accel": [0, 0, math.nan]}, "accelerometer z reads nan")],
    ids=[*HELD, "no number"],
)
def test_who_does_not_stand_does_not_begin(rig: Rig, reading: dict[str, Any], reason: str) -> None:
    np.testing.assert_array_equal(rig.step(**reading), rig.standing)
    assert rig.controller.state is State.HOLDING
    assert rig.controller.action is None
    assert re.search(reason, rig.controller.reason)


@pytest.mark.parametrize(
    ("at", "count", "reading"),
    [
        (101, 50, {"accel": [0, 5.6, 8]}),  # 35 deg
        (101, 50, {"accel": [0, 0, 5.0]}),
        (101, 50, {"accel": [0, 0, 14.6]}),
        (101, 50, {"gyro": [0.7, -0.7, 3.0]}),  # 0.99 rad/s; yaw does not count
        (150, 1, {"gyro": [GYRO_MOST - 1, 0, 0], "accel": [0, 1 - ACCEL_MOST, 0]}),
        (60, 1, {"gyro": [GYRO_MOST, 0, 0], "accel": [0, -ACCEL_MOST, 0]}),
        (60, 1, {"joints": bent(-0.75)}),
        (60, 1, {"after": 0.0199}),
        (60, 1, {"after": 0.0}),
    ],
    ids=str,
)
def test_a_push_or_one_wild_sample_is_no_fall(
    rig: Rig, at: int, count: int, reading: dict[str, Any]
) -> None:
    """Not even the last sample before a decision."""
    rig.steps(at)
    feed(rig, count, reading)
    rig.steps(20)
    assert rig.controller.state is State.BALANCING


@pytest.mark.parametrize(
    ("after", "holds"),
    [(0.005, True), (0.0045, True), (0.00435, False), (0.0037, False), (0.002, True)],
)
def test_samples_at_another_rate_make_it_hold(rig: Rig, after: float, holds: bool) -> None:
    """200 Hz, 222 Hz and 500 Hz instead of 250: noticed when the next decision is due."""
    for _ in range(50):
        rig.step(after=after)
    assert rig.controller.state is State.BALANCING
    for _ in range(101):
        rig.step(after=after)
    assert (rig.controller.state is State.HOLDING) == holds
    if holds:
        assert f"50 samples took {50 * after:.3g} s; they must take 0.2 s" in rig.controller.reason


def fed(rig: Rig, count: int, readings: Callable[[int], dict[str, Any]]) -> None:
    """So many samples, of what `readings` gives in place of new ones."""
    for k in range(count):
        rig.step(**readings(k))


def imu(k: int) -> dict[str, Any]:
    """The k-th sample of an IMU, unlike all others."""
    return {"gyro": np.array([0.05, 0.001 * k, 0]), "accel": np.array([0.3, 0.5, 9.8 - 0.001 * k])}


def one(sensor: str, k: int) -> dict[str, Any]:
    return {sensor: imu(k)[sensor]}


STALE: dict[str, tuple[Callable[[int], dict[str, Any]], str]] = {
    "dead": (lambda k: imu(0), "the IMU .*: 1 of its last 50 samples are new; at least 17 must be"),
    "dead but for one": (lambda k: imu(k // 40), "the IMU .*: 2 of its last 50"),
    "5 Hz": (lambda k: imu(k // 50), "the IMU .*: [12] of its last 50"),
    "10 Hz": (lambda k: imu(k // 25), "the IMU .*: [23] of its last 50"),
    "50 Hz": (lambda k: imu(k // 5), "the IMU .*: 1[01] of its last 50"),
    "eight old samples again and again": (lambda k: imu(k % 8), "the IMU .*: 8 of its last 50"),
    "two that take turns": (lambda k: imu(k % 2), "the IMU .*: 2 of its last 50"),
    "a dead gyro": (lambda k: one("gyro", 0), "the gyro .*: 1 of its .*; at least 10 must be"),
    "a gyro of 10 Hz": (lambda k: one("gyro", k // 25), "the gyro .*: [23] of its"),
    "a dead accelerometer": (lambda k: one("accel", 0), "the accelerometer .*: 1 of its"),
    "an accelerometer of 25 Hz": (lambda k: one("accel", k // 10), "the accelerometer .*: [56] of"),
}


@pytest.mark.parametrize(("readings", "reason"), STALE.values(), ids=STALE)
@pytest.mark.parametrize("before", [0, 101, 130])
def test_old_samples_make_it_hold_at_a_decision(
    rig: Rig, readings: Callable[[int], dict[str, Any]], reason: str, before: int
) -> None:
    """From the first sample on, after a decision, and in the middle of one: within 0.4 s."""
    rig.steps(before)
    fed(rig, 101, readings)
    assert rig.controller.state is State.HOLDING
    assert re.match(reason, rig.controller.reason)


@pytest.mark.parametrize(("gap", "latest", "holds"), [(20, 0, True), (12, 4, True), (11, 5, False)])
def test_a_gap_before_every_decision_makes_it_hold(
    rig: Rig, gap: int, latest: int, holds: bool
) -> None:
    """Three fifths of the samples are new; with such a gap of 20 the robot leans by 5 deg."""
    rig.steps(101)
    fed(rig, 50, lambda k: imu(min(k, 49 - gap)))
    assert rig.controller.state is State.BALANCING
    fed(rig, 50, lambda k: imu(50 + min(k, 49 - gap)))
    assert (rig.controller.state is State.HOLDING) == holds
    wanted = f"at two decisions, one after the other, {latest} of its last 16 samples are new; at"
    assert (wanted in rig.controller.reason) == holds


LIVELY: dict[str, Callable[[int], dict[str, Any]]] = {
    "125 Hz": lambda k: imu(k // 2),
    "100 Hz": lambda k: imu(2 * k // 5),
    "every tenth sample repeated": lambda k: imu(k - (k % 10 == 9)),
    "nothing new for 80 ms now and then": lambda k: imu(k - max(0, k % 100 - 79)),
    "a quiet gyro of few values": lambda k: {"gyro": np.array([0.05, 0.001 * (k * k % 7 % 3), 0])},
    "an accelerometer of 83 Hz": lambda k: one("accel", k // 3),
    "bursts that end with a decision": lambda k: imu(k // 50 * 50 + max(k % 50, 25)),
}


@pytest.mark.parametrize("readings", LIVELY.values(), ids=LIVELY)
def test_some_repeated_samples_are_no_dead_imu(
    rig: Rig, readings: Callable[[int], dict[str, Any]]
) -> None:
    fed(rig, 401, readings)
    assert rig.controller.state is State.BALANCING


@pytest.mark.parametrize("bias", [0.0, 0.0001])
def test_a_coarse_gyro_of_a_robot_that_is_still_is_not_dead(rig: Rig, bias: float) -> None:
    """Of 2,000 deg/s in 16 bits, with noise of a fifth of a step: few of its samples are new."""
    step, new, last = math.radians(2000 / 2**15), [], np.zeros(3)
    for k in range(501):
        gyro = np.round(rig.rng.normal(bias, step / 5, 3) / step) * step
        if k % 50 == 1:
            new.append(0)
        if k:
            new[-1] += not np.array_equal(gyro, last)
        last = gyro
        rig.step(gyro=gyro, accel=rig.rng.normal((0, 0, 9.81), 0.02))
    assert min(new) < 10
    assert rig.controller.state is State.BALANCING, rig.controller.reason
    fed(rig, 101, lambda k: {"gyro": last})  # it moves: the accelerometer leans
    assert rig.controller.reason.startswith("the gyro repeats itself: ")


@pytest.mark.parametrize("samples", [10, 25, 50, 100])
def test_a_dead_gyro_makes_it_hold_whatever_a_decision_lasts(
    tmp_path: Path, config: Config, samples: int
) -> None:
    """Joints that move 0.02 rad in 50 samples, at the beginning of each decision."""
    random_policy(tmp_path / "p", with_head(config, "radial", ctrl_dt=samples * 0.004))
    rig = Rig(tmp_path / "p")
    for k in range(401):
        pose = np.full((4, 3), 0.02 * (k // samples) * samples / 50 % 0.1)
        rig.step(joints=rig.standing + pose, gyro=[0.01, 0, 0])
    assert rig.controller.reason.startswith("the gyro repeats itself: 1 of its last ")


@pytest.mark.parametrize("rate", [10, 25, 50])
def test_it_holds_long_before_a_slow_imu_lets_the_robot_fall(rate: int) -> None:
    """On the board whose corners sink: with samples of 10 Hz it would lean by 7 deg."""
    policy = load_policy(BEST)
    scene = policy_scene(policy)
    model, stance = scene.model, scene.stance
    data = mujoco.MjData(model)
    data.qpos, data.qacc_warmstart = stance.qpos, stance.qacc_warmstart
    boards = draw_suite(scene.task, scene.robot, "corner", 1, 5.0, seed=0).scenario
    controller, sample = Controller(BEST, lambda: data.time), stance.imu
    for k in range(1250):
        if controller.state is State.HOLDING:
            break
        if k and k % (250 // rate) == 0:
            sample = data.sensordata[scene.imu].copy()
        targets = controller.step(data.qpos[scene.leg_qpos], sample[:3], sample[3:])
        data.ctrl[scene.leg_ctrl] = targets + stance.leg_trim
        board = tilt.board_angle(scene.task, boards, np.array([[data.time + scene.task.sim_dt]]))
        data.ctrl[scene.board_ctrl] = np.radians(board[0, 0])
        mujoco.mj_step(model, data)
        assert body_tilt(data.qpos[scene.trunk_quat]) < 1.5
    assert controller.reason.startswith("the IMU repeats itself: ")


@pytest.mark.parametrize("joint", [(2, 2), (1, 1)])
def test_a_joint_whose_reading_stays_while_its_target_moves_makes_it_hold(
    tmp_path: Path, config: Config, joint: tuple[int, int]
) -> None:
    """The left hind leg shrinks by 6 mm per decision, the right front one grows as fast."""
    config = with_head(config, "joint", action_max=0.003)
    random_policy(tmp_path / "p", config)

    def edit(weights: Weights, manifest: Manifest) -> None:
        weights["head/kernel"][:] = 0
        weights["head/bias"][:] = np.arange(441) == 20  # a_x least, a_y greatest

    rewrite(tmp_path / "p", edit)
    rig = Rig(tmp_path / "p")
    leg, index = joint
    for _ in range(500):
        joints = rig.controller.targets
        joints[joint] = rig.standing[joint]
        rig.step(joints=joints)
    name = rig.controller.joints[leg][index]
    assert re.match(f"{name} reads .* all the time, .* moved by 0.1", rig.controller.reason)
    moved = np.abs(rig.controller.targets[joint] - rig.standing[joint])
    assert 0.1 < moved < 0.2


def test_short_decisions_bear_a_repeated_sample(tmp_path: Path, config: Config) -> None:
    """With a decision per sample, ten samples count, not one decision's."""
    random_policy(tmp_path / "p", with_head(config, "radial", ctrl_dt=0.004, action_ramp=0.5))
    rig = Rig(tmp_path / "p")
    rig.steps(20)
    fed(rig, 5, lambda k: imu(0))
    rig.steps(10)
    assert rig.controller.state is State.BALANCING
    fed(rig, 10, lambda k: imu(0))
    assert rig.controller.reason.startswith("the IMU repeats itself: 2 of its last 10 samples")


def test_a_network_that_gives_no_numbers_makes_it_hold(tmp_path: Path, config: Config) -> None:
    random_policy(tmp_path / "p", with_head(config, "radial"))
    rewrite(tmp_path / "p", lambda w, m: w["hidden_0/kernel"].fill(3e38))
    rig = Rig(tmp_path / "p")
    np.testing.assert_array_equal(rig.step(), rig.standing)
    assert rig.controller.reason == "the network gives values that are not finite numbers"


@pytest.mark.parametrize(
    "arguments",
    [
        (np.zeros(12), np.zeros(3), np.zeros(3)),
        (np.zeros((3, 4)), np.zeros(3), np.zeros(3)),
        (JOINTS, np.zeros(6), np.zeros(3)),
        (JOINTS, np.zeros(3), 9.81),
    ],
)
def test_arguments_of_another_shape_are_refused(rig: Rig, arguments: tuple[Any, ...]) -> None:
    with pytest.raises(ValueError, match=r"they must be \(4, 3\), \(3,\) and \(3,\)"):
        rig.controller.step(*arguments)
    rig.step()
    assert rig.controller.state is State.BALANCING


SHORT = {
    "two": [0, 0],
    "none": [],
    "scalar": 9.81,
    "four": [0, 0, 9.81, 0],
    "column": [[0], [0], [9]],
}


@pytest.mark.parametrize("value", SHORT.values(), ids=SHORT)
@pytest.mark.parametrize("argument", range(3))
def test_a_short_packet_after_a_good_one_makes_it_hold(rig: Rig, argument: int, value: Any) -> None:
    """At the first sample the program is wrong, later a driver is."""
    last = rig.steps(60)[-1]
    readings: list[Any] = [JOINTS, np.zeros(3), np.array([0, 0, 9.81])]
    readings[argument] = value
    for _ in range(2):
        np.testing.assert_array_equal(rig.controller.step(*readings), last)
    assert rig.controller.state is State.HOLDING
    assert re.match(r"joint_positions, gyro and .* must be \(4, 3\), ", rig.controller.reason)
    rig.controller.reset()
    with pytest.raises(ValueError, match="have shapes"):
        rig.controller.step(*readings)


@pytest.mark.parametrize("sign", [-1, 1])
def test_the_greatest_outputs_choose_the_last_level_without_a_warning(
    tmp_path: Path, config: Config, sign: int
) -> None:
    """Of float32; the level, 20 times that over 2, would be none any more. Found by fuzzing."""
    random_policy(tmp_path / "p", with_head(config, "radial"))

    def edit(weights: Weights, manifest: Manifest) -> None:
        weights["head/kernel"][:] = 0
        weights["head/bias"][:] = sign * 3.4e38

    rewrite(tmp_path / "p", edit)
    rig = Rig(tmp_path / "p")
    rig.step()
    assert rig.controller.action == (440 if sign > 0 else 0)


NO_NUMBERS = {
    "none": None,
    "dict": {},
    "text": "standing",
    "set": {1.0, 2.0},
    "one text": [0, "x", 9.81],
    "numbers as text": ["0", "0", "9.81"],
    "numbers as bytes": [b"0", b"0", b"9.81"],
    "complex": np.array([0, 0, 9.81 + 1j]),
    "times": np.array([0, 0, 9], "m8[s]"),
    "one dict": [0, {}, 9.81],
    "great": 10**400,
    "one great": [10**400, 0, 0],
    "ragged": [[0, 1], [2]],
    "object": object(),
}


@pytest.mark.parametrize("value", NO_NUMBERS.values(), ids=NO_NUMBERS)
@pytest.mark.parametrize("argument", range(3))
def test_readings_that_are_no_numbers_make_it_hold(rig: Rig, argument: int, value: Any) -> None:
    """As a driver gives that has lost its sensor: the servos get the last targets, no exception."""
    last = rig.steps(60)[-1]
    readings: list[Any] = [JOINTS, np.zeros(3), np.array([0, 0, 9.81])]
    name, readings[argument] = ("joint_positions", "gyro", "accelerometer")[argument], value
    np.testing.assert_array_equal(rig.controller.step(*readings), last)
    kind = type(value).__name__
    assert rig.controller.reason == f"{name} is a value of type {kind}; it must be numbers"
    np.testing.assert_array_equal(rig.step(), last)


def raises() -> float:
    raise RuntimeError("no\x1b[2J clock")


@pytest.mark.parametrize(
    "clock",
    [raises, lambda: None, lambda: "noon", lambda: 10**400, lambda: math.nan, lambda: -math.inf],
)
def test_a_clock_that_gives_no_time_makes_it_hold(clock: Callable[[], Any]) -> None:
    controller = Controller(BEST, clock)
    standing = controller.targets
    np.testing.assert_array_equal(
        controller.step(standing, np.zeros(3), np.array([0, 0, 9.81])), standing
    )
    assert controller.state is State.HOLDING
    assert controller.reason.startswith("the clock gives no time: ")
    assert controller.reason.isprintable()


def test_the_reason_is_one_short_line_whatever_it_quotes(rig: Rig) -> None:
    rig.controller.hold("\x1b]0;title\x07 stop\n" + 10**5 * "x" + " pressed")
    assert rig.controller.reason.startswith("?]0;title? stop xxx")
    assert rig.controller.reason.endswith("xxx pressed")
    assert len(rig.controller.reason) == 300


@given(text=st.text(), limit=st.integers(10, 300))
def test_the_runtimes_copy_cleans_text_as_the_package_does(text: str, limit: int) -> None:
    tail = limit // 3
    assert runtime._line(text, limit) == shorten(text, limit, tail)


def test_python_3_8_would_read_it() -> None:
    """Its syntax, and of what came later the two that tempt; seen at work on 3.8 by hand."""
    tree = ast.parse(Path(runtime.__file__).read_text(), feature_version=(3, 8))
    newer = {getattr(node, name, None) for node in ast.walk(tree) for name in ("arg", "attr")}
    assert not newer & {"strict", "StrEnum"}
    futures = [node.names[0].name for node in tree.body if isinstance(node, ast.ImportFrom)]
    assert futures[0] == "annotations"


ALONE = """
import sys
sys.path[:0] = [sys.argv[1]]
sys.path.append(sys.argv[2])
import numpy as np
before = set(sys.modules)
from runtime import Controller
now = iter(0.004 * np.arange(1000))
controller = Controller(sys.argv[1] + "/p.safetensors", lambda: next(now))
standing = controller.targets
for k in range(120):
    targets = controller.step(standing, [0.05, 0.001 * k, 0], [0.3, 0.5, 9.8 - 0.001 * k])
strangers = {name.split(".")[0] for name in set(sys.modules) - before}
print(sorted(strangers - set(sys.stdlib_module_names) - {"numpy", "runtime"}))
print(controller.state, controller.action, *targets.ravel())
"""


def test_the_file_alone_runs_the_shipped_policy(tmp_path: Path, rig: Rig) -> None:
    """A folder with two files, and a Python that finds nothing but itself and NumPy."""
    shutil.copy(runtime.__file__, tmp_path / "runtime.py")
    shutil.copy(BEST, tmp_path / "p.safetensors")
    numpy_at = str(Path(np.__file__).resolve().parents[1])
    command = [sys.executable, "-I", "-S", "-W", "error", "-c", ALONE, str(tmp_path), numpy_at]
    run = subprocess.run(command, capture_output=True, text=True, timeout=60, check=False)
    assert run.returncode == 0, run.stderr
    strangers, output = run.stdout.splitlines()
    assert strangers == "[]"
    expected = np.empty(0)
    for k in range(120):
        expected = rig.step(rig.standing, [0.05, 0.001 * k, 0], [0.3, 0.5, 9.8 - 0.001 * k])
    state, action, *targets = output.split()
    assert (state, int(action)) == ("balancing", rig.controller.action)
    np.testing.assert_array_equal(np.asarray(targets, float), expected.ravel())


def example(*arguments: str) -> subprocess.CompletedProcess[str]:
    command = [sys.executable, str(REPO / "examples/deploy.py"), *arguments]
    return subprocess.run(command, capture_output=True, text=True, timeout=120, cwd=REPO)


def test_the_example_balances_as_the_evaluation_does() -> None:
    """In its own loop over plain MuJoCo, for 20 s: the same mean and greatest tilt."""
    policy = load_policy(BEST)
    tilt = run_suite(policy_scene(policy), observing(policy), "corner", 1, 20.0, 0).tilt
    expected = f"mean tilt {tilt.mean():.3f} deg, greatest {tilt.max():.3f} deg in 20 s\n"
    run = example("best")
    assert (run.returncode, run.stdout) == (0, expected), run.stderr


def test_the_examples_servos_obey_as_late_as_the_robots(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    """Spot's, after 4 ms. For 4 s: dry friction amplifies the last bits later."""
    policy = load_policy("spot")
    assert policy.robot.command_delay == 0.004
    tilt = run_suite(policy_scene(policy), observing(policy), "corner", 1, 4.0, 0).tilt
    main = runpy.run_path(str(REPO / "examples/deploy.py"))["main"]
    monkeypatch.setitem(main.__globals__, "SECONDS", 4.0)
    monkeypatch.setitem(main.__globals__, "__doc__", "Spot.")
    monkeypatch.setattr(sys, "argv", ["deploy.py", "spot"])
    main()
    mean, greatest = map(float, re.findall(r"[\d.]+(?= deg)", capsys.readouterr().out))
    assert (mean, greatest) == pytest.approx((tilt.mean(), tilt.max()), abs=6e-4)


def test_the_examples_servos_obey_after_their_delay(monkeypatch: pytest.MonkeyPatch) -> None:
    """Spot's: a physics step. Until then they hold the standing pose, as in the evaluation."""
    example = runpy.run_path(str(REPO / "examples/deploy.py"))
    monkeypatch.setattr(sys, "argv", ["deploy.py", "spot"])
    commands, targets, step = [], [], Controller.step

    def mj_step(model: Any, data: Any) -> None:
        commands.append(data.ctrl.copy())
        mujoco.mj_step(model, data)

    def record(self: Controller, *sensors: Any) -> np.ndarray:
        targets.append(self.targets)
        return step(self, *sensors)

    monkeypatch.setattr(Controller, "step", record)
    physics = types.SimpleNamespace(MjData=mujoco.MjData, mj_step=mj_step)
    example["main"].__globals__.update(SECONDS=0.02, mujoco=physics)
    example["main"]()
    scene = policy_scene(load_policy("spot"))
    # The targets before a call are those of the last one, and at first the standing pose.
    expected = [x + scene.stance.leg_trim for x in targets]
    np.testing.assert_array_equal([x[scene.leg_ctrl] for x in commands], expected)
    assert np.ptp(targets, axis=0).max() > 0


def test_the_example_says_what_it_needs() -> None:
    run = example("nobody")
    assert (run.returncode, run.stdout) == (2, "")
    assert run.stderr.startswith("usage: deploy.py [-h] [--robot ROBOT] policy\n")
    assert "error: no policy file at nobody;" in run.stderr


@pytest.mark.slow
def test_the_example_takes_a_robot_that_is_not_shipped(tmp_path: Path) -> None:
    """Which a policy cannot name: here Spot, with its shipped policy under another robot's name."""
    path = str(tmp_path / "p.safetensors")
    shutil.copy(REPO / "policies/robots/spot.safetensors", path)
    rewrite(Path(path), lambda w, m: m["config"].update(robot="elsewhere.toml"))
    run = example(path)
    assert (run.returncode, run.stdout) == (2, "")
    assert "deploy.py: error: the policy's robot is 'elsewhere.toml'; " in run.stderr
    assert "with --robot" in run.stderr
    run = example(path, "--robot", "spot")
    assert run.returncode == 0, run.stderr
    assert run.stdout.startswith("mean tilt 0.")
