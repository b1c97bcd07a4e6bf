"""Continuous actions of BalanceEnv, brax's trainers on it, our learner on a pendulum of brax's."""

import dataclasses
import runpy
from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from fixtures.fleet import with_state

from mjx_balance.config import Config, ConfigError, RandomizationConfig, preset
from mjx_balance.envs.balance import BalanceEnv
from mjx_balance.envs.batch import BatchEnv, Episodes
from mjx_balance.envs.brax import wrap
from mjx_balance.evaluation.controllers import View
from mjx_balance.evaluation.rollout import roll_out, run_suite
from mjx_balance.evaluation.suites import HEADLINE, SEEDS, draw_suite
from mjx_balance.sim.scene import load_scene
from mjx_balance.task.actions import action_table

EXAMPLES = Path(__file__).parents[2] / "examples"
EPISODE = 8
"""Decisions; a robot that lifts one side falls after five or six of them."""
LEFT_UP = jnp.array([1.0, 0.0])
LIFTING, STANDING, ENVS = 2, 2, 4
ACTIONS = jnp.concatenate((jnp.tile(LEFT_UP, (LIFTING, 1)), jnp.zeros((STANDING, 2))))
DECISIONS = {"ppo": 60_000, "sac": 20_000}
SCORE = {"ppo": 0.6, "sac": 0.3}
"""Mean tilt, deg, in either suite; `docs/other_algorithms.md` says what it comes to."""


def short(randomization: RandomizationConfig | None = None) -> Config:
    """Preset `default` over the C engine, which compiles in a second, with short episodes."""
    default = preset("default")
    task = dataclasses.replace(default.task, episode_length=EPISODE)
    ranges = randomization or default.randomization
    return dataclasses.replace(default, engine="mujoco", task=task, randomization=ranges)


@pytest.fixture(scope="module")
def env() -> BalanceEnv:
    return BalanceEnv(short(), "continuous")


def keys(count: int, seed: int = 0) -> jax.Array:
    return jax.random.split(jax.random.PRNGKey(seed), count)


def wrapped_states(env: Any, steps: int) -> list[Any]:
    """States of wrapped envs, two of which lift one side again and again."""
    state = jax.jit(env.reset)(keys(ENVS))
    step, states = jax.jit(env.step), [state]
    for _ in range(steps):
        states.append(step(states[-1], ACTIONS))
    return jax.device_get(states)


@pytest.fixture(scope="module")
def states(env: BalanceEnv) -> list[Any]:
    return wrapped_states(wrap(env, EPISODE), 2 * EPISODE)


@pytest.mark.slow
def test_a_continuous_action_on_the_grid_does_what_its_index_does(env: BalanceEnv) -> None:
    index = jnp.array([0, 20, 220, 225, 300, 440])
    shares = jnp.stack(jnp.divmod(index, 21), axis=-1) / 10 - 1
    start = jax.vmap(env.reset)(keys(len(index)))
    ours = jax.jit(jax.vmap(env.step))(start, shares)
    theirs = jax.jit(jax.vmap(BalanceEnv(env.config, "discrete").step))(start, index)
    jax.tree.map(lambda a, b: np.testing.assert_allclose(a, b, atol=2e-4), ours, theirs)
    heights = ours.pipeline_state.memory.heights
    assert float(jnp.ptp(heights)) == pytest.approx(4 * env.config.task.action_max, rel=1e-5)


def test_a_continuous_action_is_two_numbers(env: BalanceEnv) -> None:
    """Those beyond -1 and 1 count as these; between two levels of the grid lies a third."""
    assert env.action_size == 2
    given = jnp.array([[1.0, -1.0], [7.0, -jnp.inf], [0.123, -0.456]])
    start = jax.jit(jax.vmap(env.reset))(jnp.stack([keys(1)[0]] * 3))
    after = jax.device_get(jax.jit(jax.vmap(env.step))(start, given))
    for leaf in jax.tree.leaves(after):
        np.testing.assert_array_equal(leaf[0], leaf[1])
    moved = after.pipeline_state.memory.heights[2] - env.config.task.body_height
    ahead_left, most = moved.max(), env.config.task.action_max
    assert ahead_left == pytest.approx((0.123 + 0.456) * most, rel=1e-4)


