"""One decision by value: the targets of the servos, and what the network sees and earns.

Expected values come from loops over single robots, steps and legs, written from the paper's
words: legs of two links of 0.213 m, feet of 22 mm, a board that walks at its rate.
"""

import dataclasses
import math
import types
from collections.abc import Callable
from functools import cache, partial
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from fixtures.arrays import put

from mjx_balance.config import Config, TaskConfig
from mjx_balance.robots.catalogue import Robot
from mjx_balance.task import step
from mjx_balance.task.randomization import DomainParams
from mjx_balance.task.tilt import Scenario

N, LEGS, STEPS = 3, 4, 50
SIGNS = ((1, 1), (-1, 1), (1, -1), (-1, -1))
"""Of a_x and a_y at LF, RF, LH, RH: left and front are up."""
SCENARIO = Scenario(
    targets=np.asarray(
        [[(0, 0), (5, -3), (-2, 6)], [(1, 2), (3, 4), (5, 6)], [(0, 0), (-7, 7), (7, -7)]], float
    ),
    phase=np.asarray((0.0, 4.2, 9.7)),
    rate=np.asarray((3.5, 2.0, 4.0)),
)
CHANGE = np.asarray([(0.003, -0.0012), (-0.0021, 0.0006), (0.0009, 0.0027)])


@pytest.fixture(scope="module")
def task(config: Config) -> TaskConfig:
    """A task with lagged commands and mean samples, the tilt rewarded at the end."""
    return dataclasses.replace(
        config.task,
        command_lags=(0, 2),
        gyro_lags=(0, 7),
        accel_lags=(1, 60),
        imu_mean=3,
        reward_tilt="end",
    )


def random_memory(seed: int = 0) -> step.Memory:
    """Memories of N robots, no two numbers equal."""
    rng = np.random.default_rng(seed)
    return step.Memory(
        heights=0.35 + 0.01 * rng.uniform(-1, 1, (N, LEGS)),
        commanded=0.35 + 0.01 * rng.uniform(-1, 1, (N, 3, LEGS)),
        imu=rng.normal(size=(N, 63, 6)),
        tilt=np.asarray((0.5, 2.0, 4.0)),
    )


def random_motion(seed: int = 1) -> step.Motion:
    """One decision of N robots; nobody falls, and the last joint angles alone count."""
    rng = np.random.default_rng(seed)
    imu, tilt = rng.normal(size=(N, STEPS, 6)), rng.uniform(0, 5, (N, STEPS))
    angles = rng.uniform((-0.2, 0.5, -1.6), (0.2, 0.8, -1.2), (N, STEPS, LEGS, 3))
    return step.Motion(imu, tilt, angles)


def before(
    env_steps: Any, delay: Any = None, memory: Any = None, scenario: Scenario = SCENARIO
) -> step.EnvState:
    """States of robots at decisions `env_steps`; delay None: no domain parameters."""
    params = None
    if delay is not None:
        params = DomainParams(*[np.zeros(len(env_steps))] * 7)._replace(delay=np.asarray(delay))
    memory = random_memory() if memory is None else memory
    return step.EnvState(np.zeros(()), memory, scenario, np.asarray(env_steps), params, None)


@pytest.fixture(scope="module")
def apply(robot: Robot) -> Callable[..., Any]:
    """Array library, function, task, arrays -> its results; JAX compiles a function once."""

    @cache
    def compiled(function: Any, task: TaskConfig) -> Any:
        return jax.jit(partial(function, task, robot))

    def apply(xp: types.ModuleType, function: Any, task: TaskConfig, *arrays: Any) -> Any:
        of_task = partial(function, task, robot) if xp is np else compiled(function, task)
        return of_task(*put(xp, arrays))

    return apply


def tolerance(xp: types.ModuleType) -> float:
    return 1e-12 if xp is np else 3e-6


def test_a_standing_robot_has_always_stood(
    xp: types.ModuleType, task: TaskConfig, robot: Robot
) -> None:
    still = np.asarray([(1, 2, 3, 4, 5, 6), (7, 8, 9, 10, 11, 12)], float)
    memory = step.initial_memory(task, robot, put(xp, still))
    np.testing.assert_allclose(memory.heights, np.full((2, 4), 0.35), rtol=1e-6)
    np.testing.assert_allclose(memory.commanded, np.full((2, 3, 4), 0.35), rtol=1e-6)
    np.testing.assert_array_equal(memory.imu, np.tile(still[:, None], (63, 1)))
    np.testing.assert_array_equal(memory.tilt, np.zeros(2))
    one = step.initial_memory(task, robot, put(xp, still[1]))
    assert [x.shape for x in one[:4]] == [(4,), (3, 4), (63, 6), ()]
    np.testing.assert_array_equal(one.imu, memory.imu[1])


