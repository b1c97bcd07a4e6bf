"""The page's runtime in JavaScript does what the one in Python does. Under node, no browser."""

import math
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from fixtures.javascript import STATES, evaluate_script, replay
from fixtures.policies import LAYOUTS, random_policy, rewrite, with_head

from mjx_balance import runtime
from mjx_balance.config import Config
from mjx_balance.evaluation.rollout import observing, policy_scene, run_suite
from mjx_balance.evaluation.suites import SUITES, draw_suite
from mjx_balance.policy.file import load_policy, shipped_policies
from mjx_balance.runtime import Controller
from mjx_balance.sim.scene import Scene
from mjx_balance.task import tilt

SHIPPED = shipped_policies()
AGREE = 1e-6  #: rad


def python_answers(path: Path, samples: np.ndarray) -> tuple[np.ndarray, str]:
    """What `replay` returns, of the runtime in Python."""
    now = 0.0
    controller, answers = Controller(path, lambda: now), []
    for sample in samples:
        now += controller.sample_dt
        if math.isnan(sample[0]):
            controller.reset()
        else:
            joints, gyro, accelerometer = np.split(sample, (len(sample) - 6, len(sample) - 3))
            controller.step(joints.reshape(-1, 3), gyro, accelerometer)
        action = -1 if controller.action is None else controller.action
        command = (math.nan, math.nan) if controller.command is None else controller.command
        state = STATES.index(str(controller.state))
        answers.append((state, action, *command, *controller.targets.ravel()))
    return np.asarray(answers, float), controller.reason


def compare(path: Path, samples: np.ndarray) -> np.ndarray:
    """Checks that both do the same; returns the answers."""
    expected, reason = python_answers(path, samples)
    answers, said = replay(path, samples)
    np.testing.assert_array_equal(answers[:, :2], expected[:, :2])
    np.testing.assert_allclose(answers[:, 2:4], expected[:, 2:4], rtol=0, atol=1e-9)
    np.testing.assert_allclose(answers[:, 4:], expected[:, 4:], rtol=0, atol=AGREE)
    assert said == reason
    return answers


def evaluation_samples(name: str, suite: str, count: int, seconds: float) -> np.ndarray:
    """Joints and IMU of an evaluation, scenario by scenario, with a reset between two."""
    policy = load_policy(SHIPPED[name])
    scene, imu = policy_scene(policy), []

    def controller(view: Any) -> np.ndarray:
        imu.append(view.imu)
        return observing(policy)(view)

    rollout = run_suite(scene, controller, suite, count, seconds, 5, record=True)
    assert rollout.qpos is not None
    assert not rollout.fell.any()
    parts = []
    for k in range(count):
        sensors = np.concatenate([x[k] for x in imu])[scene.task.sim_steps - 1 :]
        qpos = np.concatenate((scene.stance.qpos[None], rollout.qpos[k]))[: len(sensors)]
        joints = qpos[:, scene.leg_qpos.ravel()]
        reset = np.full((1, joints.shape[1] + 6), np.nan)
        parts += [np.concatenate((joints, sensors), axis=1), reset]
    return np.concatenate(parts)


def decisions(answers: np.ndarray) -> int:
    return int((answers[:, 0] == STATES.index("balancing")).sum()) // 50


@pytest.mark.parametrize("name", ["best", "real"])
def test_it_decides_as_the_runtime_in_an_evaluation(name: str) -> None:
    samples = evaluation_samples(name, "corner", 1, 20.0)
    assert decisions(compare(SHIPPED[name], samples)) >= 99


@pytest.mark.parametrize("name", SHIPPED)
@pytest.mark.parametrize(
    "scenarios", [pytest.param(1, marks=pytest.mark.slow), pytest.param(12, marks=pytest.mark.long)]
)
def test_it_decides_as_the_runtime_with_every_policy(name: str, scenarios: int) -> None:
    """At 900 decisions each, or at 10,800."""
    done = 0
    for suite in ("corner", "push", "noise"):
        done += decisions(compare(SHIPPED[name], evaluation_samples(name, suite, scenarios, 60.0)))
    assert done >= 890 * scenarios


