"""Reflections: a group by itself, and true of the physics."""

import dataclasses

import numpy as np
import pytest
from mjx_balance.plant import View

from mjx_balance.config import Config
from mjx_balance.evaluation import roll_out
from mjx_balance.scene import Scene
from mjx_balance.suites import make_scenarios
from mjx_balance.task.actions import action_table
from mjx_balance.task.observation import observation_names
from mjx_balance.task.symmetry import Symmetries, symmetries

LEFT_RIGHT, FRONT_HIND = 2, 1


@pytest.fixture(scope="module")
def group(config: Config) -> Symmetries:
    return symmetries(config.task, config.robot)


def reflect(group: Symmetries, which: int, obs: np.ndarray) -> np.ndarray:
    return obs[..., group.obs_index[which]] * group.obs_sign[which]


def test_each_reflection_undoes_itself_and_two_make_the_third(group: Symmetries) -> None:
    obs, actions = np.arange(1.0, 35.0), np.arange(441)
    np.testing.assert_array_equal(reflect(group, 0, obs), obs)
    np.testing.assert_array_equal(group.action_index[0], actions)
    for k in range(4):
        np.testing.assert_array_equal(reflect(group, k, reflect(group, k, obs)), obs)
        np.testing.assert_array_equal(group.action_index[k][group.action_index[k]], actions)
    np.testing.assert_array_equal(
        reflect(group, LEFT_RIGHT, reflect(group, FRONT_HIND, obs)), reflect(group, 3, obs)
    )


def test_reflections_by_hand(config: Config, group: Symmetries) -> None:
    names = observation_names(config.task, config.robot)
    mirrored = [names[i] for i in group.obs_index[LEFT_RIGHT]]
    assert mirrored[:4] == ["H_RF", "H_LF", "H_RH", "H_LH"]
    turned = [n for n, s in zip(names, group.obs_sign[LEFT_RIGHT], strict=True) if s < 0]
    assert all(name.startswith(("V_x", "Acc_y")) for name in turned)
    assert len(turned) == 15
    mirrored = [names[i] for i in group.obs_index[FRONT_HIND]]
    assert mirrored[:4] == ["H_LH", "H_RH", "H_LF", "H_RF"]
    more = dataclasses.replace(config.task, command_lags=(0,))
    group, names = symmetries(more, config.robot), observation_names(more, config.robot)
    mirrored = [names[i] for i in group.obs_index[LEFT_RIGHT]]
    assert mirrored[:9] == [
        *("H_RF H_LF H_RH H_LH C_RF,d-0 C_LF,d-0 C_RH,d-0 C_LH,d-0 V_x,t-0".split())
    ]
    assert (group.obs_sign[LEFT_RIGHT][:8] == 1).all()
    table = 1000 * action_table(config.task)
    np.testing.assert_allclose(table[group.action_index[LEFT_RIGHT]], table * (-1, 1), atol=1e-6)
    np.testing.assert_allclose(table[group.action_index[FRONT_HIND]], table * (1, -1), atol=1e-6)


@pytest.mark.parametrize(
    ("which", "signs", "tolerance"), [(LEFT_RIGHT, (-1, 1), 0.02), (FRONT_HIND, (1, -1), 0.6)]
)
def test_the_robot_on_a_mirrored_board_sees_the_mirrored_world(
    config: Config,
    scene: Scene,
    group: Symmetries,
    which: int,
    signs: tuple[int, int],
    tolerance: float,
) -> None:
    """Left-right to a fiftieth of a degree; the legs bend backward, so front-hind roughly."""
    scenarios, _ = make_scenarios(config, "paper", 1, 3.0, 0)
    actions = np.random.default_rng(0).integers(0, 441, 15)
    seen: dict[bool, list[np.ndarray]] = {False: [], True: []}
    for mirrored in (False, True):

        def act(view: View, mirrored: bool = mirrored) -> np.ndarray:
            seen[mirrored].append(view.obs[0])
            action = actions[view.decision]
            return np.full(1, group.action_index[which][action] if mirrored else action)

        targets = scenarios.targets * (signs if mirrored else (1, 1))
        roll_out(scene, config, act, scenarios._replace(targets=targets), 3.0)
    expected = reflect(group, which, np.asarray(seen[False]))
    error = np.asarray(seen[True]) - expected
    assert np.sqrt(np.mean(error**2)) < tolerance * np.sqrt(np.mean(expected**2))
