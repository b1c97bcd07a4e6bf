"""Fields of a loaded robot's model, against MuJoCo's own set-up of it."""

import types

import numpy as np
import pytest
from mujoco.batch import Batch
from scipy.spatial.transform import Rotation

from mjx_balance.config import RandomizationConfig, preset
from mjx_balance.robots.catalogue import Robot
from mjx_balance.robots.limits import for_robot
from mjx_balance.sim.domain_randomization import randomized_fields
from mjx_balance.sim.scene import Scene, load_scene
from mjx_balance.task.randomization import DRAWS, draw_params

WORST = RandomizationConfig(payload=8.0, payload_offset=0.1, friction_min=0.3, gain_spread=0.3)


@pytest.fixture(params=("quadruped", "go2"))
def any_scene(request: pytest.FixtureRequest) -> Scene:
    """Go2's trunk has principal axes that are not its frame's."""
    return load_scene(for_robot(preset("default"), request.param))


def test_inverse_weights_are_those_that_mujoco_computes(
    xp: types.ModuleType, any_scene: Scene
) -> None:
    """MJX takes them as they are; they scale every contact and limit."""
    scene, robot = any_scene, any_scene.robot
    uniform = np.random.default_rng(0).uniform(size=(5, DRAWS))
    batch = Batch(scene.model, 5, 1)
    plain = randomized_fields(scene, draw_params(WORST, robot, uniform))
    for name in ("body_mass", "body_ipos", "body_inertia"):
        batch.expand(name)[...] = plain[name]
    expected = [batch.expand(name) for name in ("body_invweight0", "dof_invweight0")]
    nominal = [np.array(values) for values in expected]
    batch.set_const()
    assert np.abs(expected[0] / np.maximum(nominal[0], 1e-9) - 1).max() > 0.2, "it matters"
    got = randomized_fields(scene, draw_params(WORST, robot, xp.asarray(uniform, xp.float32)))
    rtol = 1e-6 if xp is np else 1e-3
    for name, values in zip(("body_invweight0", "dof_invweight0"), expected, strict=True):
        np.testing.assert_allclose(np.asarray(got[name]), values, rtol=rtol, atol=1e-7)


def test_a_payload_by_full_tensors_in_the_trunks_own_axes() -> None:
    """Go2's: turned by a quarter about y, nearly; the products about its principal axes go."""
    scene = load_scene(for_robot(preset("default"), "go2"))
    load = draw_params(WORST, scene.robot, np.full(DRAWS, 0.8))
    trunk = scene.model.body("robot/base")
    mass, added, at = trunk.mass[0], float(load.payload), load.payload_at
    axes = Rotation.from_quat(trunk.iquat, scalar_first=True).as_matrix()
    centre = (mass * trunk.ipos + added * at) / (mass + added)
    whole = axes @ np.diag(trunk.inertia) @ axes.T
    for weight, place in ((mass, trunk.ipos), (added, at)):
        arm = place - centre
        whole = whole + weight * (arm @ arm * np.eye(3) - np.outer(arm, arm))
    got = randomized_fields(scene, load)["body_inertia"][trunk.id]
    np.testing.assert_allclose(got, np.diag(axes.T @ whole @ axes), rtol=1e-9)


def test_without_a_payload_nothing_changes(any_scene: Scene) -> None:
    scene, robot = any_scene, any_scene.robot
    uniform = np.full((1, DRAWS), 0.5)
    fields = randomized_fields(scene, draw_params(RandomizationConfig(), robot, uniform))
    for name, values in fields.items():
        before = getattr(scene.model, name)
        assert values.shape == (1, *before.shape), name
        np.testing.assert_allclose(values[0], before, rtol=1e-9, atol=1e-12, err_msg=name)


def test_one_robot_and_a_batch_of_one_agree(robot: Robot, scene: Scene) -> None:
    uniform = np.random.default_rng(1).uniform(size=DRAWS)
    one = randomized_fields(scene, draw_params(WORST, robot, uniform))
    many = randomized_fields(scene, draw_params(WORST, robot, uniform[None]))
    for name, values in one.items():
        assert values == pytest.approx(many[name][0]), name
