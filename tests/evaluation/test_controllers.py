"""Baselines: each does what its knowledge allows."""

import dataclasses
import sys
from typing import Any

import numpy as np
import pytest
from scipy.optimize import lsq_linear
from scipy.spatial.transform import Rotation

from mjx_balance.config import TaskConfig
from mjx_balance.evaluation.controllers import (
    CONTROLLERS,
    HORIZON,
    AttitudePD,
    ControllerError,
    ImuPD,
    Predictive,
    View,
    as_it_will_be,
    at_this_rate,
    make_controller,
    measure_response,
)
from mjx_balance.evaluation.rollout import run_suite, summarize
from mjx_balance.robots.catalogue import Robot
from mjx_balance.sim.scene import Scene
from mjx_balance.task.actions import to_command
from mjx_balance.task.tilt import Scenario


def make_view(
    scene: Scene, roll_pitch_yaw: np.ndarray, rates: np.ndarray | None = None, **more: Any
) -> View:
    """What n made-up scenarios look like: attitudes (n, 3) in deg, body rates (n, 3) in deg/s."""
    n = len(roll_pitch_yaw)
    qpos, qvel = np.tile(scene.stance.qpos, (n, 1)), np.zeros((n, scene.model.nv))
    turn = Rotation.from_euler("ZYX", roll_pitch_yaw[:, ::-1], degrees=True)
    qpos[:, scene.trunk_quat] = turn.as_quat(scalar_first=True)
    if rates is not None:
        root = scene.model.joint("robot/root").dofadr[0]
        qvel[:, root + 3 : root + 6] = np.radians(rates)
    view = View(
        scene=scene,
        ids=np.arange(n),
        env_steps=0,
        obs=np.zeros((n, 34)),
        imu=np.tile(scene.stance.imu, (n, 50, 1)),
        qpos=qpos,
        qvel=qvel,
        scenario=Scenario(np.zeros((n, 2, 2)), np.zeros(n), np.full(n, 3.5)),
        delayed=np.zeros(n, bool),
    )
    return view._replace(**more)


def off_the_grid(scene: Scene) -> Scene:
    return dataclasses.replace(scene, task=dataclasses.replace(scene.task, action="continuous"))


def test_standing_still_is_the_action_that_changes_nothing(scene: Scene) -> None:
    view = make_view(scene, np.full((3, 3), 5.0))
    assert make_controller("none", scene)(view).tolist() == [[0, 0]] * 3


def test_proportional_and_derivative_by_hand(scene: Scene) -> None:
    """Roll 0.4 deg at 1 deg/s: -(1.3 * 0.4 + 0.12) / 400 = -1.6 mm, that is -1.5, level 5.

    Pitch -0.2 deg at 0.5 deg/s: -(1.3 * -0.2 + 0.12 * 0.5) / -300 = -0.667 mm, -0.6, level 8.
    """
    controller = AttitudePD(scene)
    controller.gain = np.asarray((400.0, -300.0))
    view = make_view(
        scene,
        np.asarray([(0.4, -0.2, 0.0), (0.4, -0.2, 130.0), (0, 0, 0)]),
        np.asarray([(1.0, 0.5, 9.0), (1.0, 0.5, 9.0), (0, 0, 9.0)]),
    )
    expected = [(-1.5, -0.6), (-1.5, -0.6), (0, 0)]
    np.testing.assert_allclose(1000 * controller(view), expected, atol=1e-5)
    off_grid = AttitudePD(off_the_grid(scene))
    off_grid.gain = np.asarray((400.0, -300.0))
    expected = [(-1.6, -0.6667), (-1.6, -0.6667), (0, 0)]
    np.testing.assert_allclose(1000 * off_grid(view), expected, atol=1e-4)
    off_grid.gain = np.asarray((40.0, -30.0))  # -16 and -6.67 mm: more than the greatest
    np.testing.assert_allclose(1000 * off_grid(view)[0], (-3, -3), atol=1e-9)
    angle, rate = controller.state(view)
    np.testing.assert_allclose(angle[1], (0.4, -0.2), atol=1e-9)
    np.testing.assert_allclose(rate[1], (1.0, 0.5), atol=1e-9)


