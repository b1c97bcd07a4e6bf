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
TIMES = np.arange(0, 42, 0.004)


def two_targets(xp: types.ModuleType, phase: float = 0.0) -> Scenario:
    return Scenario(xp.asarray([[7.0, -3.5], [-7.0, 0.0]]), xp.asarray(phase), xp.asarray(3.5))


def random_scenarios(count: int) -> Scenario:
    rng = np.random.default_rng(0)
    rate = np.full(count, 3.5)
    return Scenario(rng.uniform(-7, 7, (count, 5, 2)), rng.uniform(0, 10, count), rate)


@pytest.mark.parametrize(
    ("time", "angle"),
    [
        (0.0, (0.0, 0.0)),
        (0.5, (1.75, -1.75)),
        (1.0, (3.5, -3.5)),
        (1.5, (5.25, -3.5)),
        (2.0, (7.0, -3.5)),
        (9.99, (7.0, -3.5)),
        (10.0, (7.0, -3.5)),
        (10.5, (5.25, -1.75)),
        (11.0, (3.5, 0.0)),
        (12.0, (0.0, 0.0)),
        (14.0, (-7.0, 0.0)),
        (20.0, (-7.0, 0.0)),
        (1000.0, (-7.0, 0.0)),
    ],
)
def test_angle_by_hand(xp: types.ModuleType, time: float, angle: tuple[float, float]) -> None:
    """3.5 deg/s on each axis, a new target every 10 s, at rest past the last."""
    got = board_angle(TASK, two_targets(xp), xp.asarray([time]))
    np.testing.assert_allclose(got, [angle], atol=1e-4)


def test_phase_ages_the_first_target(xp: types.ModuleType) -> None:
    """At phase 9 the board has long met its first target and turns 1 s later."""
    got = board_angle(TASK, two_targets(xp, phase=9.0), xp.asarray([0.0, 1.0, 2.0, 5.0]))
    np.testing.assert_allclose(got, [(7, -3.5), (7, -3.5), (3.5, 0), (-7, 0)], atol=1e-4)


def test_board_never_exceeds_its_rate_on_either_axis() -> None:
    angles = board_angle(TASK, random_scenarios(20), np.tile(TIMES, (20, 1)))
    rate = np.abs(np.diff(angles, axis=1)).max() / 0.004
    assert rate == pytest.approx(3.5, abs=1e-6)


def test_board_arrives_within_every_period_and_stays() -> None:
    scenarios = random_scenarios(20)._replace(phase=np.zeros(20))
    targets = scenarios.targets
    rest = np.linspace(4.0, 9.999, 50)
    for k in range(targets.shape[1]):
        angles = board_angle(TASK, scenarios, np.tile(10 * k + rest, (20, 1)))
        np.testing.assert_allclose(angles, np.tile(targets[:, k, None], (50, 1)), atol=1e-9)


def test_every_board_has_its_own_speed(xp: types.ModuleType) -> None:
    targets = xp.asarray(np.full((2, 1, 2), 6.0))
    scenarios = Scenario(targets, xp.zeros(2), xp.asarray([2.0, 4.0]))
    got = board_angle(TASK, scenarios, xp.asarray([[1.0, 2.0], [1.0, 2.0]]))
    np.testing.assert_allclose(got[..., 0], [[2, 4], [4, 6]], atol=1e-5)


def test_batch_equals_a_loop(xp: types.ModuleType) -> None:
    scenarios = Scenario(*(xp.asarray(x) for x in random_scenarios(4)))
    times = xp.asarray(np.random.default_rng(1).uniform(0, 60, (4, 30)))
    batch = board_angle(TASK, scenarios, times)
    loop = [board_angle(TASK, Scenario(*(x[k] for x in scenarios)), times[k]) for k in range(4)]
    np.testing.assert_allclose(batch, np.stack(loop), atol=1e-6)


@pytest.mark.parametrize(
    ("direction", "magnitude", "target"),
    [
        (0.0, 0.5, (3.5, 0.0)),
        (0.25, 1.0, (0.0, 7.0)),
        (0.5, 1.0, (-7.0, 0.0)),
        (0.625, 2 / 7, (-(2**0.5), -(2**0.5))),
        (0.9, 0.0, (0.0, 0.0)),
    ],
)
def test_disc_target_by_hand(
    xp: types.ModuleType, direction: float, magnitude: float, target: tuple[float, float]
) -> None:
    got = disc_targets(xp.asarray(7.0), xp.asarray(direction), xp.asarray(magnitude))
    np.testing.assert_allclose(got, target, atol=1e-5)


def test_disc_targets_fill_the_disc_and_nothing_else() -> None:
    rng = np.random.default_rng(0)
    targets = disc_targets(7.0, rng.uniform(size=10_000), rng.uniform(size=10_000))
    total = np.linalg.norm(targets, axis=-1)
    assert total.max() <= 7.0
    assert total.mean() == pytest.approx(3.5, abs=0.1), "magnitude is uniform, not area"
    assert np.abs(targets.mean(axis=0)).max() < 0.15, "no direction is preferred"


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
    # A nanosecond late: k * dt / period may round to just below a whole number.
    times = np.arange(steps + 1 - phase) * dt + 1e-9
    scenario = Scenario(targets, np.asarray(phase * dt), np.asarray(rate))
    got = board_angle(task, scenario, times)
    np.testing.assert_allclose(got, np.asarray(walked)[phase:], atol=1e-6)


def test_jax_agrees_in_float32_to_the_end_of_an_episode() -> None:
    """60 s in float32: a time is good to 4 us, an angle at 3.5 deg/s to 1e-4 deg."""
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


@pytest.mark.parametrize(("duration", "count"), [(60.0, 7), (61.0, 8), (5.0, 2), (10.0, 2)])
def test_targets_by_hand(duration: float, count: int) -> None:
    assert num_targets(TASK, duration) == count
