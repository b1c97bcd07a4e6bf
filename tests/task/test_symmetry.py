"""Reflections: a group by itself, and true of the physics."""

import dataclasses

import numpy as np
import pytest
from fixtures.fleet import observation_names

from mjx_balance.config import Config
from mjx_balance.envs.batch import Episodes
from mjx_balance.evaluation.controllers import View
from mjx_balance.evaluation.rollout import Rollout, roll_out
from mjx_balance.evaluation.suites import draw_suite
from mjx_balance.robots.catalogue import Robot
from mjx_balance.sim.scene import Scene
from mjx_balance.task.actions import action_table, apply_action
from mjx_balance.task.observation import input_rows
from mjx_balance.task.randomization import DomainParams
from mjx_balance.task.symmetry import Symmetries, symmetries
from mjx_balance.task.tilt import Scenario


@pytest.fixture(scope="module")
def rich(config: Config) -> Config:
    """Observations with commands and means, of unequally many gyro and accelerometer lags."""
    task = dataclasses.replace(
        config.task,
        command_lags=(0, 1),
        gyro_lags=(0, 7),
        accel_lags=(0, 3, 9),
        imu_mean=2,
        mean_times=(1.0,),
        filter_times=(4.0, 1.0),
    )
    return dataclasses.replace(config, task=task)


@pytest.fixture(params=["paper", "rich"])
def any_config(config: Config, rich: Config, request: pytest.FixtureRequest) -> Config:
    """With the observation of Eq. 2, and with a richer one."""
    return {"paper": config, "rich": rich}[request.param]


def reflect(group: Symmetries, obs: np.ndarray) -> np.ndarray:
    """Observations (..., obs_size) as they look in the mirror."""
    return obs[..., group.obs_index[1]] * group.obs_sign[1]


def test_the_identity_and_one_mirror_that_is_its_own_inverse(
    any_config: Config, robot: Robot
) -> None:
    """Front-hind is none: all knees bend backward (0.024 deg in the stance, 5% in motion)."""
    group = symmetries(any_config.task, robot)
    size = len(input_rows(any_config.task, robot))
    obs, actions = np.arange(1.0, size + 1), np.arange(441)
    assert group.obs_index.shape == group.obs_sign.shape == (2, size)
    np.testing.assert_array_equal(group.obs_index[0], range(size))
    np.testing.assert_array_equal(group.obs_sign[0], 1)
    np.testing.assert_array_equal(group.action[0], actions)
    np.testing.assert_array_equal(reflect(group, reflect(group, obs)), obs)
    np.testing.assert_array_equal(group.action[1][group.action[1]], actions)


def test_left_right_by_name(any_config: Config, robot: Robot) -> None:
    """Roll, its rate, lateral acceleration and a_x turn; left and right legs swap."""
    group = symmetries(any_config.task, robot)
    names = observation_names(any_config.task, robot)
    legs = {"LF": "RF", "RF": "LF", "LH": "RH", "RH": "LH"}
    for k, name in enumerate(names):
        leg = name.split(",")[0][2:]
        expected = name.replace(leg, legs[leg]) if leg in legs else name
        assert names[group.obs_index[1][k]] == expected
        turned = name.startswith(("V_x", "Acc_y", "Angle_x"))
        assert group.obs_sign[1][k] == (-1 if turned else 1), name
    table = 1000 * action_table(any_config.task)
    np.testing.assert_allclose(table[group.action[1]], table * (-1, 1), atol=1e-6)


def test_legs_in_another_order_have_the_same_partners(any_config: Config, robot: Robot) -> None:
    """FR RL FL RR: sides count, not letters."""
    other = dataclasses.replace(robot, legs=tuple(robot.legs[k] for k in (1, 2, 0, 3)))
    assert [leg.left for leg in other.legs] == [False, True, True, False]
    group = symmetries(any_config.task, other)
    assert group.obs_index[1][:4].tolist() == [2, 3, 0, 1]
    change = np.asarray((0.001, 0.002))
    moved = apply_action(other, np.full(4, 0.35), change)
    np.testing.assert_allclose(1000 * moved - 350, (1, -1, 3, -3), atol=1e-9)


def loaded(side: float) -> DomainParams:
    """A load on the left or right shoulder, weak servos, delayed actions: (n,) = (2,)."""
    load, at = np.asarray((3.0, 0.0)), np.tile((0.04, 0.05 * side, 0.08), (2, 1))
    friction, delay = np.full((2, 4), 0.7), np.asarray((0.0, 1.0))
    gain = np.asarray((0.9, 1.0))[:, None, None] * np.ones((4, 3))
    return DomainParams(np.zeros((2, 6)), load, at, friction, gain, delay, np.zeros(2))


def test_the_robot_on_a_mirrored_board_sees_the_mirrored_world(
    rich: Config, robot: Robot, scene: Scene
) -> None:
    """3 s of random actions, observations and tilts to 1e-9: left-right is exact."""
    scene, group = dataclasses.replace(scene, task=rich.task), symmetries(rich.task, robot)
    drawn = draw_suite(rich.task, robot, "paper", 2, 3.0, 0).scenario
    actions = np.random.default_rng(0).integers(0, 441, (15, 2))

    def run(scenario: Scenario, actions: np.ndarray, side: float) -> tuple[np.ndarray, Rollout]:
        seen = []

        def act(view: View) -> np.ndarray:
            seen.append(view.obs)
            return actions[view.env_steps]

        rollout = roll_out(scene, act, Episodes(scenario, loaded(side)), 3.0)
        return np.asarray(seen), rollout

    seen, rollout = run(drawn, actions, 1.0)
    mirrored = drawn._replace(targets=drawn.targets * (-1, 1))
    reflected, other = run(mirrored, group.action[1][actions], -1.0)
    assert np.abs(seen[-1]).max() > 1, "something moved"
    np.testing.assert_allclose(reflected, reflect(group, seen), atol=1e-9)
    np.testing.assert_allclose(other.tilt, rollout.tilt, atol=1e-9)
