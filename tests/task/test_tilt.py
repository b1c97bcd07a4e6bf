"""The board goes where its scenario says, no faster than it may."""

import dataclasses
import types

import jax.numpy as jnp
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from mjx_balance.config import TaskConfig
from mjx_balance.task.tilt import Scenario, board_angle, disc_targets, num_targets

TASK = TaskConfig()


def random_scenarios(count: int) -> Scenario:
    rng = np.random.default_rng(0)
    targets, phase = rng.uniform(-7, 7, (count, 5, 2)), rng.uniform(0, 10, count)
    return Scenario(targets, phase, rng.uniform(3, 4, count))


@pytest.mark.parametrize(
    ("phase", "course"),
    [
        (
            0.0,
            {
                0.0: (0, 0),
                0.5: (1.75, -1.75),
                1.5: (5.25, -3.5),
                2.0: (7, -3.5),
                10.0: (7, -3.5),
                10.5: (5.25, -1.75),
                12.0: (0, 0),
                14.0: (-7, 0),
                1000.0: (-7, 0),
            },
        ),
        # The board has long met its first target, and turns 1 s later.
        (9.0, {0.0: (7, -3.5), 1.0: (7, -3.5), 2.0: (3.5, 0), 5.0: (-7, 0)}),
    ],
)
def test_angle_by_hand(
    xp: types.ModuleType, phase: float, course: dict[float, tuple[float, float]]
) -> None:
    """3.5 deg/s on each axis, a new target every 10 s, at rest past the last."""
    scenario = Scenario(*map(xp.asarray, ([[7.0, -3.5], [-7.0, 0.0]], phase, 3.5)))
    got = board_angle(TASK, scenario, xp.asarray(list(course)))
    np.testing.assert_allclose(got, list(course.values()), atol=1e-4)


def test_batch_equals_a_loop(xp: types.ModuleType) -> None:
    """Boards differ in targets, phase and speed."""
    scenarios = Scenario(*map(xp.asarray, random_scenarios(4)))
    times = xp.asarray(np.random.default_rng(1).uniform(0, 60, (4, 30)))
    batch = board_angle(TASK, scenarios, times)
    loop = [board_angle(TASK, Scenario(*(x[k] for x in scenarios)), times[k]) for k in range(4)]
    np.testing.assert_allclose(batch, np.stack(loop), atol=1e-6)


@settings(deadline=None, max_examples=60)
@given(data=st.data())
def test_a_turning_target_under_a_rate_limit_gives_the_same_board(data: st.DataObject) -> None:
    """The servo in the flesh: one physics step after the other, from level, targets in turn."""
    dt, per_period = 0.004, data.draw(st.integers(25, 60))
    rate = data.draw(st.floats(0.5, 20.0))
    phase = data.draw(st.integers(0, per_period - 1))
    # Half of what the board can cross in one period, so that it always arrives.
    most = 0.499 * rate * dt * per_period
    targets = np.asarray(
        data.draw(st.lists(st.tuples(*[st.floats(-most, most)] * 2), min_size=1, max_size=4))
    )
    steps = per_period * (len(targets) + 1)
    angle, walked = np.zeros(2), [np.zeros(2)]
    for k in range(steps):
        goal = targets[min(k // per_period, len(targets) - 1)]
        angle = angle + np.clip(goal - angle, -rate * dt, rate * dt)
        walked.append(angle)
    task = dataclasses.replace(TASK, target_period=per_period * dt)
    # A nanosecond later: k * dt / period may round to just below a whole number.
    times = np.arange(steps + 1 - phase) * dt + 1e-9
    scenario = Scenario(targets, np.asarray(phase * dt), np.asarray(rate))
    got = board_angle(task, scenario, times)
    np.testing.assert_allclose(got, np.asarray(walked)[phase:], atol=1e-6)


def test_jax_agrees_in_float32_to_the_end_of_an_episode() -> None:
    """60 s in float32: a time is good to 4 us, an angle at 4 deg/s to 1e-4 deg."""
    scenarios, times = random_scenarios(8), np.tile(np.arange(0, 60, 0.05), (8, 1))
    single = Scenario(*(jnp.asarray(x, jnp.float32) for x in scenarios))
    got = board_angle(TASK, single, jnp.asarray(times, jnp.float32))
    assert got.dtype == jnp.float32
    np.testing.assert_allclose(got, board_angle(TASK, scenarios, times), atol=2e-4)


@settings(deadline=None, max_examples=100)
@given(
    incline=st.floats(0.1, 20.0),
    draws=st.lists(st.tuples(*[st.floats(0, 1, exclude_max=True)] * 2), min_size=1, max_size=5),
)
def test_disc_targets_are_polar_coordinates(
    incline: float, draws: list[tuple[float, float]]
) -> None:
    """First the direction, then the size: the complex number size * e^(2 pi i direction)."""
    direction, magnitude = np.asarray(draws).T
    expected = incline * magnitude * np.exp(2j * np.pi * direction)
    got = disc_targets(np.asarray(incline), direction, magnitude)
    np.testing.assert_allclose(got[:, 0] + 1j * got[:, 1], expected, atol=1e-9)


def test_every_scenario_may_have_its_own_incline(xp: types.ModuleType) -> None:
    inclines, quarter = xp.asarray([[2.0], [6.0]]), xp.full((2, 3), 0.25)
    got = disc_targets(inclines, quarter, xp.full((2, 3), 0.5))
    np.testing.assert_allclose(got[..., 1], [[1.0] * 3, [3.0] * 3], atol=1e-6)


@settings(deadline=None, max_examples=200)
@given(period=st.sampled_from([0.5, 2.0, 10.0]), steps=st.integers(1, 20_000))
def test_targets_last_for_any_phase_and_none_is_wasted(period: float, steps: int) -> None:
    """A board just before its turn at the start has the most turns ahead of it."""
    task = dataclasses.replace(TASK, target_period=period)
    before_the_end = steps * 0.004 - 1e-7
    last = int(np.floor((before_the_end + period - 1e-6) / period))
    assert num_targets(task, steps * 0.004) in (last + 1, last + 2)
    youngest = int(np.floor(before_the_end / period))
    assert num_targets(task, steps * 0.004) == youngest + 2