def test_off_the_grid_only_the_greatest_change_bounds_a_command() -> None:
    """The preset's 3 mm, and no other robot's."""
    for most in (0.003, 0.001):
        task = TaskConfig(action="continuous", action_max=most)
        got = to_command(task, np.asarray([(0.00071, -0.00049), (0.02, -0.02)]))
        np.testing.assert_allclose(got, [(0.00071, -0.00049), (most, -most)], rtol=1e-12)


def test_gains_are_those_that_the_benchmark_found_best(scene: Scene) -> None:
    """Unless others are given: -(0.5 * 0.4 + 0.2 * 1) / 400 = -1 mm: -0.9, level 7."""
    imu, true = ImuPD(scene), AttitudePD(scene)
    assert (imu.proportional, imu.rate, imu.tau, imu.samples) == (1.2, 0.14, 4.0, 1)
    assert (true.proportional, true.rate) == (1.3, 0.12)
    other = AttitudePD(scene, proportional=0.5, rate=0.2)
    other.gain = np.asarray((400.0, -300.0))
    view = make_view(scene, np.asarray([(0.4, 0.0, 0.0)]), np.asarray([(1.0, 0.0, 0.0)]))
    np.testing.assert_allclose(1000 * other(view), [(-0.9, 0)], atol=1e-5)


def test_complementary_filter_sample_by_sample(scene: Scene) -> None:
    """Predict by the gyro, lean toward gravity's direction; worlds keep their own angle.

    It begins with the direction of the first sample.
    """
    rng = np.random.default_rng(0)
    controller = ImuPD(scene, tau=0.5, samples=3)
    angle, leak = np.zeros((3, 2)), 0.004 / 0.504
    for decision, ids in enumerate(([0, 1, 2], [2, 0])):
        lean = rng.uniform(-20, 20, (len(ids), 50, 2))
        down = Rotation.from_euler("YX", np.radians(lean[..., ::-1].reshape(-1, 2))).inv()
        accel = down.apply((0, 0, 9.81)).reshape(len(ids), 50, 3)
        gyro = rng.uniform(-1, 1, (len(ids), 50, 3))
        for row, world in enumerate(ids):
            if decision == 0:
                angle[world] = np.radians(lean[row, 0])
            for k in range(50):
                predicted = angle[world] + 0.004 * gyro[row, k, :2]
                angle[world] = predicted + leak * (np.radians(lean[row, k]) - predicted)
        view = make_view(
            scene,
            np.zeros((len(ids), 3)),
            imu=np.concatenate((gyro, accel), axis=-1),
            env_steps=decision,
            ids=np.asarray(ids),
        )
        got, rate = controller.state(view)
        np.testing.assert_allclose(got, np.degrees(angle[ids]), atol=1e-9)
        np.testing.assert_allclose(rate, np.degrees(gyro[:, -3:, :2].mean(axis=1)), atol=1e-9)


def test_filter_starts_anew_with_every_evaluation(scene: Scene) -> None:
    controller = ImuPD(scene)
    tilted = np.tile((0.5, 0.5, 0.0, 1.0, 1.0, 9.7), (2, 50, 1))
    view = make_view(scene, np.zeros((2, 3)), imu=tilted)
    first, _, again = (controller.state(view._replace(env_steps=k))[0] for k in (0, 1, 0))
    np.testing.assert_array_equal(first, again)


@pytest.fixture(scope="module")
def courses(scene: Scene) -> tuple[np.ndarray, np.ndarray]:
    """Gain (2,) in deg/m and course (2, 400) of one action."""
    response = measure_response(scene)
    return response.gain, response.course


