"""A board that keys tilt, and a robot that they kick."""

import numpy as np
import pytest

from mjx_balance.controllers import Controller, make_controller
from mjx_balance.evaluation import run_suite
from mjx_balance.scene import Scene
from mjx_balance.suites import SuiteError
from mjx_balance.viewing import DOWN, KICK_KEY, LEFT, LEVEL, RIGHT, UP, Session


def session(scene: Scene, name: str = "pd-attitude", suite: str | None = None) -> Session:
    return Session(scene, make_controller(name, scene), suite, seed=3)


def board(scene: Scene, states: np.ndarray) -> np.ndarray:
    """(sim_steps, 2) true angles of the board, deg."""
    return np.degrees(states[:, scene.board_qpos])


@pytest.mark.parametrize(
    ("keys", "wanted"),
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
    scene: Scene, keys: tuple[int, ...], wanted: tuple[float, float]
) -> None:
    """A degree each, as far as the legs reach, at the board's own rate of 3.5 deg/s."""
    one = session(scene)
    for key in keys:
        one.press(key)
    states = np.stack([one.decide() for _ in range(25)])
    np.testing.assert_allclose(board(scene, states[-1])[-1], wanted, atol=0.05)
    way = np.abs(np.diff(np.asarray([board(scene, x)[-1] for x in states]), axis=0)).max()
    assert way <= 0.7 + 0.02
    assert one.falls == 0
    assert one.tilt < 0.5


def test_a_target_that_changes_on_the_way(scene: Scene) -> None:
    """Turned back after 0.4 s, at 1.4 deg, the board goes on from there, without a jump."""
    one = session(scene)
    for _ in range(5):
        one.press(RIGHT)
    path = [board(scene, one.decide()) for _ in range(2)]
    one.press(LEVEL)
    path += [board(scene, one.decide()) for _ in range(4)]
    roll = np.concatenate(path)[:, 0]
    assert roll.max() == pytest.approx(1.4, abs=0.05)
    assert np.abs(np.diff(roll)).max() < 0.03
    assert roll[-1] == pytest.approx(0, abs=0.05)


def test_a_kick_moves_the_robot_once(scene: Scene) -> None:
    one, other = session(scene), session(scene)
    one.press(KICK_KEY)
    kicked, quiet = one.decide(), other.decide()
    root = scene.trunk_quat[0] - 3
    way = np.linalg.norm(kicked[1, root : root + 2] - quiet[1, root : root + 2])
    assert way == pytest.approx(0.4 * 0.008, rel=0.15), "0.4 m/s over two physics steps"
    assert not one.kicked.any()


def test_who_falls_is_put_back_up_on_a_level_board(scene: Scene) -> None:
    one = session(scene, "none")
    for _ in range(8):
        one.press(RIGHT)
    for _ in range(20):
        one.decide()
        if one.falls:
            break
    assert one.falls == 1
    assert one.caption() == ("body tilt\nboard\nfalls", "0.00 deg\n+0.0, +0.0 deg\n1")
    np.testing.assert_allclose(one.decide()[0], scene.stance.qpos, atol=1e-3)


def test_a_suite_is_shown_as_it_is_evaluated(scene: Scene) -> None:
    """The same states as `evaluate --suite push --seed 3`, kicks and all."""
    controller: Controller = make_controller("pd-imu", scene)
    rollout = run_suite(scene, controller, "push", 1, 12.0, 3, record=True)
    assert rollout.qpos is not None
    one = session(scene, "pd-imu", "push")
    one.press(RIGHT)  # is not listened to
    states = np.concatenate([one.decide() for _ in range(60)])
    np.testing.assert_allclose(states, rollout.qpos[0], atol=1e-9)


def test_an_unknown_suite_is_refused(scene: Scene) -> None:
    with pytest.raises(SuiteError, match="unknown suite 'sea'"):
        session(scene, suite="sea")