def test_another_kind_of_action_is_refused() -> None:
    with pytest.raises(ConfigError, match="action is 'gradual'; it must be one of discrete, con"):
        BalanceEnv(action="gradual")


def test_brax_sees_falls_end_episodes_and_the_clock_cut_them_off(states: list[Any]) -> None:
    done = np.asarray([state.done for state in states])
    cut = np.asarray([state.info["truncation"] for state in states])
    for k in range(LIFTING):
        first = int(np.argmax(done[:, k]))
        assert first in (5, 6)
        assert not cut[:, k].any()
    expected = np.isin(np.arange(len(states)), (EPISODE, 2 * EPISODE))
    for k in range(LIFTING, ENVS):
        np.testing.assert_array_equal(done[:, k], expected)
        np.testing.assert_array_equal(cut[:, k], expected)


@pytest.mark.slow
def test_after_its_end_an_episode_is_as_after_a_reset(env: BalanceEnv, states: list[Any]) -> None:
    """Physics, observation, memories and clock; the scenario is another one each time."""
    fresh = jax.device_get(jax.vmap(env.reset)(keys(ENVS)))
    ends = [(n, k) for n, state in enumerate(states) for k in np.flatnonzero(state.done)]
    assert len(ends) >= LIFTING * 2 + STANDING * 2

    def parts(state: Any, k: Any) -> list[Any]:
        own = state.pipeline_state
        parts = (own.physics, own.memory, own.env_steps, state.obs, state.info["episode_length"])
        return [leaf[k] for leaf in jax.tree.leaves(parts)]

    for n, k in ends:
        state = states[n]
        for ours, expected in zip(parts(state, k), parts(fresh, k), strict=True):
            np.testing.assert_array_equal(ours, expected)
        before, after = (s.pipeline_state.scenario for s in (states[n - 1], state))
        assert before.phase[k] != after.phase[k]
        assert (before.targets[k] != after.targets[k]).any()
    begun = {float(states[n].pipeline_state.scenario.phase[k]) for n, k in ends}
    assert len(begun) == len(ends)


@pytest.mark.slow
def test_the_first_observation_is_of_the_new_scenario() -> None:
    """Of boards that start tilted; as plain MuJoCo observes them at rest on such a board."""
    config = short().replace(start_incline=5.0, episode_length=1)
    env = wrap(BalanceEnv(config, "continuous"), 1)
    first = jax.jit(env.reset)(keys(ENVS))
    second = jax.device_get(jax.jit(env.step)(first, jnp.zeros((ENVS, 2))))
    assert second.done.all()
    rngs = [np.random.default_rng(0)] * ENVS
    for state in (jax.device_get(first), second):
        episodes = Episodes(state.pipeline_state.scenario, rngs=rngs)
        expected = BatchEnv(load_scene(config), episodes).initial_obs
        np.testing.assert_allclose(state.obs, expected, atol=2e-4)


@pytest.mark.slow
def test_the_next_episode_goes_as_its_scenario_says(env: BalanceEnv, states: list[Any]) -> None:
    """What an env does that was reset by hand and given the same scenario."""
    n = EPISODE
    plain: Any = jax.vmap(env.reset)(keys(ENVS))
    plain = with_state(plain, scenario=states[n].pipeline_state.scenario)
    step = jax.jit(jax.vmap(env.step))
    for after in states[n + 1 : n + 4]:
        plain = step(plain, ACTIONS)
        np.testing.assert_array_equal(plain.obs[LIFTING:], after.obs[LIFTING:])
        np.testing.assert_array_equal(plain.reward[LIFTING:], after.reward[LIFTING:])


