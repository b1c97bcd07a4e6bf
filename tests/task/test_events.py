"""What happens in the middle of an episode: drawn by hand, from its decision on, in the physics."""

import dataclasses
import types
from functools import partial
from typing import Any

import jax
import numpy as np
import pytest
from fixtures.arrays import put

from mjx_balance import BalanceEnv
from mjx_balance.config import Config, RandomizationConfig
from mjx_balance.envs.batch import BatchEnv, Episodes, draw_episodes
from mjx_balance.robots.catalogue import Robot
from mjx_balance.sim.scene import Scene
from mjx_balance.task.events import Event, draw_event, params_now
from mjx_balance.task.randomization import DomainParams
from mjx_balance.task.tilt import Scenario

RANGES = RandomizationConfig(
    payload_offset=0.04,
    payload_height=0.07,
    event_payload=5.0,
    event_grip=0.1,
    event_strength=0.2,
)
BEFORE = DomainParams(
    imu_noise=np.zeros((2, 6)),
    payload=np.asarray((1.0, 2.0)),
    payload_at=np.zeros((2, 3)),
    friction=np.full((2, 4), 0.8),
    gain=np.full((2, 4, 3), 0.9),
    delay=np.zeros(2),
    softness=np.zeros(2),
)


def test_every_draw_lands_in_its_own_field(
    xp: types.ModuleType, robot: Robot, compiled: Any
) -> None:
    """When, load, its place on x and y, which foot, its grip, which servo, its strength."""
    draws = np.asarray([[0.5, 0.2, 0.75, 0.0, 0.6, 0.5, 0.45, 0.25], [0.0, 1, 0, 1, 0, 0, 0.99, 0]])
    draw = compiled(partial(draw_event, RANGES, robot, decisions=300))
    event = draw(params=put(xp, BEFORE), uniform=xp.asarray(draws))
    assert event.due.tolist() == [120, 60], "0.4 and 0.2 of 300 decisions"
    np.testing.assert_allclose(event.payload, (1, 5), rtol=1e-6)
    at = ((0.02, -0.04, 0.07), (-0.04, 0.04, 0.07))
    np.testing.assert_allclose(event.payload_at, at, rtol=1e-5)
    np.testing.assert_allclose(event.grip, ((1, 1, 0.55, 1), (0.1, 1, 1, 1)), rtol=1e-5)
    strength = np.ones((2, 4, 3))
    strength[0, 1, 2], strength[1, 3, 2] = 0.4, 0.2  # servos 5 and 11 of 12
    np.testing.assert_allclose(event.strength, strength, rtol=1e-5)


def test_what_is_not_among_the_ranges_stays(robot: Robot) -> None:
    draws = np.random.default_rng(0).uniform(size=(2, 8))
    for ranges, changed in (
        (RandomizationConfig(event_payload=3.0), {"payload", "payload_at"}),
        (RandomizationConfig(event_grip=0.5), {"friction"}),
        (RandomizationConfig(event_strength=0.5), {"gain"}),
    ):
        assert ranges.happens
        assert ranges.varies
        event = draw_event(ranges, robot, BEFORE, 300, draws)
        after = params_now(event, BEFORE, np.full(2, 299))
        differ = {n for n in after._fields if (getattr(after, n) != getattr(BEFORE, n)).any()}
        assert differ == changed
    assert not RandomizationConfig(payload=5.0).happens


def test_it_holds_from_its_decision_on(xp: types.ModuleType) -> None:
    """Decisions 4 and 5 of an event at 5: nothing, then everything, on top of what was."""
    event = Event(
        due=np.full(2, 5),
        payload=np.asarray((3.0, 0.0)),
        payload_at=np.tile((0.01, 0.02, 0.03), (2, 1)),
        grip=np.tile((1.0, 1.0, 0.5, 1.0), (2, 1)),
        strength=np.full((2, 4, 3), 0.5),
    )
    now = params_now(put(xp, event), put(xp, BEFORE), xp.asarray((4, 5)))
    for got, before in zip(now, BEFORE, strict=True):
        np.testing.assert_allclose(got[0], before[0], rtol=1e-6)
    np.testing.assert_allclose(now.payload[1], 0)
    np.testing.assert_allclose(now.payload_at[1], (0.01, 0.02, 0.03), rtol=1e-6)
    np.testing.assert_allclose(now.friction[1], (0.8, 0.8, 0.4, 0.8), rtol=1e-6)
    np.testing.assert_allclose(now.gain[1], np.full((4, 3), 0.45), rtol=1e-6)


def test_a_robot_leans_to_where_the_load_is_laid(config: Config, scene: Scene) -> None:
    """On a level board. Twin of a robot without a load until then; from then on, lower there."""
    still = Scenario(np.zeros((2, 2, 2)), np.zeros(2), np.full(2, 3.5))
    nothing = BEFORE._replace(payload=np.zeros(2), gain=np.ones((2, 4, 3)))
    event = Event(
        due=np.asarray((3, 99)),
        payload=np.full(2, 5.0),
        payload_at=np.tile((0.05, 0.04, 0.08), (2, 1)),
        grip=np.ones((2, 4)),
        strength=np.ones((2, 4, 3)),
    )
    env = BatchEnv(scene, Episodes(still, nothing, event=event), threads=1)
    for decision in range(5):
        env.step(np.zeros((2, 2)))
        if decision < 3:
            np.testing.assert_array_equal(*env.qpos[:, scene.trunk_quat])
    _, about_x, about_y, _ = env.qpos[0, scene.trunk_quat]
    assert about_x < -2e-4, "down on the left"
    assert about_y > 2e-4, "down in front"


@pytest.mark.parametrize("field", ["event_grip", "event_strength"])
def test_training_draws_events_as_evaluation_does(config: Config, field: str) -> None:
    """An env in JAX and one in NumPy: in the middle of the episode, one foot or servo of each."""
    ranges = RandomizationConfig(**{field: 0.25})
    random = dataclasses.replace(config, engine="mujoco", randomization=ranges)
    env = BalanceEnv(random)
    reset = jax.jit(jax.vmap(lambda key: env.reset(key).pipeline_state.event))
    ours = jax.device_get(reset(jax.random.split(jax.random.PRNGKey(0), 200)))
    rngs = [np.random.default_rng(k) for k in range(200)]
    theirs = draw_episodes(config.task, ranges, env.scene.robot, rngs).event
    for event in (ours, theirs):
        assert 60 <= event.due.min() < 70
        assert 170 < event.due.max() <= 180
        values = (event.grip if field == "event_grip" else event.strength).reshape(200, -1)
        assert (np.sort(values, axis=1)[:, 1:] == 1).all()
        assert 0.25 <= values.min() < 0.27
        assert (values.min(axis=0) < 0.7).all(), "each of them in some env"