def still(path: Path, count: int, seed: int = 1, swing: float = 0.0) -> np.ndarray:
    """Samples of a robot that stands, its joints at the targets of both runtimes."""
    rng, now = np.random.default_rng(seed), 0.0
    controller, samples = Controller(path, lambda: now), []
    for k in range(count):
        now += controller.sample_dt
        joints = controller.targets + rng.normal(0, 0.03, controller.targets.shape)
        gyro = rng.normal(0, 0.02, 3) + swing * math.sin(k / 40) * np.asarray((1, 1, 0))
        accel = rng.normal((0, 0, 9.81), 0.2)
        controller.step(joints, gyro, accel)
        samples.append((*joints.ravel(), *gyro, *accel))
    return np.asarray(samples)


@pytest.mark.parametrize("layout", LAYOUTS)
def test_it_runs_any_layout(layout: str, tmp_path: Path, config: Config) -> None:
    """Random weights, joints and samples."""
    head, changes = LAYOUTS[layout]
    path = tmp_path / "p"
    random_policy(path, with_head(config, head, body_height=0.33, **changes))
    answers = compare(path, still(path, 24 * Controller(path).decision_samples))
    assert (answers[:, 0] == STATES.index("balancing")).all()
    assert len(np.unique(answers[:, 1])) > 4


def test_a_point_between_two_levels_takes_the_even_one(tmp_path: Path, config: Config) -> None:
    """Best points -0.75 and 0.25 of 5 levels are 0.5 and 2.5: levels 0 and 2, as NumPy rounds."""
    path = tmp_path / "p"
    random_policy(path, with_head(config, "radial", action_levels=5))

    def aim(weights: Any, _: Any) -> None:
        weights["head/kernel"].fill(0)
        weights["head/bias"][:] = 0, -0.75, 0.25

    rewrite(path, aim)
    answers = compare(path, still(path, 2))
    assert answers[0, 1] == 2


def broken(fault: str, samples: np.ndarray) -> np.ndarray:
    """Samples to which something happens after a while."""
    at, joints = 170, samples.shape[1] - 6
    samples = samples.copy()
    gyro, accel = samples[at:, joints : joints + 3], samples[at:, joints + 3 :]
    if fault == "nan":
        samples[at, joints + 1] = np.nan
    elif fault == "range":
        samples[at, 2] = 4.0
    elif fault == "stale":
        samples[at:, joints:] = samples[at, joints:]
    elif fault == "bursts":
        # Decisions are after samples 0, 50, 100...; the last 20 before each are the same.
        number = np.arange(at, len(samples)) - 1
        samples[at:, joints:] = samples[
            1 + number // 50 * 50 + np.minimum(number % 50, 29), joints:
        ]
    elif fault == "gyro":
        gyro[:] = gyro[0]
    elif fault == "stuck":
        gyro[:, :2] += 0.05
        accel[:, :2] += (1.0, 0.5)
        samples[at:, 1] = samples[at, 1]
        samples[at:, 2] = samples[at, 2]
    elif fault == "weight":
        accel *= 0.3
    elif fault == "lean":
        accel[:] = accel[:, [0, 2, 1]]
    elif fault == "tumbling":
        gyro[:, 0] += 1.5
    elif fault == "away":
        samples[at:, 4] += 0.7
    return samples


@pytest.mark.parametrize(
    ("fault", "words"),
    [
        ("nan", "reads nan"),
        ("range", "LF_knee reads 4, which is not between"),
        ("stale", "the IMU repeats itself: "),
        ("bursts", "the IMU repeats itself: at two decisions"),
        ("gyro", "the gyro repeats itself"),
        ("stuck", "all the time, while its target moved"),
        ("weight", "the accelerometer gives"),
        ("lean", "the accelerometer leans by"),
        ("tumbling", "rad/s about x and y"),
        ("away", "RF_hip is 0."),
    ],
)
def test_every_fault_holds_at_the_same_sample_for_the_same_reason(fault: str, words: str) -> None:
    path = SHIPPED["best"]
    samples = broken(fault, still(path, 1200 if fault == "stuck" else 420))
    _, reason = python_answers(path, samples)
    assert words in reason
    assert compare(path, samples)[-1, 0] == STATES.index("holding")


def test_a_network_that_gives_no_numbers_holds(tmp_path: Path) -> None:
    path = tmp_path / "p"
    path.write_bytes(SHIPPED["best"].read_bytes())
    rewrite(path, lambda w, m: [w[x].fill(3e38) for x in ("hidden_0/bias", "head/kernel")])
    samples = still(SHIPPED["best"], 2)
    compare(path, samples)
    assert replay(path, samples)[1] == "the network gives values that are not finite numbers"


