"""The runtime for a robot: decision for decision what the evaluation does, and safe."""

import ast
import contextlib
import dataclasses
import math
import os
import re
import shutil
import subprocess
import sys
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from fixtures.policies import (
    Edit,
    Manifest,
    Weights,
    random_params,
    random_policy,
    rewrite,
    spoiled,
    with_head,
)
from hypothesis import given, settings
from hypothesis import strategies as st

from mjx_balance import runtime
from mjx_balance.config import Config, to_dict
from mjx_balance.evaluation.rollout import observing, policy_scene, run_suite
from mjx_balance.policy.file import load_policy, save_policy
from mjx_balance.policy.manifest import make_manifest
from mjx_balance.robots.catalogue import Robot, find_robot
from mjx_balance.runtime import ACCEL_MOST, GYRO_MOST, Controller, PolicyFileError, State
from mjx_balance.sim.scene import Scene
from mjx_balance.task import step, tilt
from mjx_balance.task.kinematics import joint_angles
from mjx_balance.task.observation import observation_names

REPO = Path(__file__).parent.parent
BEST = REPO / "policies/best.safetensors"
ANGLES_AGREE = 1e-12
"""rad. Both sides compute in float64, from the same float32 tables and in the same order; what may
differ is the last bits of NumPy's arccos, arctan2 and cos over arrays of other lengths: some 1e-15
of 3 rad. Actions must be equal. The network is float32, and its sums over one observation and over
a batch differ by up to 2e-5 of a level; no decision of these tests is so near to the border of two
levels (3e-4 at the least)."""


class Clock:
    """A time that the test moves."""

    def __init__(self) -> None:
        self.now = 100.0

    def __call__(self) -> float:
        return self.now


class Rig:
    """A controller and its sensors: every call is one sample period later."""

    def __init__(self, path: Path = BEST):
        self.clock = Clock()
        self.controller = Controller(path, self.clock)
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
        self.clock.now += self.controller.sample_dt if after is None else after
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


def stander(path: Path, config: Config, scene: Scene) -> Path:
    """A policy of `config` that takes back tilt and rate, and a little of everything at random."""
    params = random_params(config)["params"]
    params["head"]["kernel"] *= 0.05
    params["head"]["bias"] *= 0.0
    names = observation_names(config.task, scene.robot)
    level = np.radians(1.0) / config.task.action_max  # per deg and m of half-track
    for name, output, gain in (
        ("Acc_y,t-0", 1, -0.5 * scene.robot.half_track),
        ("V_x,t-0", 1, -0.2 * scene.robot.half_track),
        ("Acc_x,t-0", 2, -0.5 * scene.robot.half_length),
        ("V_y,t-0", 2, 0.2 * scene.robot.half_length),
    ):
        row = config.dqn.hidden_sizes[-1] + names.index(name)
        params["head"]["kernel"][row, output] += gain * level
    save_policy(path, {"params": params}, make_manifest(config, scene.hash, {}))
    return path


@pytest.fixture(scope="module")
def paths(
    tmp_path_factory: pytest.TempPathFactory, config: Config, scene: Scene
) -> dict[str, Path]:
    """Policies of two layouts: means over 0.6 s and commands; 16 samples (preset `default`)."""
    default = stander(tmp_path_factory.mktemp("default") / "p", config, scene)
    return {"best": BEST, "default": default}


@pytest.fixture(scope="module")
def scenes(paths: dict[str, Path]) -> dict[str, Scene]:
    """What they were trained in."""
    return {name: policy_scene(load_policy(path)) for name, path in paths.items()}


