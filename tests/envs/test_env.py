"""BalanceEnv: what an episode consists of, and which way the robot goes."""

import dataclasses
import itertools
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import pytest
import scipy.stats
from fixtures.fleet import observation_names, with_state
from scipy.spatial.transform import Rotation

from mjx_balance.config import Config
from mjx_balance.envs.balance import BalanceEnv
from mjx_balance.task.tilt import platform_position

RESETS = 4_000
ENVS, EPISODE, STAND = 32, 50, 220
LEFT_UP, RIGHT_UP, FRONT_UP, HIND_UP = 20 * 21 + 10, 10, 10 * 21 + 20, 10 * 21
LASTING = np.resize((STAND, LEFT_UP, RIGHT_UP, FRONT_UP, HIND_UP), ENVS)
"""Action of every env of `pushed`."""
DELAYED = np.arange(ENVS) >= 20
PUSHES = 8


@pytest.fixture(scope="module")
def pushed(fleet: Any) -> list[Any]:
    """States of 8 decisions on level boards, each env taking one action again and again."""
    params = fleet.nominal()._replace(delay=DELAYED.astype(np.float32))
    state = fleet.level(fleet.under(fleet.reset(fleet.keys(2)), params))
    return fleet.drive(state, lambda obs, number: LASTING, PUSHES)


def roll_pitch(fleet: Any, states: list[Any]) -> np.ndarray:
    """(len(states), ENVS, 2) deg."""
    quat = np.asarray(
        [s.pipeline_state.physics.qpos[:, fleet.env.scene.trunk_quat] for s in states]
    )
    turn = Rotation.from_quat(quat.reshape(-1, 4), scalar_first=True).as_euler("xyz", degrees=True)
    return turn.reshape(len(states), ENVS, 3)[..., :2]


def test_starts_settled_and_level(fleet: Any, config: Config) -> None:
    for env, size in ((fleet.env, 4 + 8 + 6 + 6 + 4 + 2), (BalanceEnv(config), 34)):
        state: Any = jax.jit(env.reset)(jax.random.PRNGKey(0))
        assert jnp.shape(state.obs) == (env.observation_size,) == (size,)
        # In units of 1 cm, 1 deg/s and 1 deg: nothing moves, nothing tilts.
        np.testing.assert_allclose(np.asarray(state.obs), 0, atol=0.03)
        assert env.action_size == 441
        assert env.action_factors == (21, 21)
        assert (float(state.reward), float(state.done)) == (0, 0)
        stance = env.scene.stance
        np.testing.assert_allclose(
            state.pipeline_state.physics.qpos, stance.qpos, rtol=1e-6, atol=1e-7
        )


def test_actions_go_the_way_that_the_paper_says(fleet: Any, pushed: list[Any]) -> None:
    """3 mm over 142 mm roll the body by 1.21 deg, 3 mm over 193 mm pitch it by 0.89 deg."""
    angles = roll_pitch(fleet, pushed)
    for env in np.flatnonzero(~DELAYED):
        expected = {
            STAND: (0, 0),
            LEFT_UP: (1.21, 0),  # +x is ahead: the left side up is a roll to the right
            RIGHT_UP: (-1.21, 0),
            FRONT_UP: (0, -0.89),  # +y is to the left: the nose up is a negative pitch
            HIND_UP: (0, 0.89),
        }[int(LASTING[env])]
        for number in (1, 2, 3):
            np.testing.assert_allclose(
                angles[number, env], number * np.asarray(expected), atol=0.12 * number
            )


def test_delayed_robots_do_the_same_one_decision_later(pushed: list[Any]) -> None:
    qpos = np.asarray([s.pipeline_state.physics.qpos for s in pushed])
    prompt = [int(np.flatnonzero((LASTING[e] == LASTING) & ~DELAYED)[0]) for e in range(ENVS)]
    for env in np.flatnonzero(DELAYED):
        np.testing.assert_allclose(qpos[1, env], qpos[0, env], atol=1e-4)
        np.testing.assert_allclose(qpos[2:5, env], qpos[1:4, prompt[env]], atol=2e-3)


