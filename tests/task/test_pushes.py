"""Pushes: when they come, how large they are, whose they are."""

import dataclasses
import types

import numpy as np
import pytest

from mjx_balance.config import RandomizationConfig, TaskConfig
from mjx_balance.task.pushes import Pushes, draw_velocity, push_decisions, push_velocity

TASK = TaskConfig()
PUSHED = RandomizationConfig(push_min=0.2, push_max=0.4)


@pytest.mark.parametrize(
    ("ctrl_dt", "period", "duration", "decisions"),
    [
        (0.2, 5.0, 26.0, [25, 50, 75, 100, 125]),
        (0.2, 5.0, 25.0, [25, 50, 75, 100]),  # neither at the start nor at the end
        (0.2, 5.0, 25.1, [25, 50, 75, 100, 125]),
        (0.2, 5.0, 5.0, []),
        # 0.5 s is over when decision 3 begins, at 0.6 s; 1.0 s at decision 5; 1.5 s at 8.
        (0.2, 0.5, 2.3, [3, 5, 8, 10]),
        # 3 * 0.4 is 1.2000000000000002, and 0.3 / 0.1 less than 3: rounding moves no push.
        (0.2, 0.4, 1.7, [2, 4, 6, 8]),
        (0.1, 0.3, 1.3, [3, 6, 9, 12]),
        # Two that become due in one decision.
        (0.4, 0.2, 0.9, [1, 1, 2, 2]),
    ],
)
def test_decisions_that_begin_with_a_push(
    ctrl_dt: float, period: float, duration: float, decisions: list[int]
) -> None:
    task = dataclasses.replace(TASK, ctrl_dt=ctrl_dt)
    ranges = dataclasses.replace(PUSHED, push_period=period)
    assert push_decisions(task, ranges, duration).tolist() == decisions


def test_nobody_is_pushed_unless_asked_for() -> None:
    for period in (0.2, 5.0):
        assert not len(push_decisions(TASK, RandomizationConfig(push_period=period), 60.0))


def test_pushes_by_hand(xp: types.ModuleType) -> None:
    """Half of 0.2 to 0.4 m/s is 0.3; a quarter of a turn from x is y, half a turn -x."""
    uniform = xp.asarray([(0.5, 0.25), (0.0, 0.5), (0.25, 0.0), (0.5, 0.125)])
    diagonal = 0.3 / np.sqrt(2)
    expected = [(0, 0.3), (-0.2, 0), (0.25, 0), (diagonal, diagonal)]
    np.testing.assert_allclose(draw_velocity(PUSHED, uniform), expected, atol=1e-7)
    assert draw_velocity(PUSHED, xp.zeros((3, 5, 2), xp.float32)).dtype == xp.float32


def test_a_push_comes_with_its_decision_alone(xp: types.ModuleType) -> None:
    """Two robots at one decision, pushes at decisions 3 and 5; two at once add up."""
    velocity = xp.asarray([[(0.1, 0.2), (0.3, -0.4)], [(-0.5, 0.0), (0.0, 0.6)]])
    for number in range(8):
        now = xp.asarray([number, number])
        got = push_velocity(Pushes(velocity, xp.asarray([(3, 5), (3, 5)])), now)
        expected = {3: [(0.1, 0.2), (-0.5, 0.0)], 5: [(0.3, -0.4), (0.0, 0.6)]}
        np.testing.assert_allclose(got, expected.get(number, np.zeros((2, 2))), rtol=1e-6)
    apart = push_velocity(Pushes(velocity, xp.asarray([(4, 4), (9, 2)])), xp.asarray([4, 2]))
    np.testing.assert_allclose(apart, [(0.4, -0.2), (0.0, 0.6)], rtol=1e-6)


def test_without_pushes_nothing_is_added(xp: types.ModuleType) -> None:
    none = Pushes(xp.zeros((3, 0, 2)), xp.zeros((3, 0), int))
    np.testing.assert_array_equal(push_velocity(none, xp.zeros(3, int)), np.zeros((3, 2)))
