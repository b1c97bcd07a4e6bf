"""MuJoCo's C engine inside a jitted program: the same env as over MJX, call by call."""

import dataclasses
from collections.abc import Iterator
from contextlib import contextmanager
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from fixtures.fleet import RANDOM, episodes_of, with_state

from mjx_balance.config import preset
from mjx_balance.envs.balance import BalanceEnv
from mjx_balance.evaluation.rollout import roll_out
from mjx_balance.machine import cores
from mjx_balance.robots.catalogue import find_robot
from mjx_balance.sim.engines import ffi
from mjx_balance.sim.engines.jax_engine import JaxEngine, PhysicsState
from mjx_balance.sim.engines.mujoco import MujocoEngine
from mjx_balance.sim.engines.mujoco_ffi import _Pool
from mjx_balance.sim.engines.table import make_engine
from mjx_balance.sim.scene import Scene, load_scene
from mjx_balance.task.randomization import DRAWS, DomainParams, draw_params

ENVS, EPISODE, STAND = 32, 50, 220
CONFIG = dataclasses.replace(preset("default"), engine="mujoco")


@pytest.fixture(scope="module")
def compiled(make_fleet: Any) -> Any:
    """The envs of the fixture `fleet`, over the C engine."""
    return make_fleet("mujoco")


@pytest.fixture(scope="module")
def scene() -> Scene:
    return load_scene(CONFIG)


@pytest.fixture(scope="module")
def engine(scene: Scene) -> JaxEngine:
    return make_engine(CONFIG, scene)


def in_double(tree: Any) -> dict[str, np.ndarray]:
    return {name: np.asarray(x, float) for name, x in tree._asdict().items()}


def test_training_and_evaluation_have_the_same_physics(compiled: Any) -> None:
    """10 s under feedback, payload, friction, gains and latency; what differs is float32."""
    env, start = compiled.env, compiled.reset(compiled.keys(1))
    quiet = start.pipeline_state.params._replace(imu_noise=jnp.zeros((ENVS, 6)))
    act = compiled.feedback(EPISODE)
    states = compiled.drive(compiled.under(start, quiet), act, EPISODE)
    tilt = np.asarray([state.metrics["tilt_deg"] for state in states[1:]])
    rollout = roll_out(
        env.scene,
        lambda view: act(view.obs, view.env_steps),
        episodes_of(states[0]),
        10.0,
        record=True,
    )
    assert not rollout.fell.any()
    theirs = rollout.tilt.reshape(ENVS, EPISODE, -1).mean(axis=-1).T
    assert rollout.qpos is not None
    # The first second, before an observation at the edge of two actions has chosen another one.
    qpos = np.asarray([state.pipeline_state.physics.qpos for state in states[1:6]])
    np.testing.assert_allclose(qpos, rollout.qpos[:, 49:250:50].swapaxes(0, 1), atol=2e-5)
    np.testing.assert_allclose(tilt[:5], theirs[:5], atol=2e-4)
    assert tilt.mean() == pytest.approx(theirs.mean(), rel=0.01)
    assert np.percentile(tilt, 95) == pytest.approx(np.percentile(theirs, 95), rel=0.02)
    assert tilt.max() == pytest.approx(theirs.max(), rel=0.05)


def random_params(seed: int, count: int) -> DomainParams:
    """Domain parameters of envs."""
    uniform = np.random.default_rng(seed).uniform(size=(count, DRAWS)).astype(np.float32)
    return jax.tree.map(jnp.asarray, draw_params(RANDOM, find_robot("quadruped"), uniform))


def moved(engine: JaxEngine, state: PhysicsState, ctrl: Any, params: DomainParams | None) -> Any:
    axes = (0, 0, None if params is None else 0)
    return jax.device_get(jax.jit(jax.vmap(engine.physics, axes))(state, ctrl, params))


