"""Baselines: each does what its knowledge allows."""

import numpy as np
import pytest
from mjx_balance.baselines import (
    CONTROLLERS,
    ControllerError,
    as_it_will_be,
    at_this_rate,
    make_controller,
    measure_response,
)

from mjx_balance.config import Config
from mjx_balance.evaluation import run_suite, summarize
from mjx_balance.scene import Scene
from mjx_balance.task.actions import action_table, nearest_action
from mjx_balance.task.tilt import Scenario


def test_nearest_action_by_hand(config: Config) -> None:
    """Steps of 0.3 mm, ends at 3 mm."""
    table = 1000 * action_table(config.task)
    wanted = np.asarray(((0.0, 0.0), (0.14, -0.16), (9.0, -9.0), (-1.34, 2.86))) / 1000
    got = table[nearest_action(config.task, wanted)]
    np.testing.assert_allclose(got, ((0, 0), (0, -0.3), (3, -3), (-1.2, 3.0)), atol=1e-5)


def test_response_is_that_of_the_robots_geometry(config: Config, scene: Scene) -> None:
    """Raising the left by a tilts by a / half-track, raising the front by -a / hip_x."""
    response = measure_response(scene, config)
    robot = config.robot
    expected = np.degrees((1 / robot.half_track, -1 / robot.hip_x))
    np.testing.assert_allclose(response.gain, expected, rtol=0.08)
    assert np.abs(response.course[:, 0]).max() < 0.1
    np.testing.assert_allclose(response.course[:, 100:], 1.0, atol=0.05)


def test_forecasts_of_a_ramp() -> None:
    """The board turns at 3 deg/s about X until 6 deg, from time 0."""
    from mjx_balance.config import TaskConfig

    scenario = Scenario(np.asarray([[[6.0, 0.0]]]), np.zeros(1), np.full(1, 3.0))
    ahead = np.asarray((0.5, 1.0, 2.0))
    task = TaskConfig()
    moving = np.asarray([1.0])
    np.testing.assert_allclose(at_this_rate(task, scenario, moving, ahead)[0, :, 0], (1.5, 3, 6))
    np.testing.assert_allclose(as_it_will_be(task, scenario, moving, ahead)[0, :, 0], (1.5, 3, 3))
    at_first = np.zeros(1)
    assert not at_this_rate(task, scenario, at_first, ahead).any(), "it does not know the future"
    np.testing.assert_allclose(as_it_will_be(task, scenario, at_first, ahead)[0, 1], (3, 0))


def test_knowing_more_means_tilting_less(config: Config, scene: Scene) -> None:
    mean, falls = {}, {}
    for name in CONTROLLERS:
        controller = make_controller(name, scene, config)
        result = summarize(
            run_suite(scene, config, controller, "paper", 8, 25.0, 5), "paper", 25.0, 5
        )
        mean[name], falls[name] = result["tilt_deg"]["mean"], result["falls"]
    assert falls["none"] > 0
    assert not any(n for name, n in falls.items() if name != "none")
    order = "none pd-imu pd-attitude rate-oracle clairvoyant".split()
    assert sorted(order, key=lambda name: -mean[name]) == order
    assert mean["rate-oracle"] < 0.1


def test_the_oracles_know_of_latency(config: Config, scene: Scene) -> None:
    """A controller that does not takes back the same tilt twice."""

    def mean(name: str) -> float:
        controller = make_controller(name, scene, config)
        return float(run_suite(scene, config, controller, "latency", 4, 20.0, 5).tilt.mean())

    means = {name: mean(name) for name in ("pd-attitude", "rate-oracle", "clairvoyant")}
    assert means["clairvoyant"] < means["rate-oracle"] < 0.3 < 0.6 < means["pd-attitude"]


def test_filters_keep_every_worlds_own_memory(config: Config, scene: Scene) -> None:
    """A world's tilt does not depend on which others run, or fall, beside it."""
    controller = make_controller("pd-imu", scene, config)
    many = run_suite(scene, config, controller, "corner", 3, 4.0, 0).tilt
    alone = run_suite(scene, config, controller, "corner", 1, 4.0, 0).tilt
    np.testing.assert_allclose(many[0], alone[0], atol=1e-9)


def test_unknown_controller_is_refused(config: Config, scene: Scene) -> None:
    with pytest.raises(ControllerError, match="unknown controller 'lqr'; known controllers: none"):
        make_controller("lqr", scene, config)
