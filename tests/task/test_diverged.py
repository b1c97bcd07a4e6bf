"""A simulation that diverges is a fall, and nothing of it reaches the learner."""

import types

import numpy as np
import pytest

from mjx_balance.config import Config
from mjx_balance.robots.catalogue import Robot
from mjx_balance.sim.scene import Scene
from mjx_balance.task import kinematics, step

BAD = (float("nan"), float("inf"), -float("inf"), 3e38)


def outcome_of(xp, config: Config, robot: Robot, scene: Scene, **spoilt: float):
    """A decision of two standing robots at 4 deg, with a value of the second one spoilt."""
    task = config.task
    still = xp.asarray(np.tile(scene.stance.imu, (2, 1)), xp.float32)
    memory = step.initial_memory(task, robot, still)._replace(
        tilt=xp.asarray((4.0, 4.0), xp.float32)
    )
    arrays = {
        "samples": np.tile(scene.stance.imu, (2, task.sim_steps, 1)),
        "tilts": np.full((2, task.sim_steps), 4.0),
        "angles": np.tile(kinematics.joint_angles(robot, np.full(4, 0.35)), (2, 1, 1)),
    }
    for name, value in spoilt.items():
        arrays[name].reshape(2, -1)[1, 17 % arrays[name][0].size] = value
    given = {name: xp.asarray(array, xp.float32) for name, array in arrays.items()}
    motion = step.Motion(given["samples"], given["tilts"], given["angles"][:, None])
    with np.errstate(over="ignore", invalid="ignore"):
        return step.post_step(task, robot, memory, motion)


@pytest.mark.parametrize("value", BAD)
@pytest.mark.parametrize("name", ["samples", "tilts", "angles"])
def test_a_diverged_env_is_a_fall_with_finite_values(
    xp: types.ModuleType, config: Config, robot: Robot, scene: Scene, name: str, value: float
) -> None:
    memory, got = outcome_of(xp, config, robot, scene, **{name: value})
    np.testing.assert_array_equal(np.asarray(got.terminated), (False, True))
    np.testing.assert_array_equal(np.asarray(got.diverged), (False, True))
    for array in (got.obs, *got.rewards.values(), *memory, got.tilt):
        assert np.isfinite(np.asarray(array)).all()
        assert np.abs(np.asarray(array)).max() < 1e3
    # As for any fall: the tilt counts as 6 deg, -0.5 on top. exp(-1.5 * 6) = 0.00012.
    rewards = {key: float(np.asarray(term)[1]) for key, term in got.rewards.items()}
    assert rewards["fail"] == -0.5
    assert rewards["level"] == pytest.approx(0.4 * 1.234e-4, rel=1e-3)
    assert rewards["toward"] == pytest.approx(1.0 * (4 - 6) / 2.5)


def test_a_diverged_env_leaves_the_others_alone(
    xp: types.ModuleType, config: Config, robot: Robot, scene: Scene
) -> None:
    _, whole = outcome_of(xp, config, robot, scene)
    _, spoilt = outcome_of(xp, config, robot, scene, samples=float("nan"))
    np.testing.assert_array_equal(np.asarray(whole.obs)[0], np.asarray(spoilt.obs)[0])
    assert not np.asarray(whole.diverged).any()


def test_a_fall_is_no_divergence(
    xp: types.ModuleType, config: Config, robot: Robot, scene: Scene
) -> None:
    _, got = outcome_of(xp, config, robot, scene, tilts=6.5)
    np.testing.assert_array_equal(np.asarray(got.terminated), (False, True))
    assert not np.asarray(got.diverged).any()