def held(engine: JaxEngine, count: int) -> tuple[PhysicsState, jax.Array]:
    """Robots at rest that are told 50 random things near to where they stand."""
    state = jax.tree.map(lambda x: jnp.tile(x, (count, 1)), engine.initial())
    scene = engine.scene
    hold = np.zeros(scene.model.nu)
    hold[scene.leg_ctrl] = scene.stance.qpos[scene.leg_qpos] + scene.stance.leg_trim
    noise = np.random.default_rng(0).normal(size=(count, 50, scene.model.nu))
    return state, jnp.asarray(hold + 0.01 * noise, jnp.float32)


def test_a_call_depends_on_its_arguments_alone(fleet: Any, scene: Scene, engine: JaxEngine) -> None:
    """Whatever parameters, numbers of envs and devices were called for before."""
    state, ctrl = held(engine, 6)
    first, second = random_params(0, 6), random_params(1, 6)
    mixed = jax.tree.map(lambda a, b: a.at[2:4].set(b[2:4]), first, second)
    plain = jax.tree.map(jnp.asarray, fleet.nominal(6))
    cases = [plain, first, plain, second, None, mixed, first, None, second, mixed]
    results: dict[int, Any] = {}
    for case in cases:
        result = moved(engine, state, ctrl, case)
        before = results.setdefault(id(case), result)
        jax.tree.map(np.testing.assert_array_equal, result, before)
    one, two, both = (results[id(case)][0].qpos for case in (first, second, mixed))
    np.testing.assert_array_equal(both[2:4], two[2:4])
    np.testing.assert_array_equal(both[:2], one[:2])
    assert (one != two).any(axis=1).all()
    few = moved(engine, *(jax.tree.map(lambda x: x[1:3], x) for x in (state, ctrl, second)))
    np.testing.assert_array_equal(few[0].qpos, two[1:3])


def test_a_decision_is_that_of_the_c_engine(scene: Scene, engine: JaxEngine) -> None:
    """State, IMU and tilt of robots under loads, against the engine that evaluates."""
    state, ctrl = held(engine, 4)
    params = random_params(0, 4)
    after, motion = moved(engine, state, ctrl, params)
    plain = MujocoEngine(scene, 4)
    plain.set_state(*(np.asarray(x, float) for x in state))
    params = DomainParams(**in_double(params))
    expected = plain.roll(np.arange(4), np.asarray(ctrl, float), params)
    for name in motion._fields:
        ours, theirs = getattr(motion, name), getattr(expected, name)
        np.testing.assert_allclose(ours, theirs, rtol=1e-5, atol=1e-6)
    for name, value in zip(after._fields, plain.state(), strict=True):
        np.testing.assert_allclose(getattr(after, name), value, rtol=1e-5, atol=1e-6)


def test_seeds_of_envs_are_rows_of_one_batch(scene: Scene, engine: JaxEngine) -> None:
    state, ctrl = held(engine, 6)
    params = random_params(3, 6)
    flat = moved(engine, state, ctrl, params)
    split = jax.tree.map(lambda x: x.reshape(2, 3, *x.shape[1:]), (state, ctrl, params))
    nested = jax.device_get(jax.jit(jax.vmap(jax.vmap(engine.physics)))(*split))
    jax.tree.map(lambda a, b: np.testing.assert_array_equal(a.reshape(b.shape), b), nested, flat)
    alone = jax.device_get(
        jax.jit(engine.physics)(*jax.tree.map(lambda x: x[5], (state, ctrl, params)))
    )
    jax.tree.map(lambda a, b: np.testing.assert_array_equal(a, b[5]), alone, flat)


