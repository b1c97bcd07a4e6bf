"""One decision by value: what the servos are told, and what the network sees and earns.

Expected values come from loops over single robots, steps and legs, written from the paper's
words: legs of two links of 0.213 m, feet of 22 mm, a board that walks at its rate.
"""

import dataclasses
import math
import types
from functools import partial
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from mjx_balance.config import Config, TaskConfig
from mjx_balance.robots.catalogue import Robot
from mjx_balance.task import step
from mjx_balance.task.tilt import Scenario

N, LEGS, STEPS = 3, 4, 50
SIGNS = ((1, 1), (-1, 1), (1, -1), (-1, -1))
"""Of a_x and a_y at LF, RF, LH, RH: left and front are up."""
NO_MOVE = np.zeros((N, 2))


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


def random_memory(task: TaskConfig, seed: int = 0) -> step.Memory:
    """Memories of N robots, no two numbers equal."""
    rng = np.random.default_rng(seed)
    return step.Memory(
        heights=0.35 + 0.01 * rng.uniform(-1, 1, (N, LEGS)),
        commanded=0.35 + 0.01 * rng.uniform(-1, 1, (N, 3, LEGS)),
        imu=rng.normal(size=(N, 63, 6)),
        tilt=np.asarray((0.5, 2.0, 4.0)),
    )


SCENARIO = Scenario(
    targets=np.asarray(
        [[(0, 0), (5, -3), (-2, 6)], [(1, 2), (3, 4), (5, 6)], [(0, 0), (-7, 7), (7, -7)]], float
    ),
    phase=np.asarray((0.0, 4.2, 9.7)),
    rate=np.asarray((3.5, 2.0, 4.0)),
)


def put(xp: types.ModuleType, tree: Any) -> Any:
    """Arrays of the library, its own float."""
    dtype = xp.float64 if xp is np else xp.float32
    return jax.tree.map(lambda x: xp.asarray(x, dtype), tree)


def tolerance(xp: types.ModuleType) -> float:
    return 1e-12 if xp is np else 3e-6


def obeyed(memory: step.Memory, change: np.ndarray, late: Any) -> tuple[Any, Any]:
    """Heights asked for and heights that the legs are told, robot by robot, leg by leg."""
    asked, told = np.zeros((2, N, LEGS))
    for n in range(N):
        for leg, (side, end) in enumerate(SIGNS):
            last = memory.commanded[n, -1, leg]
            asked[n, leg] = last + side * change[n, 0] + end * change[n, 1]
            told[n, leg] = last if late[n] else asked[n, leg]
    return asked, told


def test_a_standing_robot_has_always_stood(
    xp: types.ModuleType, task: TaskConfig, robot: Robot
) -> None:
    still = np.asarray([(1, 2, 3, 4, 5, 6), (7, 8, 9, 10, 11, 12)], float)
    memory = step.initial_memory(task, robot, put(xp, still))
    np.testing.assert_allclose(np.asarray(memory.heights), np.full((2, 4), 0.35), rtol=1e-6)
    np.testing.assert_allclose(np.asarray(memory.commanded), np.full((2, 3, 4), 0.35), rtol=1e-6)
    assert memory.imu.shape == (2, 63, 6)
    for k in range(63):
        np.testing.assert_array_equal(np.asarray(memory.imu[:, k]), still)
    np.testing.assert_array_equal(np.asarray(memory.tilt), np.zeros(2))
    one = step.initial_memory(task, robot, put(xp, still[1]))
    assert [x.shape for x in one] == [(4,), (3, 4), (63, 6), ()]
    np.testing.assert_array_equal(np.asarray(one.imu), np.asarray(memory.imu[1]))


