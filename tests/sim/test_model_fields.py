"""Fields of a loaded robot's model, against MuJoCo's own set-up of it."""

import math
import types

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from mujoco.batch import Batch
from scipy.spatial.transform import Rotation

from mjx_balance.config import RandomizationConfig, preset
from mjx_balance.robots.catalogue import find_robot
from mjx_balance.robots.limits import for_robot
from mjx_balance.sim.domain_randomization import randomized_fields
from mjx_balance.sim.engines.mujoco import MujocoEngine
from mjx_balance.sim.scene import Scene, load_scene
from mjx_balance.task.randomization import DRAWS, DomainParams, draw_params
from mjx_balance.task.step import Targets

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
    fields = lambda u: randomized_fields(scene, draw_params(WORST, robot, u))  # noqa: E731
    got = (fields if xp is np else jax.jit(fields))(xp.asarray(uniform, xp.float32))
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
    got = randomized_fields(scene, load)
    principal = np.diag(axes.T @ whole @ axes)
    np.testing.assert_allclose(got["body_inertia"][trunk.id], principal, rtol=1e-9)
    np.testing.assert_allclose(got["body_mass"][trunk.id], mass + added)
    np.testing.assert_allclose(got["body_ipos"][trunk.id], centre, atol=1e-12)


THREE = DomainParams(
    imu_noise=np.zeros((3, 6)),
    payload=np.asarray((0.0, 4.0, 2.5)),
    payload_at=np.asarray(((0.01, 0.02, 0.03), (0.05, -0.04, 0.08), (0.0, 0.0, 0.1))),
    friction=np.asarray(((0.8,) * 4, (0.4,) * 4, (0.6, 0.5, 0.4, 0.3))),
    gain=np.asarray((np.ones((4, 3)), np.full((4, 3), 1.1), np.arange(1, 13).reshape(4, 3) / 10)),
    delay=np.zeros(3),
    softness=np.zeros(3),
)
"""Nominal; loaded off the centre; loaded on the axis, every foot and servo in its own way."""


def test_friction_and_gain_reach_every_foot_and_leg_and_nothing_else(scene: Scene) -> None:
    model, fields = scene.model, randomized_fields(scene, THREE)
    board = scene.board_ctrl
    for k, (friction, gain) in enumerate(zip(THREE.friction, THREE.gain, strict=True)):
        for leg, own, servos in zip(scene.robot.legs, friction, gain, strict=True):
            touching = model.pair(f"{leg.name}_contact")
            geoms = (model.geom(int(x[0])).name for x in (touching.geom1, touching.geom2))
            assert f"robot/{leg.foot}" in geoms
            row = (own, own, 0.005, 0.0001, 0.0001)
            np.testing.assert_allclose(fields["pair_friction"][k, touching.id], row)
            for joint, share in zip(leg.joints, servos, strict=True):
                servo = model.actuator(f"robot/{joint}").id
                assert fields["actuator_gainprm"][k, servo, 0] == pytest.approx(400 * share)
                assert fields["actuator_biasprm"][k, servo, 1] == pytest.approx(-400 * share)
        for name in ("actuator_gainprm", "actuator_biasprm"):
            ours, nominal = fields[name][k].copy(), getattr(model, name)
            np.testing.assert_array_equal(ours[board], nominal[board])
            np.testing.assert_array_equal(ours[:, 2:], nominal[:, 2:])
    trunk = model.body("robot/trunk").id
    for name in ("body_mass", "body_ipos", "body_inertia"):
        ours, nominal = fields[name], getattr(model, name)
        others = np.arange(model.nbody) != trunk
        np.testing.assert_array_equal(ours[:, others], np.stack([nominal[others]] * 3))


def test_soft_servos_are_a_softer_robots_and_hold_it_where_it_stands(scene: Scene) -> None:
    """Gains between those of two robot files; half soft is their geometric mean.

    The trim of the stiff servos would let the soft ones sag by 6.7 times their own error.
    """
    soft = find_robot("quadruped_soft")
    assert (soft.servo_stiffness, soft.servo_damping) == (60.0, 4.0)  # ours has 400 and 16
    params = THREE._replace(
        payload=np.zeros(3), friction=np.full((3, 4), 0.8), gain=np.ones((3, 4, 3))
    )._replace(softness=np.asarray((0.0, 0.5, 1.0)))
    fields = randomized_fields(scene, params)
    legs = scene.leg_ctrl.ravel()
    stiffness = fields["actuator_gainprm"][:, legs, 0]
    np.testing.assert_allclose(stiffness, [[x] * 12 for x in (400, math.sqrt(24_000), 60)])
    np.testing.assert_allclose(fields["actuator_biasprm"][:, legs, 1], -stiffness)
    dofs = [scene.model.joint(f"robot/{n}").dofadr[0] for x in scene.robot.legs for n in x.joints]
    np.testing.assert_allclose(fields["dof_damping"][:, dofs], [[x] * 12 for x in (16, 8, 4)])
    others = np.setdiff1d(np.arange(scene.model.nv), dofs)
    np.testing.assert_array_equal(
        fields["dof_damping"][:, others], [scene.model.dof_damping[others]] * 3
    )
    engine, angles = MujocoEngine(scene, 3, threads=1), scene.stance.qpos[scene.leg_qpos]
    still = Targets(np.zeros((3, 500, 2)), np.broadcast_to(angles, (3, 500, 4, 3)))
    engine.advance(np.arange(3), still, params)
    own, *softer = engine.recorded["qpos"]
    np.testing.assert_allclose(softer, [own] * 2, atol=2e-4)
    assert np.abs(scene.stance.leg_trim).max() > 0.01


def test_nominal_params_are_the_model_and_one_env_in_jax_is_its_row(scene: Scene) -> None:
    alone = DomainParams(*(jnp.asarray(x[1]) for x in THREE))
    in_jax = jax.jit(lambda params: randomized_fields(scene, params))(alone)
    for name, values in randomized_fields(scene, THREE).items():
        assert values.shape == (3, *getattr(scene.model, name).shape)
        np.testing.assert_allclose(values[0], getattr(scene.model, name), rtol=1e-6, atol=1e-9)
        np.testing.assert_allclose(in_jax[name], values[1], rtol=1e-5, atol=1e-8, err_msg=name)
