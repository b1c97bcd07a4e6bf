"""What is paired in an evaluation is paired: a scenario's noise is its own."""

import dataclasses
from collections.abc import Callable

import numpy as np

from mjx_balance.config import Config
from mjx_balance.controllers import View
from mjx_balance.evaluation import run_suite
from mjx_balance.scene import Scene

STAND, LEFT_UP = 220, 20 * 21 + 10


def samples_of_first(
    scene: Scene, config: Config, count: int, act: Callable[[View], np.ndarray]
) -> np.ndarray:
    """IMU samples of scenario 0 as its controller sees them, (decisions, sim_steps, 6)."""
    seen = []

    def watch(view: View) -> np.ndarray:
        seen.append(view.imu[0])
        return act(view)

    run_suite(scene, config, watch, "noise", count, 2.0, 5)
    return np.asarray(seen)


def stand(view: View) -> np.ndarray:
    return np.full(len(view.ids), STAND)


def others_fall(view: View) -> np.ndarray:
    return np.where(view.ids == 0, STAND, LEFT_UP)


def test_noise_of_a_scenario_does_not_depend_on_the_others(config: Config, scene: Scene) -> None:
    alone = samples_of_first(scene, config, 1, stand)
    np.testing.assert_array_equal(samples_of_first(scene, config, 3, stand), alone)
    np.testing.assert_array_equal(samples_of_first(scene, config, 3, others_fall), alone)


def test_scenarios_and_decisions_have_noise_of_their_own(config: Config, scene: Scene) -> None:
    seen = []

    def watch(view: View) -> np.ndarray:
        seen.append(view.imu)
        return stand(view)

    level = dataclasses.replace(config.task, max_incline=1e-6)
    run_suite(scene, dataclasses.replace(config, task=level), watch, "noise", 2, 0.6, 5)
    _, first, second = (imu - scene.stance.imu for imu in seen)
    for a, b in ((first[0], first[1]), (first[0], second[0])):
        assert abs(np.corrcoef(a[:, 2], b[:, 2])[0, 1]) < 0.5