def test_servos_are_told_heights_and_board_step_by_step(
    xp: types.ModuleType, task: TaskConfig, robot: Robot, walked: Any
) -> None:
    before = random_memory(task)
    change = np.asarray([(0.003, -0.0012), (-0.0021, 0.0006), (0.0009, 0.0027)])
    late, number = np.asarray((False, True, False)), np.asarray((7.0, 31.0, 52.0))
    after, targets = step.pre_step(
        task,
        robot,
        put(xp, before),
        put(xp, change),
        xp.asarray(late),
        put(xp, SCENARIO),
        put(xp, number),
    )
    asked, told = obeyed(before, change, late)
    assert targets.joints.shape == (N, STEPS, LEGS, 3)
    assert targets.board.shape == (N, STEPS, 2)
    joints, board = np.asarray(targets.joints), np.asarray(targets.board)
    for n in range(N):
        for i in (0, 1, 3, 4, 5, 30, 49):
            share = min((i + 1) / 5, 1)  # a tenth of the decision is 5 physics steps
            height = before.heights[n] + share * (told[n] - before.heights[n])
            lean = np.arccos((height - 0.022) / 0.426)  # both links lean alike
            expected = np.stack((0 * lean, lean, -2 * lean), axis=-1)
            np.testing.assert_allclose(joints[n, i], expected, atol=100 * tolerance(xp))
        for i in (0, 24, 49):
            time = 0.2 * number[n] + 0.004 * (i + 1)
            angle = walked(SCENARIO.targets[n], SCENARIO.phase[n], SCENARIO.rate[n], time)
            np.testing.assert_allclose(np.degrees(board[n, i]), angle, atol=100 * tolerance(xp))
    np.testing.assert_allclose(np.asarray(after.heights), told, atol=tolerance(xp))
    np.testing.assert_allclose(np.asarray(after.commanded[:, -1]), asked, atol=tolerance(xp))
    np.testing.assert_allclose(
        np.asarray(after.commanded[:, :-1]), before.commanded[:, 1:], atol=tolerance(xp)
    )
    np.testing.assert_allclose(np.asarray(after.imu), before.imu, rtol=1e-6)
    np.testing.assert_allclose(np.asarray(after.tilt), before.tilt)


def test_board_moves_from_the_first_step_and_its_clock_runs_on(
    task: TaskConfig, robot: Robot
) -> None:
    """3.5 deg/s is 0.014 deg in 4 ms: step i of decision d stands at (50 d + i + 1) times that."""
    away = Scenario(np.full((N, 1, 2), 30.0), np.zeros(N), np.full(N, 3.5))
    memory = random_memory(task)
    for number in (0, 1, 2):
        _, targets = step.pre_step(
            task, robot, memory, NO_MOVE, None, away, np.full(N, float(number))
        )
        expected = 0.014 * (50 * number + np.arange(1, 51))
        np.testing.assert_allclose(np.degrees(targets.board[0, :, 0]), expected, atol=1e-9)


def test_heights_stop_at_the_legs_reach(task: TaskConfig, robot: Robot) -> None:
    """0.426 cos(0.419) + 0.022 m at the straightest knee, 0.426 cos(1.36) + 0.022 m folded."""
    reach = [0.426 * math.cos(knee / 2) + 0.022 for knee in (2.72, 0.838)]
    memory = random_memory(task)._replace(commanded=np.tile(np.asarray(reach)[0], (N, 3, LEGS)))
    change = np.asarray([(0.002, 0.0), (0.0, 0.002), (0.5, 0.5)])
    after, _ = step.pre_step(task, robot, memory, change, None, SCENARIO, np.zeros(N))
    low, high = reach
    expected = [
        (low + 0.002, low, low + 0.002, low),
        (low + 0.002, low + 0.002, low, low),
        (high, low, low, low),
    ]
    np.testing.assert_allclose(after.heights, expected, atol=1e-12)


def test_a_late_action_is_asked_for_at_once_and_obeyed_one_decision_later(
    xp: types.ModuleType, task: TaskConfig, robot: Robot
) -> None:
    """Three raises of the left side by 1, 2 and 3 mm: asked for 1, 3, 6; obeyed 0, 1, 3."""
    memory = step.initial_memory(task, robot, put(xp, np.zeros((2, 6))))
    level = put(xp, Scenario(np.zeros((2, 1, 2)), np.zeros(2), np.full(2, 3.5)))
    late = xp.asarray((False, True))
    asked, told, first = [], [], []
    for number, millimetres in enumerate((1, 2, 3)):
        change = put(xp, np.asarray([(millimetres * 1e-3, 0.0)] * 2))
        now = put(xp, np.full(2, float(number)))
        memory, targets = step.pre_step(task, robot, memory, change, late, level, now)
        asked.append(1e3 * (np.asarray(memory.commanded)[:, -1, 0] - 0.35))
        told.append(1e3 * (np.asarray(memory.heights)[:, 0] - 0.35))
        # Where the knees are told to go first: a fifth of the way from where they were.
        bend = -0.5 * np.asarray(targets.joints)[:, 0, 0, 2]
        first.append(1e3 * (0.022 + 0.426 * np.cos(bend) - 0.35))
    np.testing.assert_allclose(asked, [(1, 1), (3, 3), (6, 6)], atol=2e-3)
    np.testing.assert_allclose(told, [(1, 0), (3, 1), (6, 3)], atol=2e-3)
    np.testing.assert_allclose(first, [(0.2, 0), (1.4, 0.2), (3.6, 1.4)], atol=2e-3)


