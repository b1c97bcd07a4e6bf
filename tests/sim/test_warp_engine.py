"""MJX-Warp inside a jitted program, on a CPU: the same physics, buffers that hold every contact."""

import copy
import importlib.util
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from fixtures.fleet import episodes_of

from mjx_balance.config import ConfigError
from mjx_balance.evaluation.rollout import roll_out
from mjx_balance.sim.engines import warp
from mjx_balance.sim.engines.table import make_engine
from mjx_balance.sim.scene import Scene

pytestmark = [pytest.mark.warp, pytest.mark.slow]
pytest.importorskip("warp", reason="needs warp-lang, the extra `warp`")

ENVS, DECISIONS = 8, 10


@pytest.fixture(scope="module")
def warped(make_fleet: Any) -> Any:
    """The envs of `fleet`, fewer, over Warp."""
    return make_fleet("warp", ENVS)


@pytest.fixture(scope="module")
def scene(warped: Any) -> Scene:
    return warped.env.scene


def test_training_and_evaluation_have_the_same_physics(warped: Any) -> None:
    """Closed loop, half of the envs nominal, half under payload, friction, gains and latency."""
    env = warped.env
    start = warped.reset(warped.keys(1))
    start = warped.under(start, warped.half_nominal(jax.device_get(start.pipeline_state.params)))
    act = warped.feedback(DECISIONS)
    states = warped.drive(start, act, DECISIONS)
    rollout = roll_out(
        env.scene,
        lambda view: act(view.obs, view.env_steps),
        episodes_of(start),
        DECISIONS * env.config.task.ctrl_dt,
        record=True,
    )
    assert rollout.qpos is not None
    qpos = np.asarray([state.pipeline_state.physics.qpos for state in states[1:]])
    np.testing.assert_allclose(qpos, rollout.qpos[:, 49::50].swapaxes(0, 1), atol=3e-6)
    tilt = np.asarray([state.metrics["tilt_deg"] for state in states[1:]])
    theirs = rollout.tilt.reshape(ENVS, DECISIONS, -1).mean(axis=-1).T
    np.testing.assert_allclose(tilt, theirs, atol=6e-5)
    assert theirs.mean() > 0.3, "there is something to agree on"
    assert (np.ptp(qpos, axis=1).max(axis=-1) > 0.001).all(), "robots differ"


@pytest.mark.parametrize(("contacts", "rows"), [(2, 24), (4, 8)])
def test_a_full_buffer_is_an_error(
    contacts: int, rows: int, monkeypatch: pytest.MonkeyPatch, warped: Any, scene: Scene
) -> None:
    """A contact that finds no room would be dropped: the robot would sink, and train on."""
    monkeypatch.setattr(warp, "contact_room", lambda model: (contacts, rows))
    engine = make_engine(warped.env.config, scene)
    physics = jax.jit(jax.vmap(engine.physics))
    state = jax.tree.map(lambda x: jnp.tile(x, (2, 1)), engine.initial())
    hold = np.zeros((2, 3, scene.model.nu), np.float32)
    hold[..., scene.leg_ctrl] = scene.stance.qpos[scene.leg_qpos] + scene.stance.leg_trim
    said = rf"room for {contacts} contacts and {rows} constraint rows per env"
    with pytest.raises(jax.errors.JaxRuntimeError, match=said):
        jax.block_until_ready(physics(state, hold, None))


def test_one_call_has_all_envs_however_they_are_vmapped() -> None:
    """Buffers follow from the number of envs of a call: seeds times envs, the shared repeated."""
    seen = []

    def double(x: jax.Array, tree: Any) -> tuple[jax.Array, Any]:
        seen.append((x.shape, jax.tree.map(jnp.shape, tree)))
        return 2 * x, jax.tree.map(lambda y: y + 1, tree)

    batched = warp.over_all_envs(double)
    x = jnp.arange(24.0).reshape(3, 4, 1, 2)
    shared = jnp.arange(4.0).reshape(4, 1)
    y, (z, none) = jax.vmap(jax.vmap(batched), in_axes=(0, None))(x, (shared, None))
    assert seen[-1] == ((12, 2), ((12,), None))
    np.testing.assert_array_equal(y, 2 * x)
    np.testing.assert_array_equal(z, np.tile(shared + 1, (3, 1, 1)))
    assert none is None


def test_buffers_hold_every_foot_on_the_board(scene: Scene) -> None:
    """Four spheres on a box: a contact each, three rows for its cone; one for a joint's limit."""
    assert warp.contact_room(scene.model) == (4, 4 * 3 + 12)
    free = copy.copy(scene.model)
    free.jnt_limited[:] = False
    assert warp.contact_room(free) == (4, 4 * 3)


def test_an_engine_that_is_not_installed_is_refused(
    warped: Any, scene: Scene, monkeypatch: pytest.MonkeyPatch
) -> None:
    found = importlib.util.find_spec
    monkeypatch.setattr(
        importlib.util, "find_spec", lambda name, *a: None if name == "warp" else found(name, *a)
    )
    with pytest.raises(ConfigError, match="engine is warp, and warp-lang is not installed; inst"):
        make_engine(warped.env.config, scene)
