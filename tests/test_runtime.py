"""The runtime for a robot: decision for decision what the evaluation does, and safe."""

import ast
import dataclasses
import math
import re
import shutil
import subprocess
import sys
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from fixtures.policies import Manifest, Weights, random_policy, rewrite, with_head

from mjx_balance import runtime
from mjx_balance.config import Config, to_dict
from mjx_balance.evaluation.rollout import observing, policy_scene, run_suite
from mjx_balance.policy.file import load_policy
from mjx_balance.robots.catalogue import Robot, find_robot
from mjx_balance.runtime import ACCEL_MOST, GYRO_MOST, Controller, State
from mjx_balance.task import step, tilt
from mjx_balance.task.kinematics import joint_angles

REPO = Path(__file__).parent.parent
BEST = REPO / "policies/best.safetensors"
ANGLES_AGREE = 1e-12
"""rad. Both sides compute in float64, from the same float32 tables and in the same order; what may
differ is the last bits of NumPy's arccos, arctan2 and cos over arrays of other lengths: some 1e-15
of 3 rad. Actions must be equal. The network is float32, and its sums over one observation and over
a batch differ by up to 2e-5 of a level; no decision of these tests is so near to the border of two
levels (3e-4 at the least)."""


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


@pytest.mark.parametrize("suite", ["corner", "noise", "push", "latency"])
def test_it_does_what_the_evaluation_does_step_by_step(
    suite: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    """On the evaluation's own samples and joint angles, with noise and pushes."""
    policy = load_policy(BEST)
    scene = policy_scene(policy)
    count, decisions, samples = 3, 30, scene.task.sim_steps
    imu, chosen, joints = [], [], []

    def controller(view: Any) -> np.ndarray:
        imu.append(view.imu)
        chosen.append(observing(policy)(view))
        return chosen[-1]

    def pre_step(*args: Any) -> Any:
        memory, targets = original(*args)
        joints.append(targets.joints)
        return memory, targets

    original = step.pre_step
    monkeypatch.setattr(step, "pre_step", pre_step)
    rollout = run_suite(scene, controller, suite, count, decisions * 0.2, 7, record=True)
    assert not rollout.fell.any()
    assert rollout.qpos is not None
    for k in range(count):
        readings = np.concatenate([x[k] for x in imu])[samples - 1 :]
        angles = np.concatenate((scene.stance.qpos[None], rollout.qpos[k]))[:, scene.leg_qpos]
        rig = Rig()
        targets, actions = [], []
        for reading, angle in zip(readings, angles, strict=False):
            targets.append(rig.step(angle, reading[:3], reading[3:]))
            actions.append(rig.controller.action)
        assert rig.controller.state is State.BALANCING
        assert actions[::samples] == [int(x[k]) for x in chosen]
        assert len(set(actions)) > 5, "a policy that always does the same shows little"
        expected = np.concatenate([x[k] for x in joints])
        if suite == "latency":  # each action acts a decision later, which the robot cannot know
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
        state = step.EnvState(None, memory, level, np.asarray(number), None, None)
        memory, targets = step.pre_step(task, robot, state, policy.actions[actions[-1]])
        samples = still + rng.normal(0, (0.02, 0.02, 0.02, 0.2, 0.2, 0.2), (task.sim_steps, 6))
        for k in range(task.sim_steps):
            got = rig.step(angles, sample[:3], sample[3:])
            np.testing.assert_allclose(got, targets.joints[k], rtol=0, atol=ANGLES_AGREE)
            assert rig.controller.action == actions[-1]
            angles, sample = got + rng.normal(0, 0.03, got.shape), samples[k]
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
    assert rig.controller.action is None
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
    strangers, output = run.stdout.splitlines()
    assert strangers == "[]"
    expected = np.empty(0)
    for k in range(120):
        expected = rig.step(rig.standing, [0.05, 0.001 * k, 0], [0.3, 0.5, 9.8])
    state, action, *targets = output.split()
    assert (state, int(action)) == ("balancing", rig.controller.action)
    np.testing.assert_array_equal(np.asarray(targets, float), expected.ravel())


def example(policy: str) -> subprocess.CompletedProcess[str]:
    command = [sys.executable, str(REPO / "examples/deploy.py"), policy]
    return subprocess.run(command, capture_output=True, text=True, timeout=120, cwd=REPO)


def test_the_example_balances_as_the_evaluation_does() -> None:
    """In its own loop over plain MuJoCo, for 20 s: the same mean and greatest tilt."""
    policy = load_policy(BEST)
    tilt = run_suite(policy_scene(policy), observing(policy), "corner", 1, 20.0, 0).tilt
    expected = f"mean tilt {tilt.mean():.3f} deg, greatest {tilt.max():.3f} deg in 20 s\n"
    run = example("best")
    assert (run.returncode, run.stdout) == (0, expected), run.stderr


def test_the_example_says_what_it_needs() -> None:
    run = example("nobody")
    assert (run.returncode, run.stdout) == (2, "")
    assert run.stderr.startswith("usage: deploy.py [-h] policy\n")
    assert "error: no policy file at nobody;" in run.stderr