def test_nobody_late_is_the_same_as_no_latency(task: TaskConfig, robot: Robot) -> None:
    change, now = np.full((N, 2), 0.002), np.arange(N) * 1.0
    results = [
        step.pre_step(task, robot, random_memory(task), change, late, SCENARIO, now)
        for late in (None, np.zeros(N, bool))
    ]
    jax.tree.map(np.testing.assert_array_equal, *results)


def post(task: TaskConfig, robot: Robot, memory: Any, samples: Any, tilts: Any, angles: Any) -> Any:
    """Memory and outcome for joint angles (..., legs, 3) at the end of a decision."""
    motion = step.Motion(samples, tilts, angles[..., None, :, :])
    return step.post_step(task, robot, memory, motion)


def readings(seed: int = 1) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Samples, tilts and joint angles of one decision of N robots; nobody falls."""
    rng = np.random.default_rng(seed)
    angles = rng.uniform((-0.2, 0.5, -1.6), (0.2, 0.8, -1.2), (N, LEGS, 3))
    return rng.normal(size=(N, STEPS, 6)), rng.uniform(0, 5, (N, STEPS)), angles


def test_observation_entry_by_entry(xp: types.ModuleType, task: TaskConfig, robot: Robot) -> None:
    """Measured heights, commands of now and two decisions ago, gyro, accelerometer."""
    memory, (samples, tilts, angles) = random_memory(task), readings()
    after, outcome = post(task, robot, *put(xp, (memory, samples, tilts, angles)))
    assert outcome.obs.shape == (N, 4 + 8 + 4 + 4)
    for n in range(N):
        stream = [*memory.imu[n], *samples[n]]
        expected = []
        for leg, side in enumerate((1, -1, 1, -1)):
            abduction, hip, knee = angles[n, leg]
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
        got = np.asarray(outcome.obs)[n]
        np.testing.assert_allclose(got, expected, rtol=1e-5, atol=3e-5)
    whole = np.concatenate((memory.imu, samples), axis=1)
    np.testing.assert_allclose(np.asarray(after.imu), whole[:, -63:], rtol=1e-6)
    np.testing.assert_allclose(np.asarray(after.commanded), memory.commanded, rtol=1e-6)
    np.testing.assert_allclose(np.asarray(after.heights), memory.heights, rtol=1e-6)


@pytest.mark.parametrize("rewarded", ["end", "mean"])
def test_rewards_by_hand(
    xp: types.ModuleType, task: TaskConfig, robot: Robot, rewarded: Any
) -> None:
    """The tilt before is the one that was rewarded last, not that of the last step."""
    task = dataclasses.replace(
        task,
        reward_tilt=rewarded,
        reward_level=0.4,
        reward_sharpness=1.5,
        reward_toward=0.8,
        reward_toward_scale=2.5,
    )
    memory, before = put(xp, random_memory(task)), [0.5, 2.0, 4.0]
    for seed in (1, 2, 3):
        samples, tilts, angles = readings(seed)
        tilts = tilts * np.asarray([[0.1], [0.5], [1.0]])
        memory, outcome = post(task, robot, memory, *put(xp, (samples, tilts, angles)))
        after = [row[-1] if rewarded == "end" else sum(row) / 50 for row in tilts]
        level = [0.4 * math.exp(-1.5 * x) for x in after]
        toward = [0.8 * max(-1, min(1, (a - b) / 2.5)) for a, b in zip(before, after, strict=True)]
        close = partial(np.testing.assert_allclose, rtol=1e-4, atol=1e-5)
        close(np.asarray(outcome.rewards["level"]), level)
        close(np.asarray(outcome.rewards["toward"]), toward)
        np.testing.assert_array_equal(np.asarray(outcome.rewards["fail"]), np.zeros(N))
        close(np.asarray(memory.tilt), after)
        assert set(outcome.rewards) == {"level", "toward", "fail"}
        before = after


@pytest.mark.parametrize("number", [0, 23, 49])
def test_one_step_beyond_six_degrees_is_a_fall(
    xp: types.ModuleType, task: TaskConfig, robot: Robot, number: int
) -> None:
    samples, tilts, angles = readings()
    tilts[0, number], tilts[1, number], tilts[2, number] = 6.0, 6.001, 6.001
    tilts[2, number:] = 6.001
    _, outcome = post(task, robot, *put(xp, (random_memory(task), samples, tilts, angles)))
    np.testing.assert_array_equal(np.asarray(outcome.terminated), (False, True, True))
    np.testing.assert_allclose(np.asarray(outcome.rewards["fail"]), (0, -0.5, -0.5))
    np.testing.assert_allclose(np.asarray(outcome.tilt), tilts, rtol=1e-6)
    assert not np.asarray(outcome.diverged).any()


def test_where_physics_diverged_the_last_sample_is_held(
    xp: types.ModuleType, task: TaskConfig, robot: Robot
) -> None:
    """And the legs count as where they were told to be, which a late robot's command is not."""
    memory, (samples, tilts, angles) = random_memory(task), readings()
    samples[1, 49, 2] = np.nan
    after, outcome = post(task, robot, *put(xp, (memory, samples, tilts, angles)))
    held = np.concatenate((memory.imu[1, 50:], np.tile(memory.imu[1, -1], (50, 1))))
    np.testing.assert_allclose(np.asarray(after.imu)[1], held, rtol=1e-6)
    heights = 0.35 + 0.01 * np.asarray(outcome.obs)[1, :4]
    np.testing.assert_allclose(heights, memory.heights[1], atol=1e-5)
    np.testing.assert_array_equal(np.asarray(outcome.tilt)[1], np.full(50, 6.0))
    np.testing.assert_array_equal(np.asarray(outcome.diverged), (False, True, False))
    np.testing.assert_array_equal(np.asarray(outcome.terminated), (False, True, False))
    assert float(after.tilt[1]) == 6