def test_a_fall_ends_the_episode_and_is_what_is_seen(fleet: Any, pushed: list[Any]) -> None:
    """6 deg are passed by the fifth or sixth roll, by the seventh pitch; who stands goes on."""
    fell = np.asarray([s.metrics["fall"] for s in pushed[1:]])
    names = observation_names(fleet.env.config.task, fleet.env.scene.robot)
    nose, left = names.index("Acc_x,t-0"), names.index("Acc_y,t-0")
    for env in np.flatnonzero(~DELAYED):
        action = int(LASTING[env])
        assert fell[:, env].any() == (action != STAND)
        if action == STAND:
            continue
        first = int(np.argmax(fell[:, env])) + 1
        assert first in ((5, 6) if action in (LEFT_UP, RIGHT_UP) else (7, 8))
        state = pushed[first]
        assert state.done[env] == 1
        assert state.info["truncation"][env] == 0
        assert state.metrics["reward_fail"][env] == -0.5
        assert state.metrics["diverged"][env] == 0
        # The last observation is that of the fallen robot: 6 deg and more, to the right side.
        entry, sign = {
            LEFT_UP: (left, 1),
            RIGHT_UP: (left, -1),
            FRONT_UP: (nose, 1),
            HIND_UP: (nose, -1),
        }[action]
        assert 5 < sign * state.obs[env, entry] < 13
        for before in pushed[1:first]:
            assert before.done[env] == before.metrics["fall"][env] == 0


def test_rewards_follow_the_mean_tilt(pushed: list[Any], closed_loop: list[Any]) -> None:
    """Eq. 4 and Fig. 5 of the preset `default`, and nothing else, add up to the reward."""
    for states in (pushed, closed_loop):
        for before, after in itertools.pairwise(states):
            tilt, last = after.metrics["tilt_deg"], before.metrics["tilt_deg"]
            level_reward = 0.4 * np.exp(-1.5 * tilt)
            toward = 1.0 * np.clip((last - tilt) / 2.5, -1, 1)
            fail = -0.5 * after.metrics["fall"]
            expected = {"level": level_reward, "toward": toward, "fail": fail}
            for name, term in expected.items():
                np.testing.assert_allclose(after.metrics[f"reward_{name}"], term, atol=1e-5)
            np.testing.assert_allclose(after.reward, sum(expected.values()), atol=2e-5)


def test_episodes_end_by_the_time_limit(closed_loop: list[Any]) -> None:
    assert len(closed_loop) == EPISODE + 1
    for number, state in enumerate(closed_loop):
        over = float(number == EPISODE)
        assert not state.metrics["fall"].any()
        np.testing.assert_array_equal(state.done, np.full(ENVS, over))
        np.testing.assert_array_equal(state.info["truncation"], np.full(ENVS, over))
        for value in jax.tree.leaves((state.obs, state.reward, state.metrics)):
            assert np.isfinite(value).all()


def test_a_fall_at_the_time_limit_is_a_fall(fleet: Any, pushed: list[Any]) -> None:
    state = pushed[4]
    for _ in range(2):
        last = state.pipeline_state.env_steps + 1
        info = {name: value for name, value in state.info.items() if name != "action"}
        state = fleet.step(state.replace(info=info | {"episode_length": last}), LASTING)
    fell = np.asarray(state.metrics["fall"]) == 1
    assert 0 < fell.sum() < ENVS
    np.testing.assert_array_equal(np.asarray(state.info["truncation"]), np.where(fell, 0, 1))
    np.testing.assert_array_equal(np.asarray(state.done), np.ones(ENVS))


