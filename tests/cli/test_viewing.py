"""A board that keys tilt, and a robot that they push."""

import dataclasses

import numpy as np
import pytest

from mjx_balance.cli.view import DOWN, LEFT, LEVEL, PUSH_KEY, RIGHT, UP, Session
from mjx_balance.evaluation.controllers import Controller, View, make_controller
from mjx_balance.evaluation.rollout import run_suite
from mjx_balance.evaluation.suites import draw_suite
from mjx_balance.sim.scene import Scene
from mjx_balance.task.tilt import board_angle


def session(scene: Scene, name: str = "pd-attitude", suite: str | None = None) -> Session:
    return Session(scene, make_controller(name, scene), suite, seed=3)


def board(scene: Scene, states: np.ndarray) -> np.ndarray:
    """(sim_steps, 2) true angles of the board, deg."""
    return np.degrees(states[:, scene.board_qpos])


@pytest.mark.parametrize(
    ("keys", "target"),
    [
        ((RIGHT,), (1, 0)),
        ((LEFT, LEFT), (-2, 0)),
        ((UP,), (0, -1)),
        ((DOWN, DOWN, RIGHT), (1, 2)),
        ((DOWN, RIGHT, LEVEL), (0, 0)),
        ((65,), (0, 0)),
        ((RIGHT,) * 40, (10.34, 0)),
    ],
    ids=str,
)
def test_the_board_goes_where_the_keys_say(
    scene: Scene, keys: tuple[int, ...], target: tuple[float, float]
) -> None:
    """A degree each, as far as the legs reach, at the board's own rate of 3.5 deg/s."""
    one = session(scene)
    for key in keys:
        one.press(key)
    states = np.stack([one.step() for _ in range(25)])
    np.testing.assert_allclose(board(scene, states[-1])[-1], target, atol=0.05)
    way = np.abs(np.diff(np.asarray([board(scene, x)[-1] for x in states]), axis=0)).max()
    assert way <= 0.7 + 0.02
    assert one.falls == 0
    assert one.tilt < 0.5


def test_a_target_that_changes_on_the_way(scene: Scene) -> None:
    """Turned back after 0.4 s, at 1.4 deg, the board goes on from there, without a jump."""
    one = session(scene)
    for _ in range(5):
        one.press(RIGHT)
    path = [board(scene, one.step()) for _ in range(2)]
    one.press(LEVEL)
    path += [board(scene, one.step()) for _ in range(4)]
    roll = np.concatenate(path)[:, 0]
    assert roll.max() == pytest.approx(1.4, abs=0.05)
    assert np.abs(np.diff(roll)).max() < 0.03
    assert roll[-1] == pytest.approx(0, abs=0.05)


def test_the_caption_has_the_boards_roll_before_its_pitch(scene: Scene) -> None:
    one = session(scene)
    for key in (RIGHT, RIGHT, DOWN):
        one.press(key)
    for _ in range(5):
        one.step()
    tilt, board, falls = one.caption()[1].splitlines()
    assert (board, falls) == ("+2.0, +1.0 deg", "0")
    assert tilt == f"{one.tilt:.2f} deg"


def test_a_push_moves_the_robot_once(scene: Scene) -> None:
    one, other = session(scene), session(scene)
    one.press(PUSH_KEY)
    root = scene.trunk_quat[0] - 3
    way = np.linalg.norm((one.step() - other.step())[1, root : root + 2])
    assert way == pytest.approx(0.4 * 0.008, rel=0.15), "0.4 m/s over two physics steps"
    assert not one.push.any()


def test_a_push_grows_with_the_robot(scene: Scene) -> None:
    """One of twice the size gets 0.8 m/s, in a direction that is drawn."""
    legs = [dataclasses.replace(x, x=2 * x.x, y=2 * x.y) for x in scene.robot.legs]
    large = dataclasses.replace(scene.robot, legs=tuple(legs))
    one = session(scene)
    one.scene, pushes = dataclasses.replace(scene, robot=large), []
    for _ in range(20):
        one.press(PUSH_KEY)
        pushes.append(one.push)
    np.testing.assert_allclose(np.linalg.norm(pushes, axis=1), 0.8)
    assert len(np.unique(np.sign(pushes), axis=0)) == 4


def test_a_round_of_a_suite_ends_with_its_scenario(scene: Scene) -> None:
    """After 300 decisions, though the robot stands."""
    one = session(scene, suite="paper")
    one.number = 298
    one.step()
    assert (one.number, one.rounds) == (299, 0)
    one.step()
    assert (one.number, one.rounds, one.falls) == (0, 1, 0)


def test_who_falls_is_put_back_up_on_a_level_board(scene: Scene) -> None:
    one = session(scene, "none")
    for _ in range(8):
        one.press(RIGHT)
    while not one.falls:
        assert one.number < 20
        one.step()
    assert one.caption() == ("body tilt\nboard\nfalls", "0.00 deg\n+0.0, +0.0 deg\n1")
    np.testing.assert_allclose(one.step()[0], scene.stance.qpos, atol=1e-3)


@pytest.mark.parametrize("suite", ["push", "payload", "noise", "latency", "platform"])
def test_a_suite_is_shown_as_it_is_evaluated(scene: Scene, suite: str) -> None:
    """The same states as `evaluate --suite ... --seed 3`: pushes, loads, noise and delays."""
    controller: Controller = make_controller("pd-imu", scene)
    rollout = run_suite(scene, controller, suite, 1, 60.0, 3, record=True)
    one = session(scene, "pd-imu", suite)
    one.press(RIGHT)  # is not listened to
    states = np.concatenate([one.step() for _ in range(60)])
    np.testing.assert_allclose(states, rollout.qpos[0, : len(states)], atol=1e-9)


def test_the_next_round_of_a_suite_is_another_one(scene: Scene) -> None:
    """That of the next seed; who stands still falls in every corner."""
    one = session(scene, "none", "corner")
    while one.falls < 2:
        one.step()
    third = draw_suite(scene.task, scene.robot, "corner", 1, 60.0, seed=5).scenario
    np.testing.assert_array_equal(one.env.state.scenario.targets, third.targets)


def test_a_push_by_key_comes_beside_those_of_a_suite(scene: Scene) -> None:
    one, other = session(scene, suite="push"), session(scene, suite="push")
    for _ in range(8):
        one.step()
        other.step()
    one.press(PUSH_KEY)
    root = scene.trunk_quat[0] - 3
    ways = [np.ptp(x[:, root : root + 2], axis=0) for x in (one.step(), other.step())]
    assert np.linalg.norm(ways[0]) > 4 * np.linalg.norm(ways[1])


def test_who_acts_sees_where_the_keyed_board_goes(scene: Scene) -> None:
    """The scenario, read at the decision's own time, is the board that MuJoCo then has."""
    seen: list[View] = []
    stand = make_controller("pd-attitude", scene)

    def watch(view: View) -> np.ndarray:
        seen.append(view)
        return stand(view)

    one = Session(scene, watch)
    states = []
    for number in range(12):
        if number in (2, 3, 7):
            one.press((RIGHT, DOWN, LEFT)[number % 3])
        states.append(board(scene, one.step())[-1])
    expected = [
        board_angle(one.task, view.scenario, np.asarray([[(view.env_steps + 1) * 0.2]]))[0, 0]
        for view in seen
    ]
    np.testing.assert_allclose(states, expected, atol=0.05)
    assert np.abs(expected).max() >= 1
