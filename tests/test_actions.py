"""The 441 actions of paper Eq. 3 and what they do to the feet."""

import types

import jax.numpy as jnp
import numpy as np
import pytest

from mjx_balance.config import RobotConfig, TaskConfig
from mjx_balance.task.actions import action_table, apply_action, leg_signs

TASK, ROBOT = TaskConfig(), RobotConfig()


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


def test_signs_by_hand() -> None:
    """Left up and right down for a_x; front up and hind down for a_y; order LF RF LH RH."""
    assert leg_signs(ROBOT).tolist() == [[1, -1, 1, -1], [1, 1, -1, -1]]


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
    xp: types.ModuleType, change_mm: tuple[float, float], moved_mm: tuple[float, ...]
) -> None:
    got = apply_action(TASK, ROBOT, xp.full(4, 0.35), xp.asarray(change_mm) / 1000)
    np.testing.assert_allclose(1000 * got, moved_mm, atol=1e-3)


def test_heights_stop_at_the_legs_reach(xp: types.ModuleType) -> None:
    lowest, highest = ROBOT.height_range
    heights = xp.asarray([highest - 0.001, lowest + 0.001, highest - 0.004, 0.35])
    got = apply_action(TASK, ROBOT, heights, xp.asarray([0.003, 0.0]))
    np.testing.assert_allclose(got, [highest, lowest, highest - 0.001, 0.347], atol=1e-6)


def test_an_action_and_its_opposite_cancel() -> None:
    table, heights = action_table(TASK), np.full((441, 4), 0.35)
    there = apply_action(TASK, ROBOT, heights, table)
    np.testing.assert_allclose(apply_action(TASK, ROBOT, there, table[::-1]), heights, atol=1e-9)


def test_numpy_and_jax_agree_on_every_action() -> None:
    table, heights = action_table(TASK), np.full((441, 4), 0.35)
    jaxed = apply_action(TASK, ROBOT, jnp.asarray(heights), jnp.asarray(table))
    np.testing.assert_allclose(jaxed, apply_action(TASK, ROBOT, heights, table), atol=1e-7)