def test_targets_of_legs_and_board_step_by_step(
    xp: types.ModuleType, task: TaskConfig, apply: Any, walked: Any
) -> None:
    delay, env_steps = (0.0, 1.0, 0.0), (7, 31, 52)
    state = before(env_steps, delay)
    memory = state.memory
    after, targets = apply(xp, step.pre_step, task, state, CHANGE)
    last = memory.commanded[:, -1]
    command = last + [[x * a + y * b for x, y in SIGNS] for a, b in CHANGE]
    goal = np.where(np.asarray(delay)[:, None] > 0, last, command)
    assert targets.joints.shape == (N, STEPS, LEGS, 3)
    assert targets.board.shape == (N, STEPS, 2)
    close = partial(np.testing.assert_allclose, atol=100 * tolerance(xp))
    for n in range(N):
        for i in (0, 1, 3, 4, 5, 30, 49):
            share = min((i + 1) / 5, 1)  # a tenth of the decision is 5 physics steps
            height = memory.heights[n] + share * (goal[n] - memory.heights[n])
            lean = np.arccos((height - 0.022) / 0.426)  # both links lean alike
            close(targets.joints[n, i], np.stack((0 * lean, lean, -2 * lean), axis=-1))
        for i in (0, 1, 24, 49):
            time = 0.2 * env_steps[n] + 0.004 * (i + 1)
            angle = walked(SCENARIO.targets[n], SCENARIO.phase[n], SCENARIO.rate[n], time)
            close(np.degrees(targets.board[n, i]), angle)
    close = partial(np.testing.assert_allclose, atol=tolerance(xp))
    close(after.heights, goal)
    close(after.commanded[:, -1], command)
    close(after.commanded[:, :-1], memory.commanded[:, 1:])
    np.testing.assert_allclose(after.imu, memory.imu, rtol=1e-6)
    np.testing.assert_allclose(after.tilt, memory.tilt)


def test_heights_stop_at_the_legs_reach(task: TaskConfig, robot: Robot) -> None:
    """0.426 cos(0.419) + 0.022 m at the straightest knee, 0.426 cos(1.36) + 0.022 m folded."""
    low, high = (0.426 * math.cos(knee / 2) + 0.022 for knee in (2.72, 0.838))
    memory = random_memory()._replace(commanded=np.full((N, 3, LEGS), low))
    change = np.asarray([(0.002, 0.0), (0.0, 0.002), (0.5, 0.5)])
    after, _ = step.pre_step(task, robot, before([0] * N, memory=memory), change)
    expected = [
        (low + 0.002, low, low + 0.002, low),
        (low + 0.002, low + 0.002, low, low),
        (high, low, low, low),
    ]
    np.testing.assert_allclose(after.heights, expected, atol=1e-12)


def test_a_delayed_action_is_commanded_at_once_and_taken_one_decision_later(
    xp: types.ModuleType, task: TaskConfig, robot: Robot, apply: Any
) -> None:
    """Three raises of the left side by 1, 2 and 3 mm: commanded 1, 3, 6; taken 0, 1, 3."""
    memory = step.initial_memory(task, robot, put(xp, np.zeros((2, 6))))
    level = Scenario(np.zeros((2, 1, 2)), np.zeros(2), np.full(2, 3.5))
    commanded, taken, first = [], [], []
    for number, millimetres in enumerate((1, 2, 3)):
        state = before([number] * 2, (0.0, 1.0), memory, level)
        change = np.asarray([(millimetres * 1e-3, 0.0)] * 2)
        memory, targets = apply(xp, step.pre_step, task, state, change)
        commanded.append(1e3 * (np.asarray(memory.commanded)[:, -1, 0] - 0.35))
        taken.append(1e3 * (np.asarray(memory.heights)[:, 0] - 0.35))
        # The first targets of the knees: a fifth of the way from where they were.
        bend = -0.5 * np.asarray(targets.joints)[:, 0, 0, 2]
        first.append(1e3 * (0.022 + 0.426 * np.cos(bend) - 0.35))
    np.testing.assert_allclose(commanded, [(1, 1), (3, 3), (6, 6)], atol=2e-3)
    np.testing.assert_allclose(taken, [(1, 0), (3, 1), (6, 3)], atol=2e-3)
    np.testing.assert_allclose(first, [(0.2, 0), (1.4, 0.2), (3.6, 1.4)], atol=2e-3)


