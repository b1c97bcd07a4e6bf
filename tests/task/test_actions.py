"""The 441 actions of paper Eq. 3 and what they do to the feet."""

import itertools
import types

import jax.numpy as jnp
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from mjx_balance.config import TaskConfig
from mjx_balance.robots.catalogue import Robot
from mjx_balance.task.actions import action_table, apply_action, leg_signs, nearest_action

TASK = TaskConfig()
COARSE = TaskConfig(action_levels=5, action_max=0.01)


def test_every_pair_of_21_levels_occurs_once() -> None:
    table = action_table(TASK)
    assert table.shape == (441, 2)
    assert len({tuple(np.rint(row * 1e7)) for row in table}) == 441


@pytest.mark.parametrize(
    ("index", "change_mm"),
    [
        (0, (-3.0, -3.0)),
        (1, (-3.0, -2.7)),
        (20, (-3.0, 3.0)),
        (21, (-2.7, -3.0)),
        (220, (0.0, 0.0)),
        (231, (0.3, -3.0)),
        (440, (3.0, 3.0)),
    ],
)
def test_action_by_hand(index: int, change_mm: tuple[float, float]) -> None:
    np.testing.assert_allclose(1000 * action_table(TASK)[index], change_mm, atol=1e-6)


def test_index_counts_roll_slowly_and_pitch_fast() -> None:
    """Eq. 3, a = -3 + 6 n / 20 mm, for every n_x and n_y."""
    table = 1000 * action_table(TASK)
    for n_x in range(21):
        for n_y in range(21):
            expected = (-3 + 6 * n_x / 20, -3 + 6 * n_y / 20)
            np.testing.assert_allclose(table[21 * n_x + n_y], expected, atol=1e-6)


def test_doing_nothing_is_exactly_an_action() -> None:
    assert (action_table(TASK)[220] == 0).all()


def test_signs_by_hand(robot: Robot) -> None:
    """Left up and right down for a_x; front up and hind down for a_y; order LF RF LH RH."""
    assert leg_signs(robot).tolist() == [[1, -1, 1, -1], [1, 1, -1, -1]]


@pytest.mark.parametrize(
    ("change_mm", "moved_mm"),
    [
        ((2.0, 0.0), (352, 348, 352, 348)),
        ((0.0, 2.0), (352, 352, 348, 348)),
        ((2.0, 1.0), (353, 349, 351, 347)),
        ((-3.0, 3.0), (350, 356, 344, 350)),
        ((0.0, 0.0), (350, 350, 350, 350)),
    ],
)
def test_feet_move_by_hand(
    xp: types.ModuleType, robot: Robot, change_mm: tuple[float, float], moved_mm: tuple[float, ...]
) -> None:
    got = apply_action(TASK, robot, xp.full(4, 0.35), xp.asarray(change_mm) / 1000)
    np.testing.assert_allclose(1000 * got, moved_mm, atol=1e-3)


def test_heights_stop_at_the_legs_reach(xp: types.ModuleType, robot: Robot) -> None:
    lowest, highest = robot.height_range
    heights = xp.asarray([highest - 0.001, lowest + 0.001, highest - 0.004, 0.35])
    got = apply_action(TASK, robot, heights, xp.asarray([0.003, 0.0]))
    np.testing.assert_allclose(got, [highest, lowest, highest - 0.001, 0.347], atol=1e-6)


def test_an_action_and_its_opposite_cancel(robot: Robot) -> None:
    table, heights = action_table(TASK), np.full((441, 4), 0.35)
    there = apply_action(TASK, robot, heights, table)
    np.testing.assert_allclose(apply_action(TASK, robot, there, table[::-1]), heights, atol=1e-9)


def test_numpy_and_jax_agree_on_every_action(robot: Robot) -> None:
    table, heights = action_table(TASK), np.full((441, 4), 0.35)
    jaxed = apply_action(TASK, robot, jnp.asarray(heights), jnp.asarray(table))
    np.testing.assert_allclose(jaxed, apply_action(TASK, robot, heights, table), atol=1e-7)


def test_a_coarser_and_wider_table_by_hand() -> None:
    """5 levels up to 10 mm: -10, -5, 0, 5, 10 mm on each axis."""
    levels = (-10, -5, 0, 5, 10)
    expected = list(itertools.product(levels, levels))
    np.testing.assert_allclose(1000 * action_table(COARSE), expected, atol=1e-5)
    assert action_table(COARSE).dtype == np.float32


@settings(deadline=None, max_examples=100)
@given(
    change=st.lists(st.tuples(*[st.floats(-0.03, 0.03)] * 2), min_size=1, max_size=4),
    task=st.sampled_from([TASK, COARSE]),
)
def test_no_action_is_nearer_than_the_nearest(
    change: list[tuple[float, float]], task: TaskConfig
) -> None:
    """Against all of them, also for changes far beyond the greatest."""
    wanted, table = np.asarray(change), action_table(task).astype(float)
    got = nearest_action(task, wanted)
    assert got.dtype.kind == "i"
    distance = np.linalg.norm(table - wanted[:, None], axis=-1)
    chosen = np.take_along_axis(distance, got[:, None], axis=1)[:, 0]
    np.testing.assert_allclose(chosen, distance.min(axis=1), atol=1e-9)


@pytest.mark.parametrize("task", [TASK, COARSE], ids=["paper", "coarse"])
def test_every_action_is_nearest_to_itself(task: TaskConfig) -> None:
    table = action_table(task)
    np.testing.assert_array_equal(nearest_action(task, table), np.arange(len(table)))


def test_a_batch_of_feet_moves_foot_by_foot(robot: Robot) -> None:
    """A loop that spells the legs out: left +a_x, right -a_x, front +a_y, hind -a_y."""
    rng = np.random.default_rng(0)
    heights, change = rng.uniform(0.3, 0.4, (2, 3, 4)), rng.uniform(-0.003, 0.003, (2, 3, 2))
    got = apply_action(TASK, robot, heights, change)
    for where in np.ndindex(2, 3):
        a_x, a_y = change[where]
        moves = {"LF": a_x + a_y, "RF": -a_x + a_y, "LH": a_x - a_y, "RH": -a_x - a_y}
        expected = [heights[where][k] + moves[leg.name] for k, leg in enumerate(robot.legs)]
        np.testing.assert_allclose(got[where], expected, atol=1e-12)


def test_single_precision_stays_single(robot: Robot) -> None:
    heights = np.full(4, 0.35, np.float32)
    assert apply_action(TASK, robot, heights, action_table(TASK)[3]).dtype == np.float32
    assert leg_signs(robot).dtype == np.float32


def test_reach_is_that_of_the_knees(robot: Robot) -> None:
    """Pushed a hundred times the same way, a foot stops where the knee's range ends."""
    up, down = np.full((2, 4), 0.35)
    for _ in range(100):
        up = apply_action(TASK, robot, up, np.asarray([0.003, 0.0]))
        down = apply_action(TASK, robot, down, np.asarray([0.0, -0.003]))
    low, high = robot.height_range
    np.testing.assert_allclose(up, [high, low, high, low], atol=1e-12)
    np.testing.assert_allclose(down, [low, low, high, high], atol=1e-12)
