"""Engines of training against evaluation, in closed loop, each robot driven by what it sees."""

import dataclasses
import types
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import mujoco
import numpy as np
import pytest
from fixtures.fleet import episodes_of
from mujoco import mjx

from mjx_balance.config import Config
from mjx_balance.evaluation.rollout import roll_out
from mjx_balance.sim.engines.mujoco import MujocoEngine
from mjx_balance.sim.engines.table import make_engine
from mjx_balance.sim.scene import Scene, scene_dir
from mjx_balance.task.randomization import DomainParams
from mjx_balance.task.step import Targets

ENVS, EPISODE = 32, 50


class Course(NamedTuple):
    """What one engine gave, (decisions, ENVS, ...); before the decision, but for the tilt."""

    obs: np.ndarray
    imu: np.ndarray
    action: np.ndarray
    qpos: np.ndarray
    tilt: np.ndarray


@pytest.fixture(scope="module")
def courses(fleet: Any, closed_loop: list[Any]) -> tuple[Course, Course]:
    """Of training's engine and of evaluation's."""
    env, before, after = fleet.env, closed_loop[:-1], closed_loop[1:]
    ours = Course(
        np.asarray([s.obs for s in before]),
        np.asarray([s.pipeline_state.memory.imu for s in before]),
        np.asarray([s.info["action"] for s in after]),
        np.asarray([s.pipeline_state.physics.qpos for s in before]),
        np.asarray([s.metrics["tilt_deg"] for s in after]),
    )
    act, views, actions = fleet.feedback(EPISODE), [], []

    def watched(view: Any) -> np.ndarray:
        views.append(view)
        actions.append(act(view.obs, view.env_steps))
        return actions[-1]

    rollout = roll_out(env.scene, watched, episodes_of(closed_loop[0]), 10.0)
    assert not rollout.fell.any()
    theirs = Course(
        np.asarray([view.obs for view in views]),
        np.asarray([view.imu for view in views]),
        np.asarray(actions),
        np.asarray([view.qpos for view in views]),
        rollout.tilt.reshape(ENVS, EPISODE, -1).mean(axis=-1).T,
    )
    return ours, theirs


@pytest.fixture(scope="module")
def alike(courses: tuple[Course, Course]) -> np.ndarray:
    """(decisions, ENVS) whether all actions before a decision were the same in both engines.

    A float32 observation that lies at the edge of two actions may choose the other one.
    """
    ours, theirs = courses
    same = np.logical_and.accumulate(ours.action == theirs.action, axis=0)
    return np.concatenate((np.ones((1, ENVS), bool), same[:-1]))


def test_robots_of_both_engines_choose_the_same(alike: np.ndarray) -> None:
    """Over 10 s, each by its own observations; measured: 0.992 of all decisions."""
    assert alike[:25].mean() > 0.95
    assert alike.mean() > 0.9