@pytest.mark.slow
def test_domain_parameters_are_drawn_anew_too() -> None:
    ranges = RandomizationConfig(payload=5.0, gyro_noise=0.01, push_max=0.2, push_period=0.4)
    found = wrapped_states(wrap(BalanceEnv(short(ranges), "continuous"), EPISODE), EPISODE)
    before, after = (
        (s.pipeline_state.params.payload, s.info["noise_key"], s.pipeline_state.pushes.velocity)
        for s in found[-2:]
    )
    for a, b in zip(before, after, strict=True):
        for k in range(LIFTING, ENVS):
            assert (a[k] != b[k]).any()


@pytest.mark.slow
def test_an_action_can_be_repeated(env: BalanceEnv) -> None:
    """Two decisions a step, of which the time limit counts every one."""
    found = wrapped_states(wrap(env, EPISODE, 2), EPISODE // 2)
    assert [float(s.done[-1]) for s in found] == [0, 0, 0, 0, 1]
    assert found[1].pipeline_state.env_steps.tolist() == [2] * ENVS


def test_what_brax_cannot_have_is_refused(env: BalanceEnv) -> None:
    with pytest.raises(ValueError, match="episode_length is 9; scenarios end after 8"):
        wrap(env, EPISODE + 1)
    with pytest.raises(ValueError, match="BalanceEnv randomises by its config"):
        wrap(env, EPISODE, randomization_fn=lambda sys: (sys, sys))


def test_braxs_trainers_get_a_copy_of_every_leaf_per_device() -> None:
    """By JAX's own function or, where JAX has none any more, by ours."""
    devices = jax.local_devices()[:2]
    copies: Any = jax.device_put_replicated({"w": np.arange(3.0), "n": 7}, devices)
    assert [shard.data.tolist() for shard in copies["w"].addressable_shards] == [[[0, 1, 2]]] * 2
    assert [shard.device for shard in copies["n"].addressable_shards] == devices
    assert copies["n"].tolist() == [7, 7]


def test_an_evaluation_takes_height_changes_too(env: BalanceEnv) -> None:
    """Of those of the grid it makes what it makes of their indices."""
    scene, table = env.scene, action_table(env.config.task)
    scenarios = draw_suite(scene.task, scene.robot, "corner", 3, 2.0, 0).scenario

    def index(view: View) -> np.ndarray:
        return (view.ids * 97 + view.env_steps * 31) % 441

    first = roll_out(scene, index, Episodes(scenarios), 2.0)
    again = roll_out(scene, lambda view: table[index(view)], Episodes(scenarios), 2.0)
    np.testing.assert_array_equal(first.tilt, again.tilt)
    np.testing.assert_array_equal(first.action_mm, again.action_mm)


@pytest.mark.long
@pytest.mark.parametrize("algorithm", ["ppo", "sac"])
def test_braxs_trainers_learn_to_balance(algorithm: str) -> None:
    """Who stands still falls in nearly every one of these scenarios."""
    example = runpy.run_path(str(EXAMPLES / "train_brax.py"))
    env = example["make_env"]("mujoco")
    acting = example["controller"](env, example["train"](algorithm, env, DECISIONS[algorithm], 0))
    for suite in HEADLINE:
        rollout = run_suite(env.scene, acting, suite, 16, 60.0, SEEDS.held_out)
        assert not rollout.fell.any()
        assert rollout.tilt.mean() < SCORE[algorithm]


@pytest.mark.long
@pytest.mark.filterwarnings("ignore:Brax System")
def test_our_learner_balances_braxs_pendulum() -> None:
    """An untrained network keeps poles up for 9 of 1,000 decisions, 34 at most."""
    example = runpy.run_path(str(EXAMPLES / "dqn_on_brax.py"))
    learner, state = example["train"](example["pendulum"](), 60_000, 0)
    assert example["held_out"](learner, learner.init(0)).mean() < 100
    assert example["held_out"](learner, state).min() == example["EPISODE"]
