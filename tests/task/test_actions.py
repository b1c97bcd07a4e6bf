"""The 441 actions of paper Eq. 3 and what they do to the feet."""

import itertools
import types

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from mjx_balance.config import TaskConfig
from mjx_balance.robots.catalogue import Robot
from mjx_balance.task.actions import action_table, apply_action, leg_signs, nearest_action

TASK = TaskConfig()
COARSE = TaskConfig(action_levels=5, action_max=0.01)


@pytest.mark.parametrize(
    ("task", "levels"),
    [(TASK, [-3 + 6 * n / 20 for n in range(21)]), (COARSE, (-10, -5, 0, 5, 10))],
    ids=["paper", "coarse"],
)
def test_index_counts_roll_slowly_and_pitch_fast(task: TaskConfig, levels: list[float]) -> None:
    """Eq. 3, a = -3 + 6 n / 20 mm; doing nothing is exactly an action."""
    table = action_table(task)
    np.testing.assert_allclose(1000 * table, list(itertools.product(levels, levels)), atol=1e-5)
    assert table.dtype == np.float32
    assert (table[len(table) // 2] == 0).all()


def test_feet_move_by_hand(xp: types.ModuleType, robot: Robot) -> None:
    """LF, RF, LH, RH: left up and right down by a_x, front up and hind down by a_y."""
    changes_mm = [(2, 0), (0, 2), (2, 1), (-3, 3), (0, 0)]
    expected_mm = [
        (352, 348, 352, 348),
        (352, 352, 348, 348),
        (353, 349, 351, 347),
        (350, 356, 344, 350),
        (350, 350, 350, 350),
    ]
    change = xp.asarray(changes_mm, xp.float32) / 1000
    got = apply_action(robot, xp.full((5, 4), 0.35, xp.float32), change)
    np.testing.assert_allclose(1000 * got, expected_mm, atol=1e-3)
    assert got.dtype == leg_signs(robot).dtype == np.float32


def test_heights_stop_at_the_legs_reach(xp: types.ModuleType, robot: Robot) -> None:
    lowest, highest = robot.height_range
    heights = xp.asarray([highest - 0.001, lowest + 0.001, highest - 0.004, 0.35])
    got = apply_action(robot, heights, xp.asarray([0.003, 0.0]))
    np.testing.assert_allclose(got, [highest, lowest, highest - 0.001, 0.347], atol=1e-6)


@settings(deadline=None, max_examples=100)
@given(
    change=st.lists(st.tuples(*[st.floats(-0.03, 0.03)] * 2), min_size=1, max_size=4),
    task=st.sampled_from([TASK, COARSE]),
)
def test_no_action_is_nearer_than_the_nearest(
    change: list[tuple[float, float]], task: TaskConfig
) -> None:
    """Against all of them, also for changes far beyond the greatest."""
    given_change, table = np.asarray(change), action_table(task).astype(float)
    got = nearest_action(task, given_change)
    assert got.dtype.kind == "i"
    distance = np.linalg.norm(table - given_change[:, None], axis=-1)
    chosen = np.take_along_axis(distance, got[:, None], axis=1)[:, 0]
    np.testing.assert_allclose(chosen, distance.min(axis=1), atol=1e-9)