def test_two_devices_move_their_own_robots(scene: Scene, engine: JaxEngine) -> None:
    """Twenty calls at once on both: the boards of each are those of one device."""
    state, ctrl = held(engine, 8)
    params = random_params(4, 8)
    mesh = jax.make_mesh((2,), ("d",), axis_types=(jax.sharding.AxisType.Auto,))
    split = jax.sharding.PartitionSpec("d")

    def many(state: PhysicsState, ctrl: jax.Array, params: DomainParams) -> PhysicsState:
        step = lambda state, _: (jax.vmap(engine.physics)(state, ctrl, params)[0], None)  # noqa: E731
        return jax.lax.scan(step, state, length=20)[0]

    shared = jax.jit(
        jax.shard_map(many, mesh=mesh, in_specs=split, out_specs=split, check_vma=False)
    )
    jax.tree.map(
        np.testing.assert_array_equal,
        jax.device_get(shared(state, ctrl, params)),
        jax.device_get(jax.jit(many)(state, ctrl, params)),
    )


def test_the_tilt_of_a_simulation_that_warns_is_no_number(scene: Scene, engine: JaxEngine) -> None:
    """MuJoCo stops at a position beyond its bounds, where everything is finite still."""
    state, ctrl = held(engine, 3)
    far = state._replace(qpos=state.qpos.at[1, 0].set(1e11))
    _, motion = moved(engine, far, ctrl, None)
    assert np.isnan(motion.tilt).all(axis=1).tolist() == [False, True, False]
    assert np.isfinite(motion.tilt[::2]).all()


@pytest.mark.slow
def test_no_leg_comes_to_its_limits(compiled: Any) -> None:
    """MJX leaves the limits out. Half a minute of the greatest actions, each held for 2 s.

    Under loads of up to 5 kg and with weak servos; measured: 0.07 rad are left.
    """
    scene = compiled.env.scene
    assert scene.model.jnt_limited.sum() == 12
    bounds = {scene.model.jnt_qposadr[k]: scene.model.jnt_range[k] for k in range(15)}
    ranges = np.asarray([[bounds[at] for at in leg] for leg in scene.leg_qpos])
    lowest, highest = ranges[..., 0], ranges[..., 1]
    state, rng, left = compiled.reset(compiled.keys(0)), np.random.default_rng(0), np.inf
    actions = rng.choice((0, 20, 420, 440), (15, ENVS)).repeat(10, axis=0)
    for number, action in enumerate(actions):
        state = compiled.step(state, jnp.asarray(action))
        angles = np.asarray(state.pipeline_state.physics.qpos)[:, scene.leg_qpos]
        left = min(left, float(np.minimum(angles - lowest, highest - angles).min()))
        over, fresh = np.asarray(state.done) > 0, compiled.reset(compiled.keys(1 + number))
        state = jax.tree.map(
            lambda new, old: jnp.where(over.reshape(-1, *[1] * (old.ndim - 1)), new, old),  # noqa: B023
            fresh,
            state,
        )
    assert 0.03 < left < 0.3


@pytest.mark.parametrize("broken", [np.nan, 1e12, 1e30])
def test_a_robot_that_diverges_is_seen_and_leaves_the_others_alone(
    compiled: Any, broken: float
) -> None:
    start = compiled.reset(compiled.keys(2))
    physics = start.pipeline_state.physics
    spoilt = physics._replace(qvel=physics.qvel.at[3, 8].set(broken))
    action = jnp.full(ENVS, STAND)
    after, sound = (
        jax.device_get(compiled.step(with_state(start, physics=x), action))
        for x in (spoilt, physics)
    )
    assert after.metrics["diverged"].tolist() == [float(k == 3) for k in range(ENVS)]
    assert sound.metrics["diverged"].sum() == 0
    assert after.done[3] == 1
    assert np.isfinite(after.obs).all()
    others = np.arange(ENVS) != 3
    np.testing.assert_array_equal(after.obs[others], sound.obs[others])
    # The engine that has seen this is as good as new.
    again = jax.device_get(compiled.step(start, action))
    np.testing.assert_array_equal(again.obs, sound.obs)