@pytest.mark.parametrize("suite", ["corner", "noise", "push", "latency"])
@pytest.mark.parametrize("name", ["best", "default"])
def test_it_does_what_the_evaluation_does_step_by_step(
    name: str,
    suite: str,
    paths: dict[str, Path],
    scenes: dict[str, Scene],
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    """Fed with the evaluation's own samples and joint angles, noise, kicks and all."""
    scene, policy = scenes[name], load_policy(paths[name])
    count, decisions, samples = 3, 30, scene.config.task.sim_steps
    seen, chosen, told = [], [], []

    def watched(view: Any) -> np.ndarray:
        seen.append(view.imu)
        chosen.append(observing(policy)(view))
        return chosen[-1]

    def controls(*args: Any) -> Any:
        memory, targets = decision_controls(*args)
        told.append(targets.joints)
        return memory, targets

    decision_controls = step.pre_step
    monkeypatch.setattr(step, "pre_step", controls)
    made = run_suite(scene, watched, suite, count, decisions * 0.2, 7, record=True)
    assert not made.fell.any()
    assert made.qpos is not None
    late = suite == "latency"
    for k in range(count):
        imu = np.concatenate([x[k] for x in seen])[samples - 1 :]
        angles = np.concatenate((scene.stance.qpos[None], made.qpos[k]))[:, scene.leg_qpos]
        rig = Rig(paths[name])
        targets, actions = [], []
        for sample, joints in zip(imu, angles, strict=False):
            targets.append(rig.step(joints, sample[:3], sample[3:]))
            actions.append(rig.controller.action)
        assert rig.controller.state is State.BALANCING
        assert actions[::samples] == [int(x[k]) for x in chosen]
        assert len(set(actions)) > 5, "a policy that always does the same shows little"
        expected = np.concatenate([x[k] for x in told])
        if late:  # the robot cannot know: what it says now is done a decision later
            targets, expected = targets[:-samples], expected[samples:]
        expected = expected[: len(targets)]
        np.testing.assert_allclose(targets, expected, rtol=0, atol=ANGLES_AGREE)
        assert len(targets) > (decisions - 2) * samples


LAYOUTS: dict[str, tuple[str, dict[str, Any]]] = {
    "joint": ("joint", {}),
    "factored": ("factored", {"command_lags": (0, 3), "action_ramp": 1.0}),
    "radial": ("radial", {"gyro_lags": (0, 120), "accel_lags": (7, 3), "imu_mean": 4}),
    "levels": ("factored", {"action_levels": 5, "command_lags": (1,), "action_max": 0.02}),
    "rates": ("radial", {"ctrl_dt": 0.05, "sim_dt": 0.005, "action_ramp": 0.01, "imu_mean": 2}),
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
    rng = np.random.default_rng(1)
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
        now = np.asarray(float(number))
        change = policy.actions[actions[-1]]
        memory, targets = step.pre_step(task, robot, memory, change, None, level, now)
        samples = still + rng.normal(0, (0.02, 0.02, 0.02, 0.2, 0.2, 0.2), (task.sim_steps, 6))
        for k in range(task.sim_steps):
            told = rig.step(angles, sample[:3], sample[3:])
            np.testing.assert_allclose(told, targets.joints[k], rtol=0, atol=ANGLES_AGREE)
            assert rig.controller.action == actions[-1]
            angles, sample = told + rng.normal(0, 0.03, told.shape), samples[k]
        tilts = np.zeros(task.sim_steps)
        motion = step.Motion(samples, tilts, angles[None])
        memory, outcome = step.post_step(task, robot, memory, motion)
        obs = outcome.obs
    assert rig.controller.state is State.BALANCING
    assert len(set(actions)) > 4


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
    expected = joint_angles(robot, np.where(robot.left, high, low))
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
    assert rig.controller.action is None
    np.testing.assert_array_equal(rig.controller.targets, rig.standing)
    rig.rng = np.random.default_rng(0)
    rig.clock.now += 1000.0
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
        ({"after": math.nan}, r"a sample came nan s after"),
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
    said = rig.controller.reason
    for targets in rig.steps(120):
        np.testing.assert_array_equal(targets, last)
    assert (rig.controller.reason, rig.controller.action) == (said, action)


@pytest.mark.parametrize(
    "reading",
    [
        {"gyro": [GYRO_MOST, 0, 0], "accel": [0, -ACCEL_MOST, 0]},
        {"joints": bent(-0.75)},
        {"after": 0.0199},
        {"after": 0.0},
    ],
)
def test_what_can_be_does_not(rig: Rig, reading: dict[str, Any]) -> None:
    rig.steps(60)
    rig.step(**reading)
    rig.steps(20)
    assert rig.controller.state is State.BALANCING


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
    ("count", "reading"),
    [
        (50, {"accel": [0, 5.6, 8]}),  # 35 deg
        (50, {"accel": [0, 0, 5.0]}),
        (50, {"accel": [0, 0, 14.6]}),
        (50, {"gyro": [0.7, -0.7, 3.0]}),  # 0.99 rad/s; yaw does not count
        (1, {"gyro": [GYRO_MOST - 1, 0, 0], "accel": [0, 1 - ACCEL_MOST, 0]}),
    ],
    ids=str,
)
def test_a_push_or_one_wild_sample_is_no_fall(
    rig: Rig, count: int, reading: dict[str, Any]
) -> None:
    """Not even the last sample before a decision."""
    rig.steps(151 - count)
    feed(rig, count, reading)
    assert rig.controller.state is State.BALANCING


@pytest.mark.parametrize(
    ("after", "holds"),
    [
        (0.005, True),
        (0.0045, True),
        (0.00435, False),
        (0.004, False),
        (0.0037, False),
        (0.002, True),
    ],
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


def test_an_imu_that_repeats_itself_makes_it_hold(rig: Rig) -> None:
    """Each joint may move on: the robot is falling, and the IMU does not see it."""
    gyro, accel = np.array([0.01, 0, 0]), np.array([0, 0.3, 9.8])
    for _ in range(50):
        rig.step(gyro=gyro, accel=accel)
    assert rig.controller.state is State.BALANCING
    rig.step(gyro=gyro, accel=accel)
    assert rig.controller.reason == "the IMU gave the same sample 51 times"
    rig.controller.reset()
    rig.steps(1)
    for _ in range(49):
        rig.step(gyro=gyro, accel=accel)
    rig.step(gyro=gyro, accel=accel + np.array([0, 0, 1e-6]))
    assert rig.controller.state is State.BALANCING


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


@pytest.fixture(scope="module")
def sound(tmp_path_factory: pytest.TempPathFactory, config: Config) -> bytes:
    """A sound policy file's content."""
    path = tmp_path_factory.mktemp("sound") / "p"
    random_policy(path, with_head(config, "factored"))
    return path.read_bytes()


@pytest.fixture(scope="module")
def scratch(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A file to spoil again and again."""
    return tmp_path_factory.mktemp("scratch") / "p"


def test_what_is_no_regular_file_is_refused(tmp_path: Path) -> None:
    os.mkfifo(tmp_path / "pipe")
    for name, reason in (("nowhere", "No such"), (".", "no regular"), ("pipe", "no regular")):
        with pytest.raises(PolicyFileError, match=f"cannot be used: it cannot be read: .*{reason}"):
            Controller(tmp_path / name)


@pytest.mark.parametrize("spoil", ["cut", "longer", "text", "empty", "header"])
def test_damaged_file_is_refused(sound: bytes, scratch: Path, spoil: str) -> None:
    contents = {
        "cut": sound[:-1],
        "longer": sound + b"\0\0\0\0",
        "text": b"The quick brown fox jumps over the lazy dog.\n" * 20,
        "empty": b"",
        "header": sound[:8] + b"[" + sound[9:],
    }
    scratch.write_bytes(contents[spoil])
    with pytest.raises(PolicyFileError, match="damaged or no safetensors file") as caught:
        Controller(scratch)
    assert str(scratch) in str(caught.value)
    assert "\n" not in str(caught.value)


def test_a_file_beyond_every_policy_is_not_even_read(tmp_path: Path) -> None:
    with (tmp_path / "p").open("wb") as file:
        file.truncate(2**33)  # 8 GiB on paper, next to nothing on the disk
    with pytest.raises(PolicyFileError, match="8589934592 bytes"):
        Controller(tmp_path / "p")


@pytest.mark.parametrize(
    ("edit", "message"),
    [
        (lambda w, m: w.pop("head/kernel"), "weight head/kernel is missing or not of shape"),
        (lambda w, m: w.update({"head/bias": np.zeros(7, np.float32)}), r"shape \(42,\)"),
        (lambda w, m: w["hidden_1/kernel"].fill(np.nan), "hidden_1/kernel holds .* not finite"),
        (lambda w, m: w.update({"head/bias": np.zeros(42)}), "head/bias is F64; it must be F32"),
        (lambda w, m: m.update(version=3), r"is mjx_balance.policy version 3; .* version 5$"),
        (
            lambda w, m: m.update(version=4),
            "version 5; `mjx-balance export OLD.safetensors --out NEW.safetensors` converts it",
        ),
        (lambda w, m: m.update(format="onnx"), "it is onnx version 5"),
        (lambda w, m: m.clear(), "carries no manifest"),
        (lambda w, m: m.pop("robot"), "its manifest lacks 'robot'"),
        (lambda w, m: m["robot"]["legs"][1].pop("zeros"), "its manifest lacks 'zeros'"),
        (lambda w, m: m["robot"].update(legs="four"), "wrong type"),
        (lambda w, m: m["robot"]["legs"][1].update(calf=math.nan), "its calf is not"),
        (lambda w, m: m["robot"]["legs"][1].update(calf=-0.2), "lengths that are not above 0"),
        (lambda w, m: m["robot"]["legs"][1].update(signs=[1, 0, 1]), r"signs not \+-1"),
        (lambda w, m: m["robot"]["legs"][1].update(signs=[1, 1]), "wrong type"),
        (lambda w, m: m["robot"]["legs"][1]["joints"].pop(), "other than three joints"),
        (lambda w, m: m.update(body_height_m=0.6), "body_height_m is 0.6; it must be from"),
        (lambda w, m: m.update(fail_tilt_deg=math.nan), "fail_tilt_deg is nan; it must be from"),
        (lambda w, m: m.update(action="continuous"), "action is 'continuous'; this file runs"),
        (lambda w, m: m["timing"].update(sample_s=0), "sample_s is 0; it must be from"),
        (lambda w, m: m["timing"].update(sample_s="0.1"), "wrong type"),
        (lambda w, m: m["timing"].update(decision_samples=2.5), "decision_samples is 2.5; it must"),
        (lambda w, m: m["timing"].update(ramp_samples=51), "ramp_samples is 51; .* from 1 to 50"),
        (lambda w, m: m["inputs"][3].update(sensor="sonar"), "'sonar'; this file knows height, "),
        (lambda w, m: m["inputs"][3].update(index=4), "index is 4; .* from 0 to 3"),
        (lambda w, m: m["inputs"][3].update(lag=1), "lag is 1; .* from 0 to 0"),
        (lambda w, m: m["inputs"][3].update(window=2), "more samples than there are"),
        (lambda w, m: m["inputs"][9].update(index=3), "index is 3; .* from 0 to 2"),
        (lambda w, m: m["inputs"][9].update(lag=-1), "lag is -1; it must be a whole number"),
        (lambda w, m: m["inputs"][9].update(window=10**9), "window is 1000000000; it must be"),
        (lambda w, m: [r.update(window=90_000) for r in m["inputs"][4:]], "more samples than"),
        (lambda w, m: m["inputs"][9].update(scale=0.0), "not above 0"),
        (lambda w, m: m["inputs"][9].update(offset=math.inf), r"its offset is not \(34,\) sane"),
        (lambda w, m: m["inputs"].pop(), "hidden_0/kernel is missing or not of"),
        (lambda w, m: m["actions"]["table_m"].pop(), "action table is not what"),
        (lambda w, m: m["actions"]["table_m"][5].pop(), "wrong type"),
        (lambda w, m: m["network"].update(factors=[21, 20]), "head/kernel is missing or not of"),
    ],
)
def test_unfit_content_is_refused(sound: bytes, scratch: Path, edit: Edit, message: str) -> None:
    scratch.write_bytes(sound)
    rewrite(scratch, edit)
    with pytest.raises(PolicyFileError, match=message) as caught:
        Controller(scratch)
    assert "\n" not in str(caught.value)


def works_or_is_refused(path: Path) -> None:
    """Whatever a file says: a sentence, or finite targets for as long as one cares to ask."""
    with contextlib.suppress(PolicyFileError):
        rig = Rig(path)
        assert all(np.isfinite(rig.step()).all() for _ in range(3))


@settings(max_examples=150, deadline=None)
@given(position=st.floats(0, 1, exclude_max=True), bits=st.integers(1, 255))
def test_a_flipped_byte_is_refused_or_works(
    sound: bytes, scratch: Path, position: float, bits: int
) -> None:
    where = int(position * (int.from_bytes(sound[:8], "little") + 2_000))  # header and some weights
    scratch.write_bytes(sound[:where] + bytes([sound[where] ^ bits]) + sound[where + 1 :])
    works_or_is_refused(scratch)


@settings(max_examples=200, deadline=None)
@given(data=st.data())
def test_any_value_in_any_place_is_refused_or_works(
    sound: bytes, scratch: Path, data: st.DataObject
) -> None:
    scratch.write_bytes(sound)
    parts = st.sampled_from(("inputs", "timing", "robot", "network", "actions", "action"))

    def edit(weights: Weights, manifest: Manifest) -> None:
        part = data.draw(parts)
        manifest |= data.draw(spoiled({part: manifest[part]}))

    rewrite(scratch, edit)
    works_or_is_refused(scratch)


def test_it_imports_numpy_and_the_standard_library_alone() -> None:
    tree = ast.parse(Path(runtime.__file__).read_text())
    found = set()
    for node in ast.walk(tree):
        if isinstance(node, ast.Import):
            found |= {alias.name.split(".")[0] for alias in node.names}
        elif isinstance(node, ast.ImportFrom):
            assert not node.level
            found.add(str(node.module).split(".")[0])
    assert found - set(sys.stdlib_module_names) == {"numpy"}


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
    targets = controller.step(standing, [0.05, 0.001 * k, 0], [0.3, 0.5, 9.8])
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
    strangers, said = run.stdout.splitlines()
    assert strangers == "[]"
    expected = np.empty(0)
    for k in range(120):
        expected = rig.step(rig.standing, [0.05, 0.001 * k, 0], [0.3, 0.5, 9.8])
    state, action, *targets = said.split()
    assert (state, int(action)) == ("balancing", rig.controller.action)
    np.testing.assert_array_equal(np.asarray(targets, float), expected.ravel())


def example(*arguments: str) -> subprocess.CompletedProcess[str]:
    """What `examples/deploy.py` does."""
    command = [sys.executable, str(REPO / "examples/deploy.py"), *arguments]
    return subprocess.run(command, capture_output=True, text=True, timeout=120, cwd=REPO)


def test_the_example_balances() -> None:
    run = example("best")
    assert run.returncode == 0, run.stderr
    words = run.stdout.split()
    assert words[:2] == ["mean", "tilt"]
    assert 0.01 < float(words[2]) < 0.12
    assert float(words[5]) < 1.1


@pytest.mark.parametrize(
    ("arguments", "said"),
    [
        ((), "error: the following arguments are required: policy"),
        (("nobody",), "error: no policy file at nobody;"),
    ],
)
def test_the_example_says_what_it_needs(arguments: tuple[str, ...], said: str) -> None:
    run = example(*arguments)
    assert (run.returncode, run.stdout) == (2, "")
    assert run.stderr.startswith("usage: deploy.py [-h] policy\n")
    assert said in run.stderr