def test_boards_go_where_their_scenario_says(
    fleet: Any, closed_loop: list[Any], walked: Any
) -> None:
    """Every env its own way, to the servos' lag of 10 ms, which is 0.035 deg at 3.5 deg/s."""
    scenario = closed_loop[0].pipeline_state.scenario
    qpos = np.asarray([state.pipeline_state.physics.qpos for state in closed_loop])
    board = np.degrees(qpos[:, :, fleet.env.scene.board_qpos])
    for number in range(EPISODE + 1):
        expected = [
            walked(targets, phase, rate, 0.2 * number)
            for targets, phase, rate in zip(*scenario[:3], strict=True)
        ]
        np.testing.assert_allclose(board[number], expected, atol=0.06)
    assert np.ptp(board[-1], axis=0).min() > 5


def test_equal_keys_equal_episodes(fleet: Any) -> None:
    actions = jax.random.randint(jax.random.PRNGKey(7), (ENVS,), 0, 441)
    first, again, other = (
        jax.device_get(fleet.step(fleet.reset(fleet.keys(seed)), actions)) for seed in (5, 5, 6)
    )
    jax.tree.map(np.testing.assert_array_equal, first, again)
    assert np.abs(first.obs - other.obs).max() > 0.01


@pytest.mark.parametrize("value", [np.nan, np.inf, 1e30])
def test_who_diverges_falls_alone(fleet: Any, closed_loop: list[Any], value: float) -> None:
    """NaN, infinity or a huge speed in one env of a batch: its row is a fall's, and finite."""
    before = closed_loop[20]
    info = {name: part for name, part in before.info.items() if name != "action"}
    before, actions = before.replace(info=info), closed_loop[21].info["action"]
    qvel = before.pipeline_state.physics.qvel.copy()
    qvel[3, 11] = value
    physics = before.pipeline_state.physics._replace(qvel=qvel)
    spoilt = with_state(before, physics=physics)
    clean, got = (jax.device_get(fleet.step(state, actions)) for state in (before, spoilt))
    others = np.arange(ENVS) != 3

    def check(a: np.ndarray, b: np.ndarray) -> None:
        np.testing.assert_array_equal(a[others], b[others])

    jax.tree.map(check, clean, got)
    assert got.done[3] == got.metrics["fall"][3] == got.metrics["diverged"][3] == 1
    assert got.info["truncation"][3] == 0
    memory = jax.tree.leaves(got.pipeline_state.memory)
    for array in (got.obs, got.reward, *jax.tree.leaves(got.metrics), *memory):
        assert np.isfinite(array).all()
    assert got.metrics["tilt_deg"][3] == 6
    toward = max((before.metrics["tilt_deg"][3] - 6) / 2.5, -1)
    assert got.reward[3] == pytest.approx(-0.5 + toward + 0.4 * np.exp(-9), abs=1e-5)
    assert np.abs(got.obs[3]).max() < 10
    assert clean.metrics["diverged"].sum() == clean.metrics["fall"].sum() == 0


def scenarios(config: Config, seconds: float, square_share: float) -> Any:
    """Scenarios of many resets."""
    task = dataclasses.replace(
        config.task, episode_length=round(seconds / 0.2), square_share=square_share
    )
    env = BalanceEnv(dataclasses.replace(config, task=task))
    draw = jax.jit(jax.vmap(lambda key: env.reset(key).pipeline_state.scenario))
    return jax.device_get(draw(jax.random.split(jax.random.PRNGKey(0), RESETS)))


def uniform(values: np.ndarray, low: float, high: float) -> bool:
    """Whether values are uniform, by Kolmogorov and Smirnov: wrong once in 1,000 seeds."""
    return scipy.stats.kstest(values, "uniform", (low, high - low)).pvalue > 1e-3