def best_plan(
    course: np.ndarray, free: np.ndarray, limit: float, first: float | None = None
) -> np.ndarray:
    """Least squares of the tilt over the horizon, one axis, action sizes in deg within limits."""
    effect = np.zeros((400, HORIZON))
    for j in range(HORIZON):
        effect[50 * j :, j] = course[: 400 - 50 * j]
    fixed = [] if first is None else [first]
    free = free + effect[:, : len(fixed)] @ fixed
    rest = lsq_linear(effect[:, len(fixed) :], -free, (-limit, limit), tol=1e-12).x
    return np.append(fixed, rest)


@pytest.mark.parametrize(("late", "off"), [(False, False), (True, False), (True, True)])
def test_plans_are_the_least_squares_optimum(
    scene: Scene,
    courses: tuple[np.ndarray, np.ndarray],
    late: bool,
    off: bool,
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    """Three decisions of a world that is tilted, turned by 30 deg, and whose board moves.

    An action is a step response; what the actions already taken have yet to do is known, and
    one that is late will only begin now.
    """
    monkeypatch.setattr(sys.modules[Predictive.__module__], "SWEEPS", 400)
    gain, course = courses
    controller = Predictive(off_the_grid(scene) if off else scene, as_it_will_be)
    limits = np.abs(gain) * 0.003
    scenario = Scenario(np.asarray([[(5.0, -3.0), (5.0, -3.0)]]), np.zeros(1), np.full(1, 3.5))
    taken = [np.zeros(2)]  # in the order in which they act
    waiting = np.zeros(2)
    for decision, attitude in enumerate(((0.8, -0.5), (0.5, 0.2), (-0.3, 0.1))):
        view = make_view(
            scene,
            np.asarray([(*attitude, 30.0)]),
            env_steps=decision,
            scenario=scenario,
            delayed=np.asarray([late]),
        )
        step = np.arange(1, 401)
        start = 0.2 * decision
        # From 0 at 3.5 deg/s to 5 and -3 deg; heading 30 deg: roll and pitch see it turned.
        moved = (
            np.minimum(3.5 * (start + 0.004 * step), 5) - min(3.5 * start, 5),
            -(np.minimum(3.5 * (start + 0.004 * step), 3) - min(3.5 * start, 3)),
        )
        body = (moved[0] + 1j * moved[1]) * np.exp(-1j * np.radians(30))
        chosen = np.zeros(2)
        for axis, part in enumerate((body.real, body.imag)):
            unfinished = np.append(course[axis, 50:], np.ones(50)) - course[axis, 49]
            free = attitude[axis] + part + taken[-1][axis] * unfinished
            first = waiting[axis] if late else None
            plan = best_plan(course[axis], free, limits[axis], first)
            chosen[axis] = plan[1] if late else plan[0]
        taken.append(waiting if late else chosen)
        waiting = chosen
        expected = chosen / gain
        got = controller(view)[0]
        np.testing.assert_allclose(got, expected, atol=1e-6 if off else 0.00016)
        np.testing.assert_allclose(controller.chosen[1, 0], chosen, atol=1e-4)


def test_a_tilt_within_one_action_is_taken_back_at_once(
    scene: Scene, courses: tuple[np.ndarray, np.ndarray]
) -> None:
    """On a board at rest: the height change that undoes 0.5 deg of roll and 0.3 of pitch."""
    gain, _ = courses
    controller = Predictive(scene, at_this_rate)
    tilted = np.asarray([(0.5, 0.0, 0.0), (0.0, 0.3, 0.0), (0.0, 0.0, 45.0)])
    got = controller(make_view(scene, tilted))
    expected = [(-0.5 / gain[0], 0.0), (0.0, -0.3 / gain[1]), (0.0, 0.0)]
    np.testing.assert_allclose(got, expected, atol=0.0004)


def test_response_is_that_of_the_robots_geometry(
    robot: Robot, courses: tuple[np.ndarray, np.ndarray]
) -> None:
    """Raising the left by a tilts by a / half-track, raising the front by -a / half-length."""
    gain, course = courses
    expected = np.degrees((1 / robot.half_track, -1 / robot.half_length))
    np.testing.assert_allclose(gain, expected, rtol=0.08)
    assert course.shape == (2, 400)
    assert np.abs(course[:, 0]).max() < 0.1
    np.testing.assert_allclose(course[:, 100:], 1.0, atol=0.05)
    np.testing.assert_allclose(course[:, -1], 1.0, atol=1e-12)


def test_forecasts_of_a_ramp() -> None:
    """The board turns at 3 deg/s about X until 6 deg, from time 0."""
    scenario = Scenario(np.asarray([[[6.0, 0.0]]]), np.zeros(1), np.full(1, 3.0))
    ahead = np.asarray((0.5, 1.0, 2.0))
    task = TaskConfig()
    moving = np.asarray([1.0])
    np.testing.assert_allclose(at_this_rate(task, scenario, moving, ahead)[0, :, 0], (1.5, 3, 6))
    np.testing.assert_allclose(as_it_will_be(task, scenario, moving, ahead)[0, :, 0], (1.5, 3, 3))
    at_first = np.zeros(1)
    assert not at_this_rate(task, scenario, at_first, ahead).any(), "it does not know the future"
    np.testing.assert_allclose(as_it_will_be(task, scenario, at_first, ahead)[0, 1], (3, 0))
    resting = np.asarray([5.0])
    for forecast in (at_this_rate, as_it_will_be):
        assert not forecast(task, scenario, resting, ahead).any()


def test_controllers_by_name(scene: Scene) -> None:
    made = [make_controller(name, scene) for name in CONTROLLERS]
    assert list(CONTROLLERS) == "none pd-imu pd-attitude rate-oracle clairvoyant".split()
    assert [type(x) for x in made[1:]] == [ImuPD, AttitudePD, Predictive, Predictive]
    forecasts = [x.forecast for x in made if isinstance(x, Predictive)]
    assert forecasts == [at_this_rate, as_it_will_be]
    with pytest.raises(ControllerError, match="unknown controller 'lqr'; known controllers: none"):
        make_controller("lqr", scene)


@pytest.mark.slow
def test_knowing_more_means_tilting_less(scene: Scene) -> None:
    mean, falls = {}, {}
    for name in CONTROLLERS:
        controller = make_controller(name, scene)
        result = summarize(run_suite(scene, controller, "paper", 8, 25.0, 5), "paper", 25.0, 5)
        mean[name], falls[name] = result["tilt_deg"]["mean"], result["falls"]
    assert falls["none"] > 0
    assert not any(n for name, n in falls.items() if name != "none")
    order = "none pd-imu pd-attitude rate-oracle clairvoyant".split()
    assert sorted(order, key=lambda name: -mean[name]) == order
    assert mean["rate-oracle"] < 0.1


@pytest.mark.slow
def test_the_oracles_know_of_latency(scene: Scene) -> None:
    """A controller that does not takes back the same tilt twice."""

    def mean(name: str) -> float:
        controller = make_controller(name, scene)
        return float(run_suite(scene, controller, "latency", 4, 20.0, 5).tilt.mean())

    means = {name: mean(name) for name in ("pd-attitude", "rate-oracle", "clairvoyant")}
    assert means["clairvoyant"] < means["rate-oracle"] < 0.3 < 0.6 < means["pd-attitude"]


def test_filters_keep_every_worlds_own_memory(scene: Scene) -> None:
    """A world's tilt does not depend on which others run, or fall, beside it."""
    controller = make_controller("pd-imu", scene)
    many = run_suite(scene, controller, "corner", 3, 4.0, 0).tilt
    alone = run_suite(scene, controller, "corner", 1, 4.0, 0).tilt
    np.testing.assert_allclose(many[0], alone[0], atol=1e-9)