@pytest.mark.parametrize(
    ("name", "size", "most"),
    [
        # The same unit as the quantity; measured 0.0005, 0.0004, 1e-5 and 8e-5 for `most`.
        ("obs", 2.2, 0.002),
        ("imu", 3.6, 0.002),
        ("qpos", 0.7, 1e-4),
        ("tilt", 0.4, 5e-4),
    ],
)
def test_nominal_robots_agree_step_by_step(
    courses: tuple[Course, Course], alike: np.ndarray, name: str, size: float, most: float
) -> None:
    """Of 99 values in 100: to 0.05% of how much they vary, what float32 leaves after 10 s."""
    ours, theirs = (getattr(course, name)[:, : ENVS // 2] for course in courses)
    difference = np.abs(ours - theirs)[alike[:, : ENVS // 2]]
    assert np.percentile(difference, 99) < most
    assert difference.max() < 20 * most
    assert theirs.std() > size / 2, "there is something to agree on"


@pytest.mark.parametrize(("name", "most"), [("obs", 0.01), ("imu", 0.006), ("tilt", 0.006)])
def test_randomised_robots_agree_step_by_step(
    courses: tuple[Course, Course], alike: np.ndarray, name: str, most: float
) -> None:
    """Payload, friction, gains and latency; a foot that slips takes the engines apart a little.

    Of 99 values in 100; measured 0.003, 0.0014, 0.0017.
    """
    ours, theirs = (getattr(course, name)[:, ENVS // 2 :] for course in courses)
    difference = np.abs(ours - theirs)[alike[:, ENVS // 2 :]]
    assert np.percentile(difference, 99) < most
    assert np.median(difference) < most / 100


def test_imu_channels_agree_one_by_one(courses: tuple[Course, Course], alike: np.ndarray) -> None:
    """All 50 samples of all decisions: order, units, time; gyro first, then accelerometer."""
    ours, theirs = (course.imu[:, : ENVS // 2] for course in courses)
    for channel in range(6):
        difference = np.abs(ours - theirs)[alike[:, : ENVS // 2], :, channel]
        spread = theirs[..., channel].std()
        assert np.percentile(difference, 99) < 0.008 * spread, channel
        # A sample taken one physics step later is another one.
        shifted = np.abs(ours[:, :, 1:] - theirs[:, :, :-1])[..., channel]
        assert shifted.mean() > 20 * difference.mean(), channel


def test_both_engines_balance_alike_to_the_end(courses: tuple[Course, Course]) -> None:
    """Also where they once chose differently: mean and 95th percentile of tilt, and actions."""
    ours, theirs = courses
    for half in (slice(None, ENVS // 2), slice(ENVS // 2, None)):
        a, b = ours.tilt[:, half], theirs.tilt[:, half]
        assert 0.3 < b.mean() < 2
        assert a.mean() == pytest.approx(b.mean(), abs=0.005)
        assert np.percentile(a, 95) == pytest.approx(np.percentile(b, 95), abs=0.02)
        moved = [np.abs(np.stack(np.divmod(x.action[:, half], 21)) - 10).mean() for x in courses]
        assert moved[0] == pytest.approx(moved[1], rel=0.01)
        assert moved[0] > 2, "levels of 0.3 mm"


def test_feedback_is_what_keeps_the_robots_up(courses: tuple[Course, Course]) -> None:
    """Domain parameters matter: the delayed and loaded half tilts more than the nominal one."""
    tilt = courses[1].tilt
    assert tilt[:, ENVS // 2 :].mean() > 1.3 * tilt[:, : ENVS // 2].mean()


def test_mjx_solves_as_the_config_says_and_leaves_the_scene_alone(
    config: Config, scene: Scene, monkeypatch: pytest.MonkeyPatch
) -> None:
    seen = []

    def put_model(model: Any, *args: Any, **kwargs: Any) -> Any:
        seen.append((model.opt.iterations, model.opt.ls_iterations, model.opt.timestep))
        assert not model.jnt_limited.any()
        return original(model, *args, **kwargs)

    original = mjx.put_model
    monkeypatch.setattr(mjx, "put_model", put_model)
    config = dataclasses.replace(config, solver_iterations=7, line_search_iterations=9)
    engine = make_engine(config, scene)
    state, ctrl = engine.initial(), jnp.zeros((1, scene.model.nu))
    jax.eval_shape(lambda: engine.physics(state, ctrl, None))
    assert seen == [(7, 9, 0.004)]
    assert scene.model.opt.iterations == 100
    assert scene.model.opt.ls_iterations == 50
    assert scene.model.jnt_limited.sum() == 12
    for name in ("qpos", "qvel", "qacc_warmstart"):
        stance = getattr(scene.stance, name)
        np.testing.assert_allclose(getattr(state, name), stance, rtol=1e-6, atol=1e-7)


@pytest.mark.parametrize("fleet", [pytest.param("mjx", marks=pytest.mark.slow)], indirect=True)
def test_matrix_products_of_the_physics_are_exact(fleet: Any) -> None:
    """TF32 would do on a GPU what nobody asked for: all but the observation's are `highest`."""
    products = [line for line in fleet.program.splitlines() if "dot_general" in line]
    exact = [line for line in products if line.count("HIGHEST") == 2]
    assert len(products) > 20
    assert len(exact) / len(products) > 0.9


def test_every_servo_gets_its_own_target(scene: Scene, xp: types.ModuleType) -> None:
    """Whatever order a model has its servos in."""
    order = np.random.default_rng(0).permutation(14)
    mixed = dataclasses.replace(
        scene, board_ctrl=order[:2], leg_ctrl=order[2:].reshape(4, 3), stance=scene.stance
    )
    board = np.asarray([[(0.1, 0.2), (0.3, 0.4)]])
    joints = 1 + np.arange(24.0).reshape(1, 2, 4, 3)
    ctrl = np.asarray(mixed.ctrl(Targets(xp.asarray(board), xp.asarray(joints))))
    assert ctrl.shape == (1, 2, 14)
    for step in range(2):
        for axis in range(2):
            assert ctrl[0, step, order[axis]] == pytest.approx(board[0, step, axis])
        for leg, joint in np.ndindex(4, 3):
            told = joints[0, step, leg, joint] + scene.stance.leg_trim[leg, joint]
            assert ctrl[0, step, order[2 + 3 * leg + joint]] == pytest.approx(told, rel=1e-6)


def test_c_engine_is_mj_step(scene: Scene) -> None:
    """Robots 1 and 3 of four, 50 steps of servo targets each; the others stay where they are."""
    engine = MujocoEngine(scene, 4, threads=1)
    rng, ids = np.random.default_rng(0), np.asarray((1, 3))
    hold = np.zeros(scene.model.nu)
    hold[scene.leg_ctrl] = scene.stance.qpos[scene.leg_qpos] + scene.stance.leg_trim
    ctrl = hold + 0.02 * rng.uniform(-1, 1, (2, 50, scene.model.nu))
    motion, qpos_path = engine.roll(ids, ctrl, None), engine.recorded["qpos"]
    for row, number in enumerate(ids):
        data = mujoco.MjData(scene.model)
        data.qpos, data.qvel = scene.stance.qpos, scene.stance.qvel
        data.qacc_warmstart = scene.stance.qacc_warmstart
        for step in range(50):
            data.ctrl = ctrl[row, step]
            mujoco.mj_step(scene.model, data)
            sensors = [data.sensor(f"robot/{name}").data for name in ("gyro", "accelerometer")]
            np.testing.assert_allclose(qpos_path[row, step], data.qpos, atol=1e-12)
            legs = data.qpos[scene.leg_qpos]
            np.testing.assert_allclose(motion.joint_angles[row, step], legs, atol=1e-12)
            np.testing.assert_allclose(motion.imu[row, step], np.concatenate(sensors), atol=1e-9)
            turn = np.zeros(9)
            mujoco.mju_quat2Mat(turn, data.joint("robot/root").qpos[3:])
            tilt = np.degrees(np.arccos(turn[8]))
            assert motion.tilt[row, step] == pytest.approx(tilt, abs=1e-5)
        qpos, qvel, _ = engine.state()
        np.testing.assert_allclose(qpos[number], data.qpos, atol=1e-12)
        np.testing.assert_allclose(qvel[number], data.qvel, atol=1e-11)
    for still in (0, 2):
        np.testing.assert_array_equal(engine.state()[0][still], scene.stance.qpos)


def test_a_push_gives_the_robot_its_momentum_at_once(scene: Scene) -> None:
    """0.3 m/s of 15.2 kg are 4.56 N s along x; no turn, no board, nobody else."""
    engine, ids = MujocoEngine(scene, 3, threads=1), np.asarray((0, 2))
    engine.push(ids, np.asarray([(0.3, -0.1), (0.0, 0.2)]))
    free = scene.model.jnt_dofadr[scene.model.joint("robot/root").id]
    trunk, board = scene.model.body("robot/trunk").id, scene.model.body("board/board").id
    for k, (x, y) in enumerate([(0.3, -0.1), (0, 0), (0, 0.2)]):
        qpos, qvel, _ = engine.state()
        data = mujoco.MjData(scene.model)
        data.qpos, data.qvel = qpos[k], qvel[k] - scene.stance.qvel
        np.testing.assert_allclose(data.qvel[free : free + 3], (x, y, 0), atol=1e-12)
        assert np.count_nonzero(np.abs(data.qvel) > 1e-12) == np.count_nonzero((x, y))
        mujoco.mj_forward(scene.model, data)
        mujoco.mj_subtreeVel(scene.model, data)
        mass = scene.model.body_subtreemass[trunk]
        momentum = mass * data.subtree_linvel[trunk]
        np.testing.assert_allclose(momentum, (15.2 * x, 15.2 * y, 0), atol=1e-3)
        np.testing.assert_allclose(data.subtree_angmom[trunk], 0, atol=1e-9)
        np.testing.assert_allclose(data.subtree_linvel[board], 0, atol=1e-12)


def test_c_engine_warns_of_the_robot_that_diverges_alone(scene: Scene) -> None:
    engine = MujocoEngine(scene, 3, threads=2)
    ctrl = np.zeros((2, 5, scene.model.nu))
    ctrl[1, 2] = np.nan
    ids = np.asarray((0, 2))
    for given in (ctrl, 0 * ctrl[:, :1]):
        for values in engine.roll(ids, given, None):
            assert np.isnan(values[1]).all()
            assert np.isfinite(values[0]).all()


def test_domain_parameters_are_those_of_models_made_so(scene: Scene) -> None:
    """Payload as a body of its own, other servos and soles: compiled by MuJoCo, stepped by it.

    The first load sits on the trunk's axis. The second does not, and the products of inertia
    that are left out show a little.
    """
    params = DomainParams(
        imu_noise=np.zeros((2, 6)),
        payload=np.asarray((3.0, 5.0)),
        payload_at=np.asarray(((0.0, 0.0, 0.1), (0.05, -0.04, 0.08))),
        friction=np.asarray(((0.5, 0.6, 0.7, 0.8), (0.9, 0.4, 0.9, 0.9))),
        gain=np.linspace(0.7, 1.1, 24).reshape(2, 4, 3),
        delay=np.zeros(2),
        softness=np.zeros(2),
    )
    engine = MujocoEngine(scene, 2, threads=1)
    hold = np.zeros(scene.model.nu)
    hold[scene.leg_ctrl] = scene.stance.qpos[scene.leg_qpos] + scene.stance.leg_trim
    ctrl = np.tile(hold, (2, 150, 1))
    turning = 0.00025 * np.arange(150)[:, None]  # 3.6 deg/s
    ctrl[:, :, scene.board_ctrl] = turning * (1.0, -0.7)
    engine.roll(np.arange(2), ctrl, params)
    path_of = engine.recorded["qpos"]
    for k, most in ((0, 1e-7), (1, 2e-4)):
        model = loaded_model(
            scene,
            *(np.asarray(x)[k] for x in params[1:5]),  # load, at, friction, gain
        )
        data = mujoco.MjData(model)
        data.qpos, data.qvel = scene.stance.qpos, scene.stance.qvel
        data.qacc_warmstart = scene.stance.qacc_warmstart
        path = []
        for row in ctrl[k]:
            data.ctrl = row
            mujoco.mj_step(model, data)
            path.append(data.qpos.copy())
        np.testing.assert_allclose(path_of[k], path, atol=most)
    assert np.abs(path_of[0] - path_of[1]).max() > 0.003, "they matter"


def loaded_model(
    scene: Scene, load: float, at: np.ndarray, friction: np.ndarray, gain: np.ndarray
) -> mujoco.MjModel:
    """A robot that carries a small heavy body, from the scene's files."""
    stage, board, body = (
        mujoco.MjSpec.from_file(str(scene_dir() / name))
        for name in ("scene.xml", "board.xml", "quadruped.xml")
    )
    carried = body.body("trunk").add_body(name="load", pos=at)
    carried.mass, carried.ipos, carried.inertia = load, [0, 0, 0], [1e-9] * 3
    carried.explicitinertial = True
    stage.attach(board, prefix="board/", frame=stage.worldbody.add_frame())
    stage.attach(body, prefix="robot/", frame=stage.worldbody.add_frame(pos=[0, 0, 0.35]))
    for leg, own, servos in zip(("LF", "RF", "LH", "RH"), friction, gain, strict=True):
        for joint, share in zip(("abduction", "hip", "knee"), servos, strict=True):
            servo = stage.actuator(f"robot/{leg}_{joint}")
            servo.gainprm[0] *= share
            servo.biasprm[1] *= share
        stage.add_pair(
            geomname1=f"robot/{leg}_foot",
            geomname2="board/board",
            condim=3,
            friction=[own, own, 0.005, 0.0001, 0.0001],
            solref=[0.01, 1],
        )
    stage.option.timestep = 0.004
    return stage.compile()