def test_its_limits_are_the_runtimes() -> None:
    limits = evaluate_script('import { LIMITS as result } from "./runtime.js";')
    assert len(limits) == 12
    for name, value in limits.items():
        assert np.ravel(value).tolist() == np.ravel(getattr(runtime, name)).tolist(), name


@pytest.mark.parametrize(
    ("change", "words"),
    [
        (lambda content: content[:4], "it ends within its header"),
        (lambda content: content[:5000], "it ends within its header"),
        (lambda content: content[:-4], "is not"),
        (lambda content: content.replace(b'"version\\": 5', b'"version\\": 4', 1), "version 4"),
        (lambda content: content.replace(b'"F32"', b'"F16"', 1), "F32"),
        (lambda content: b"{" * 3000, "header"),
        (lambda content: content[:-4] + b"\0\0\xc0\x7f", "not finite numbers"),
    ],
    ids=("short", "header", "cut", "version", "type", "other", "nan"),
)
def test_a_file_that_it_cannot_run_gets_one_sentence(
    change: Any, words: str, tmp_path: Path
) -> None:
    path = tmp_path / "p"
    content = SHIPPED["best"].read_bytes()
    path.write_bytes(change(content))
    assert path.read_bytes() != content
    with pytest.raises(AssertionError, match="PolicyError") as caught:
        replay(path, np.zeros((1, 18)))
    (sentence,) = [x for x in str(caught.value).splitlines() if x.startswith("PolicyError: ")]
    assert words in sentence


@pytest.mark.parametrize("suite", ["paper", "steps", "sea", "recover", "platform"])
def test_the_board_goes_where_pythons_goes(suite: str, scene: Scene) -> None:
    """Targets, waves, a tilted start and a platform, over 60 s and beyond."""
    from mjx_balance.cli.browser import suite_scenarios
    from mjx_balance.evaluation.rollout import suite_scene

    own = suite_scene(scene, suite)
    times = np.linspace(0, 70, 351)
    script = """
      import { boardTarget } from "./board.js";
      const { task, scenario, times } = value;
      const result = times.map((time) => boardTarget(task, scenario, time));
    """
    task = {name: getattr(own.task, name) for name in ("target_period", "sea_period")}
    drawn = suite_scenarios(own, suite, 3)[1]
    value = {"task": task, "scenario": drawn, "times": times.tolist()}
    result = np.asarray(evaluate_script(script, value))
    episodes = draw_suite(own.task, own.robot, suite, 2, 60.0, 3)
    expected = tilt.board_angle(own.task, episodes.scenario, np.tile(times, (2, 1)))[1]
    np.testing.assert_allclose(result[:, :2], expected, atol=1e-9)
    if SUITES[suite].platform:
        place = tilt.platform_position(own.task, episodes.scenario, np.tile(times, (2, 1)))[1]
        np.testing.assert_allclose(result[:, 2:], place, atol=1e-9)
    assert np.ptp(expected) > 0.1


def test_the_baseline_decides_as_pythons(scene: Scene) -> None:
    """pd-imu on the same samples, decision by decision; it moves the legs by what Python says."""
    from mjx_balance.cli.browser import robot_data
    from mjx_balance.evaluation.controllers import make_controller

    pd, commands, imu = make_controller("pd-imu", scene), [], []

    def controller(view: Any) -> np.ndarray:
        commands.append(pd(view)[0])
        imu.append(view.imu[0])
        return commands[-1][None]

    run_suite(scene, controller, "corner", 1, 20.0, 5)
    script = """
      import { ImuPd } from "./baselines.js";
      const pd = new ImuPd(value.data);
      const result = [];
      for (const [k, sample] of value.samples.entries()) {
        const before = pd.heights;
        pd.step([], sample);
        if (k % 50 === 0) result.push([0, 1, 2, 3].map((leg) => pd.heights[leg] - before[leg]));
      }
    """
    samples = np.concatenate(imu)[scene.task.sim_steps - 1 :]
    data = robot_data(scene, suites=())
    result = np.asarray(evaluate_script(script, {"data": data, "samples": samples.tolist()}))
    a_x, a_y = np.asarray(commands).T[:, : len(result)]
    expected = np.stack((a_x + a_y, a_y - a_x, a_x - a_y, -a_x - a_y), axis=1)
    np.testing.assert_allclose(result, expected, atol=1e-6)
    assert np.abs(expected).max() > 1e-3