@pytest.mark.parametrize(("size", "diverged"), [(-2e4, True), (2e4, True), (5e3, False)])
def test_a_hard_bump_is_no_divergence(
    task: TaskConfig, robot: Robot, size: float, diverged: bool
) -> None:
    """A robot may feel hundreds of g; thousands are a simulation's."""
    samples, tilts, angles = readings()
    samples[2, 0, 5] = size
    _, outcome = post(task, robot, random_memory(task), samples, tilts, angles)
    assert outcome.diverged.tolist() == outcome.terminated.tolist() == [False, False, diverged]


def test_one_robot_is_a_row_of_a_batch(task: TaskConfig, robot: Robot) -> None:
    """What training does, one robot vmapped in JAX, and evaluation, all at once in NumPy."""
    memory, (samples, tilts, angles) = random_memory(task), readings()
    tilts[1, 7] = 7.0
    change = np.asarray([(0.003, -0.0012), (-0.0021, 0.0006), (0.0009, 0.0027)])
    late, number = np.asarray((True, False, True)), np.asarray((0.0, 3.0, 70.0))

    def both(memory, change, late, scenario, number, samples, tilts, angles):
        memory, targets = step.pre_step(task, robot, memory, change, late, scenario, number)
        return targets, post(task, robot, memory, samples, tilts, angles)

    inputs = (memory, change, late, SCENARIO, number, samples, tilts, angles)
    batch = both(*inputs)
    single = jax.jit(jax.vmap(both))(*put(jnp, inputs)[:2], late, *put(jnp, inputs)[3:])
    jax.tree.map(
        lambda a, b: np.testing.assert_allclose(np.asarray(a), b, rtol=1e-4, atol=1e-4),
        single,
        batch,
    )