def test_targets_fill_the_disc_as_the_paper_says(config: Config) -> None:
    """Any direction, total tilt uniform up to 7 deg; the board starts level, at any age."""
    targets, phase, rate, waves, start = scenarios(config, 30.0, 0.0)
    assert waves is start is None
    assert targets.shape == (RESETS, 4, 2)
    assert not targets[:, 0].any()
    assert uniform(phase, 0, 10)
    np.testing.assert_array_equal(rate, np.full(RESETS, np.float32(3.5)))
    for k in (1, 2, 3):
        x, y = targets[:, k].T
        assert uniform(np.hypot(x, y), 0, 7)
        assert uniform(np.arctan2(y, x), -np.pi, np.pi)
    # No two of them go together.
    drawn = np.column_stack((targets[:, 1:].reshape(RESETS, -1), phase))
    assert np.abs(np.corrcoef(drawn.T) - np.eye(7)).max() < 0.07


def test_seas_and_jumps_are_drawn_beside_ramps(config: Config) -> None:
    """A third of the envs each; a step of one jitted program moves all of them."""
    task = dataclasses.replace(config.task, board_motions=("ramps", "steps", "sea"))
    env = BalanceEnv(dataclasses.replace(config, task=task))
    reset = jax.jit(jax.vmap(lambda key: env.reset(key).pipeline_state.scenario))
    drawn = jax.device_get(reset(jax.random.split(jax.random.PRNGKey(0), RESETS)))
    assert drawn.waves.amplitude.dtype == np.float32
    sailing, jumping = drawn.waves.amplitude.any(axis=(1, 2)), drawn.rate == 20
    for kind in (sailing, jumping):
        assert kind.mean() == pytest.approx(1 / 3, abs=4 * np.sqrt(2 / 9 / RESETS))
    assert not drawn.targets[sailing].any()
    omega = drawn.waves.omega[sailing].ravel()
    peak = 2 * np.pi / task.sea_period
    # Half of the energy below 2 w_p lies below this frequency.
    middle = peak * (1.25 / -np.log(0.5 * np.exp(-1.25 / 16))) ** 0.25
    assert (omega < middle).mean() == pytest.approx(0.5, abs=0.02)
    np.testing.assert_allclose(
        (drawn.waves.amplitude[sailing] ** 2).sum(axis=(1, 2)).std(), 0, atol=1e-5
    )


def test_a_platform_moves_inside_a_program(config: Config) -> None:
    """In MuJoCo's C engine, behind XLA: a second of it, to the servos' lag of 10 ms."""
    task = dataclasses.replace(config.task, board_motions=("ramps", "sea"), platform=True)
    env = BalanceEnv(dataclasses.replace(config, engine="mujoco", task=task))
    state = jax.jit(jax.vmap(env.reset))(jax.random.split(jax.random.PRNGKey(0), 4))
    step = jax.jit(jax.vmap(env.step))
    for _ in range(15):
        state = step(state, np.full(4, 220))
    scenario = jax.device_get(state.pipeline_state.scenario)
    at = np.asarray(state.pipeline_state.physics.qpos)[:, env.scene.platform_qpos]
    expected = platform_position(task, scenario, np.full((4, 1), 3.0))[:, 0]
    np.testing.assert_allclose(at, expected, atol=0.004)
    sailing = scenario.waves.amplitude.any(axis=(1, 2))
    assert 0 < sailing.sum() < 4
    assert (np.abs(at[sailing]).max(axis=1) > 0.01).all()
    np.testing.assert_allclose(at[~sailing], 0, atol=0.001)


def test_a_share_of_the_targets_fills_the_square(config: Config) -> None:
    """Beyond 7 deg lie 1 - pi/4 of a square's targets; of two, each is drawn for itself."""
    targets = scenarios(config, 20.0, 0.7).targets
    beyond = np.linalg.norm(targets[:, 1:], axis=-1) > 7
    share = 0.7 * (1 - np.pi / 4)
    error = 4 * np.sqrt(share / RESETS)
    assert np.abs(beyond.mean(axis=0) - share).max() < error
    assert abs(beyond.all(axis=1).mean() - share**2) < error / 2
    # Mean squares: 49 / 3 in the disc, twice that in the square.
    mean = (targets[:, 1:] ** 2).sum(axis=-1).mean()
    assert mean == pytest.approx(49 / 3 * 1.7, rel=0.04)