def test_what_a_host_function_raises_ends_the_program() -> None:
    def refuse(arguments: Any, results: Any) -> None:
        raise ValueError(f"no {arguments[0].shape}")

    ffi.register("test.refuse", refuse)
    call = jax.ffi.ffi_call("test.refuse", jax.ShapeDtypeStruct((), jnp.float32))
    with pytest.raises(jax.errors.JaxRuntimeError, match=r"ValueError: no \(3, 2\)"):
        jax.block_until_ready(call(jnp.zeros((3, 2))))


def test_host_functions_see_the_buffers_themselves() -> None:
    def reverse(arguments: Any, results: Any) -> None:
        (x, scalar), (y, z) = arguments, results
        y[...], z[...] = x[::-1], scalar + x.sum()

    ffi.register("test.reverse", reverse)
    ffi.register("test.reverse", lambda *_: None)  # known already
    shapes = [jax.ShapeDtypeStruct((2, 3), jnp.float32), jax.ShapeDtypeStruct((), jnp.float32)]
    call = jax.jit(jax.ffi.ffi_call("test.reverse", shapes))
    y, z = call(jnp.arange(6.0).reshape(2, 3), jnp.float32(0.5))
    assert y.tolist() == [[3, 4, 5], [0, 1, 2]]
    assert z == 15.5
    assert "test.reverse" in ffi.registered()
    with pytest.raises(jax.errors.JaxRuntimeError, match="buffer 0 is of XLA's type 4; it must"):
        jax.block_until_ready(call(jnp.arange(6).reshape(2, 3), jnp.float32(0.5)))


def test_an_env_says_which_engine_it_has(compiled: Any) -> None:
    assert compiled.env.backend == "mujoco"
    assert BalanceEnv().backend == "mjx"


def test_an_engine_is_used_again_where_its_models_are_right(scene: Scene) -> None:
    """By the device whose parameters it has had; no two calls at once have the same."""
    pool, ids = _Pool(scene, 1), np.arange(4)
    first, second = (DomainParams(**in_double(random_params(k, 4))) for k in (0, 1))
    with pool._borrowed(4, first) as one, pool._borrowed(4, second) as other:
        assert one is not other
        one._randomize(ids, first)
        other._randomize(ids, second)
    for _ in range(2):
        with pool._borrowed(4, first) as again:
            assert again is one
        with pool._borrowed(4, second) as again:
            assert again is other
    with pool._borrowed(4, None) as plain:
        assert plain not in (one, other)


def test_results_are_copied_before_another_device_has_the_engine(
    scene: Scene, engine: JaxEngine, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Here one borrows the engine as soon as it is free again, and puts its robots to rest."""
    pool, ids = _Pool(scene, 1), np.arange(2)
    borrowed = pool._borrowed

    @contextmanager
    def contested(count: int, params: DomainParams | None) -> Iterator[MujocoEngine]:
        with borrowed(count, params) as own:
            yield own
        with borrowed(count, params) as same:
            assert same is own
            same.reset(ids)

    monkeypatch.setattr(pool, "_borrowed", contested)
    state, ctrl = jax.device_get(held(engine, 2))
    alone = MujocoEngine(scene, 2)
    alone.set_state(*(np.asarray(x, float) for x in state))
    motion = alone.roll(ids, np.asarray(ctrl, float), None)
    expected = *alone.state(), *motion
    results = [np.empty(x.shape, np.float32) for x in expected]
    pool.advance([*state, ctrl], results)
    for ours, theirs in zip(results, expected, strict=True):
        np.testing.assert_allclose(ours, theirs, rtol=1e-5, atol=1e-6)


def test_engines_of_other_threads_have_other_names(scene: Scene) -> None:
    """A second env of the scene, over more devices, does not get the first one's threads."""
    before = set(ffi.registered())
    for devices in (1, 2):
        make_engine(dataclasses.replace(CONFIG, num_devices=devices), scene)
    threads = {max(1, cores() // devices) for devices in (1, 2)}
    ours = {f"mjx_balance.{scene.hash}.{count}" for count in threads}
    assert ours <= set(ffi.registered())
    assert set(ffi.registered()) - before <= ours