def test_without_a_delay_actions_are_taken_at_once(task: TaskConfig, robot: Robot) -> None:
    results = [
        step.pre_step(task, robot, before(range(N), delay), CHANGE) for delay in (None, [0.0] * N)
    ]
    jax.tree.map(np.testing.assert_array_equal, *results)


def test_the_legs_of_a_late_robot_follow_some_physics_steps_later(
    task: TaskConfig, robot: Robot
) -> None:
    """By 21 ms, 5 whole steps of 4 ms; the board and what the robot remembers do not wait."""
    late = dataclasses.replace(robot, command_delay=0.021)
    memory, targets = step.pre_step(task, robot, before(range(N)), CHANGE)
    after, delayed = step.pre_step(task, late, before(range(N)), CHANGE)
    jax.tree.map(np.testing.assert_array_equal, after, memory)
    np.testing.assert_array_equal(delayed.board, targets.board)
    np.testing.assert_allclose(delayed.joints[:, 5:], targets.joints[:, :-5], rtol=0, atol=1e-15)
    lean = np.arccos((random_memory().heights - 0.022) / 0.426)
    waiting = np.stack((0 * lean, lean, -2 * lean), axis=-1)
    np.testing.assert_allclose(delayed.joints[:, :5], np.stack([waiting] * 5, axis=1), atol=1e-12)


def test_observation_entry_by_entry(xp: types.ModuleType, task: TaskConfig, apply: Any) -> None:
    """Measured heights, commands of now and two decisions ago, gyro, accelerometer."""
    memory, motion = random_memory(), random_motion()
    after, outcome = apply(xp, step.post_step, task, memory, motion)
    assert outcome.obs.shape == (N, 4 + 8 + 4 + 4)
    for n in range(N):
        stream = [*memory.imu[n], *motion.imu[n]]
        expected = []
        for leg, side in enumerate((1, -1, 1, -1)):
            abduction, hip, knee = motion.joint_angles[n, -1, leg]
            # From the hip: sideways by the offset, then down the two links, turned about x.
            down = 0.213 * math.cos(hip) + 0.213 * math.cos(hip + knee)
            z = 0.0955 * side * math.sin(abduction) - down * math.cos(abduction)
            expected.append((-z + 0.022 - 0.35) / 0.01)
        for row in (2, 0):
            expected += [(h - 0.35) / 0.01 for h in memory.commanded[n, row]]
        for first, lags, scale in (
            (0, (0, 7), math.radians(1)),
            (3, (1, 60), 9.81 * math.sin(math.radians(1))),
        ):
            for channel in (first, first + 1):
                for lag in lags:
                    last = len(stream) - 1 - lag
                    mean = sum(stream[last - k][channel] for k in range(3)) / 3
                    expected.append(mean / scale)
        np.testing.assert_allclose(outcome.obs[n], expected, rtol=1e-5, atol=3e-5)
    whole = np.concatenate((memory.imu, motion.imu), axis=1)
    np.testing.assert_allclose(after.imu, whole[:, -63:], rtol=1e-6)
    np.testing.assert_allclose(after.commanded, memory.commanded, rtol=1e-6)
    np.testing.assert_allclose(after.heights, memory.heights, rtol=1e-6)


@pytest.mark.parametrize("rewarded", ["end", "mean"])
def test_rewards_by_hand(xp: types.ModuleType, task: TaskConfig, apply: Any, rewarded: Any) -> None:
    """The tilt before is the one that was rewarded last, not that of the last step."""
    task = dataclasses.replace(
        task,
        reward_tilt=rewarded,
        reward_level=0.4,
        reward_sharpness=1.5,
        reward_toward=0.8,
        reward_toward_scale=2.5,
    )
    memory, tilt_before = put(xp, random_memory()), [0.5, 2.0, 4.0]
    close = partial(np.testing.assert_allclose, rtol=1e-4, atol=1e-5)
    for seed in (1, 2, 3):
        motion = random_motion(seed)
        tilts = motion.tilt * np.asarray([[0.1], [0.5], [1.0]])
        memory, outcome = apply(xp, step.post_step, task, memory, motion._replace(tilt=tilts))
        after = [row[-1] if rewarded == "end" else sum(row) / 50 for row in tilts]
        close(outcome.rewards["level"], [0.4 * math.exp(-1.5 * x) for x in after])
        gain = [(a - b) / 2.5 for a, b in zip(tilt_before, after, strict=True)]
        close(outcome.rewards["toward"], [0.8 * max(-1, min(1, x)) for x in gain])
        np.testing.assert_array_equal(outcome.rewards["fail"], np.zeros(N))
        close(memory.tilt, after)
        assert set(outcome.rewards) == {"level", "toward", "fail"}
        tilt_before = after


