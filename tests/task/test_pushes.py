"""Kicks: when they come, how large they are, whose they are."""

import dataclasses
import types

import jax
import numpy as np
import pytest
import scipy.stats

from mjx_balance.config import RandomizationConfig, TaskConfig
from mjx_balance.task.pushes import Pushes, draw_kicks, kick, kicked_decisions

TASK = TaskConfig()
KICKED = RandomizationConfig(push_min=0.2, push_max=0.4)


@pytest.mark.parametrize(
    ("ctrl_dt", "period", "duration", "decisions"),
    [
        (0.2, 5.0, 26.0, [25, 50, 75, 100, 125]),
        (0.2, 5.0, 25.0, [25, 50, 75, 100]),  # neither at the start nor at the end
        (0.2, 5.0, 25.1, [25, 50, 75, 100, 125]),
        (0.2, 5.0, 5.0, []),
        # 0.5 s is over when decision 3 begins, at 0.6 s; 1.0 s at decision 5; 1.5 s at 8.
        (0.2, 0.5, 2.3, [3, 5, 8, 10]),
        # 3 * 0.4 is 1.2000000000000002, and 0.3 / 0.1 less than 3: rounding moves no kick.
        (0.2, 0.4, 1.7, [2, 4, 6, 8]),
        (0.1, 0.3, 1.3, [3, 6, 9, 12]),
        # Two that become due in one decision.
        (0.4, 0.2, 0.9, [1, 1, 2, 2]),
    ],
)
def test_decisions_that_begin_with_a_kick(
    ctrl_dt: float, period: float, duration: float, decisions: list[int]
) -> None:
    task = dataclasses.replace(TASK, ctrl_dt=ctrl_dt)
    ranges = dataclasses.replace(KICKED, push_period=period)
    assert kicked_decisions(task, ranges, duration).tolist() == decisions


def test_nobody_is_kicked_unless_asked_for() -> None:
    for period in (0.2, 5.0):
        assert not len(kicked_decisions(TASK, RandomizationConfig(push_period=period), 60.0))


def test_kicks_by_hand(xp: types.ModuleType) -> None:
    """Half of 0.2 to 0.4 m/s is 0.3; a quarter of a turn from x is y, half a turn -x."""
    uniform = xp.asarray([(0.5, 0.25), (0.0, 0.5), (0.25, 0.0), (0.5, 0.125)])
    diagonal = 0.3 / np.sqrt(2)
    expected = [(0, 0.3), (-0.2, 0), (0.25, 0), (diagonal, diagonal)]
    np.testing.assert_allclose(draw_kicks(KICKED, uniform), expected, atol=1e-7)
    assert draw_kicks(KICKED, xp.zeros((3, 5, 2), xp.float32)).dtype == xp.float32


def test_speeds_and_directions_are_uniform() -> None:
    kicks = draw_kicks(KICKED, np.random.default_rng(0).uniform(size=(4_000, 2)))
    speed, angle = np.linalg.norm(kicks, axis=-1), np.arctan2(kicks[:, 1], kicks[:, 0])
    assert scipy.stats.kstest(speed, "uniform", (0.2, 0.2)).pvalue > 1e-3
    assert scipy.stats.kstest(angle, "uniform", (-np.pi, 2 * np.pi)).pvalue > 1e-3
    assert abs(scipy.stats.spearmanr(speed, angle).statistic) < 0.05


def test_a_kick_comes_with_its_decision_alone(xp: types.ModuleType) -> None:
    """Two robots, kicks at decisions 3 and 5; two at once add up."""
    kicks = xp.asarray([[(0.1, 0.2), (0.3, -0.4)], [(-0.5, 0.0), (0.0, 0.6)]])
    pushes = Pushes(kicks, np.asarray((3, 5)))
    for decision in range(8):
        expected = {3: [(0.1, 0.2), (-0.5, 0.0)], 5: [(0.3, -0.4), (0.0, 0.6)]}
        got = kick(pushes, xp.asarray(decision))
        assert got.shape == (2, 2)
        np.testing.assert_allclose(got, expected.get(decision, np.zeros((2, 2))), rtol=1e-6)
    both = kick(Pushes(kicks, np.asarray((4, 4))), 4)
    np.testing.assert_allclose(both, [(0.4, -0.2), (-0.5, 0.6)], rtol=1e-6)


def test_no_kicks_are_no_kick(xp: types.ModuleType) -> None:
    none = Pushes(xp.zeros((3, 0, 2)), np.zeros(0, int))
    np.testing.assert_array_equal(kick(none, 0), np.zeros((3, 2)))


def test_a_traced_decision_finds_its_kick() -> None:
    kicks, at = np.asarray([(0.1, 0.2), (0.3, -0.4)]), np.asarray((3, 5))
    found = jax.jit(jax.vmap(lambda d: kick(Pushes(kicks, at), d)))(np.arange(7))
    expected = np.zeros((7, 2))
    expected[at] = kicks
    np.testing.assert_allclose(found, expected, rtol=1e-6)