@pytest.mark.parametrize("number", [0, 23, 49])
def test_one_step_beyond_six_degrees_is_a_fall(
    xp: types.ModuleType, task: TaskConfig, apply: Any, number: int
) -> None:
    motion = random_motion()
    motion.tilt[:, number] = 6.0, 6.001, 6.001
    motion.tilt[2, number:] = 6.001
    _, outcome = apply(xp, step.post_step, task, random_memory(), motion)
    np.testing.assert_array_equal(outcome.terminated, (False, True, True))
    np.testing.assert_allclose(outcome.rewards["fail"], (0, -0.5, -0.5))
    np.testing.assert_allclose(outcome.tilt, motion.tilt, rtol=1e-6)
    assert not np.asarray(outcome.diverged).any()


@pytest.mark.parametrize("value", [np.nan, np.inf, -np.inf, 3e38, 2e4, -2e4])
@pytest.mark.parametrize("name", ["imu", "tilt", "joint_angles"])
def test_a_diverged_env_is_a_fall_with_finite_values(
    xp: types.ModuleType, task: TaskConfig, apply: Any, name: str, value: float
) -> None:
    """Its last sample is held, its legs count as at their targets; the others do not notice."""
    memory, motion = random_memory(), random_motion()
    sound = apply(xp, step.post_step, task, memory, motion)
    getattr(motion, name)[1].reshape(-1)[-1] = value
    with np.errstate(over="ignore", invalid="ignore"):
        after, outcome = apply(xp, step.post_step, task, memory, motion)
    jax.tree.map(
        lambda a, b: np.testing.assert_array_equal(np.asarray(a)[::2], np.asarray(b)[::2]),
        (after, outcome),
        sound,
    )
    np.testing.assert_array_equal(outcome.terminated, (False, True, False))
    np.testing.assert_array_equal(outcome.diverged, (False, True, False))
    samples = np.concatenate((memory.imu[1, 50:], np.tile(memory.imu[1, -1], (50, 1))))
    np.testing.assert_allclose(after.imu[1], samples, rtol=1e-6)
    np.testing.assert_allclose(0.35 + 0.01 * outcome.obs[1, :4], memory.heights[1], atol=1e-5)
    np.testing.assert_array_equal(outcome.tilt[1], np.full(50, 6.0))
    # As for any fall, from 2 deg: exp(-1.5 * 6) = 0.0001234; (2 - 6) / 2.5 is below -1.
    rewards = {key: float(term[1]) for key, term in outcome.rewards.items()}
    assert rewards == pytest.approx({"level": 0.4 * 1.234e-4, "toward": -1, "fail": -0.5}, 1e-3)
    for array in jax.tree.leaves((after, outcome)):
        assert np.abs(np.asarray(array, float)).max() < 1e3


def test_a_hard_bump_is_no_divergence(task: TaskConfig, robot: Robot) -> None:
    """A robot may feel hundreds of g; thousands are a simulation's."""
    motion = random_motion()
    motion.imu[2, 0, 5] = 5e3
    _, outcome = step.post_step(task, robot, random_memory(), motion)
    assert not (outcome.diverged | outcome.terminated).any()


def test_one_robot_is_a_row_of_a_batch(task: TaskConfig, robot: Robot) -> None:
    """What training does, one robot vmapped in JAX, and evaluation, all at once in NumPy."""
    motion = random_motion()
    motion.tilt[1, 7] = 7.0
    state = before((0, 3, 70), (1.0, 0.0, 1.0))._replace(physics=np.zeros(N))

    def decision(state: step.EnvState, change: Any, motion: step.Motion) -> Any:
        memory, targets = step.pre_step(task, robot, state, change)
        return targets, step.post_step(task, robot, memory, motion)

    single = jax.jit(jax.vmap(decision))(*put(jnp, (state, CHANGE, motion)))
    close = partial(np.testing.assert_allclose, rtol=1e-4, atol=1e-4)
    jax.tree.map(close, single, decision(state, CHANGE, motion))
