"""The board goes where its scenario says, no faster than it may."""

import dataclasses
import types

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from jaxtyping import TypeCheckError

from mjx_balance.config import TaskConfig
from mjx_balance.config.sea import GRAVITY, bounds, check_platform, significant_angle
from mjx_balance.envs.batch import stacked
from mjx_balance.task.tilt import (
    MOTIONS,
    Scenario,
    Waves,
    board_angle,
    disc_targets,
    draw_scenario,
    num_targets,
    numpy_uniform,
    platform_position,
)

TASK = TaskConfig()
SEA = dataclasses.replace(TASK, board_motions=("sea",))


def random_scenarios(count: int) -> Scenario:
    rng = np.random.default_rng(0)
    targets, phase = rng.uniform(-7, 7, (count, 5, 2)), rng.uniform(0, 10, count)
    rate = rng.uniform(3, 4, count)
    amplitude, turn = rng.uniform(0, 0.5, (count, 8, 2)), rng.uniform(0, 6, (count, 8, 2))
    return Scenario(targets, phase, rate, Waves(amplitude, rng.uniform(0.4, 2, (count, 8)), turn))


def drawn(task: TaskConfig, count: int = 400, seconds: float = 60.0) -> Scenario:
    """Scenarios of training."""
    task = dataclasses.replace(task, episode_length=round(seconds / task.ctrl_dt))
    rngs = [np.random.default_rng(k) for k in range(count)]
    return stacked([draw_scenario(task, numpy_uniform(rng)) for rng in rngs])


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
    scenarios = jax.tree.map(xp.asarray, random_scenarios(4))
    times = xp.asarray(np.random.default_rng(1).uniform(0, 60, (4, 30)))
    batch = board_angle(TASK, scenarios, times)
    each = [jax.tree.map(lambda x: x[k], scenarios) for k in range(4)]  # noqa: B023
    loop = [board_angle(TASK, one, at) for one, at in zip(each, times, strict=True)]
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
    single = jax.tree.map(lambda x: jnp.asarray(x, jnp.float32), scenarios)
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


def test_the_sea_has_bretschneiders_spectrum() -> None:
    """Variance Hs^2 / 16, distributed over frequencies as an integral by numbers says."""
    task = dataclasses.replace(SEA, sea_angle=3.0, sea_period=9.0)
    waves = drawn(task).waves
    assert waves is not None
    variance = (waves.amplitude**2).sum(axis=(1, 2)) / 2
    np.testing.assert_allclose(variance, 3.0**2 / 16)
    peak = 2 * np.pi / 9
    grid = np.linspace(0.3, 2.0, 20_001) * peak
    density = 5 / 16 * 3.0**2 * peak**4 / grid**5 * np.exp(-5 / 4 * (peak / grid) ** 4)
    below = np.append(0.0, np.cumsum((density[1:] + density[:-1]) / 2 * np.diff(grid)))
    assert below[-1] == pytest.approx(0.925 * 3.0**2 / 16, rel=1e-3), "what is left out"
    share = np.interp(np.sort(waves.omega.ravel()), grid, below / below[-1])
    expected = (np.arange(waves.omega.size) + 0.5) / waves.omega.size
    np.testing.assert_allclose(share, expected, atol=0.01)
    assert len(np.unique(waves.omega)) == waves.omega.size, "no wave repeats another's"


def test_a_long_sea_has_the_variance_of_its_spectrum_over_time() -> None:
    """Of ten hours, computed as a complex sum, without the beginning."""
    sea = drawn(dataclasses.replace(SEA, sea_angle=4.0), 1)
    time = np.arange(20.0, 36_000.0, 0.5)
    waves = sea.waves
    assert waves is not None
    angle = board_angle(SEA, sea, time[None])[0]
    rotating = np.exp(1j * (time[:, None] * waves.omega[0]))[..., None]
    by_hand = (rotating * np.exp(1j * waves.phase[0]) * waves.amplitude[0]).sum(axis=1).imag
    np.testing.assert_allclose(angle, by_hand, atol=1e-9)
    assert angle.var(axis=0).sum() == pytest.approx(4.0**2 / 16, rel=0.02)


def test_directions_spread_about_the_heading_with_the_cosine_squared() -> None:
    """A sea from astern, to the left by 30 deg: mean of cos(2 d) over cos^2 d is a half."""
    waves = drawn(dataclasses.replace(SEA, sea_heading=30.0)).waves
    assert waves is not None
    about_x, about_y = np.moveaxis(waves.amplitude, -1, 0)
    heading = np.degrees(np.arctan2(about_x, -about_y)) - 30
    offset = (heading + 180) % 360 - 180
    assert np.abs(offset).max() < 90
    assert offset.mean() == pytest.approx(0, abs=2)
    assert np.cos(np.radians(2 * offset)).mean() == pytest.approx(0.5, abs=0.04)
    anywhere = drawn(SEA).waves
    assert anywhere is not None
    assert np.abs(anywhere.amplitude.mean(axis=(0, 1))).max() < 0.02


@pytest.mark.parametrize("period", [6.0, 10.0, 25.0])
def test_no_sea_exceeds_the_bounds_of_the_config(period: float) -> None:
    """Random seas, and the fastest: all waves along one axis, aligned at their steepest."""
    task = dataclasses.replace(SEA, sea_period=period)
    height, time = significant_angle(task), np.arange(0, 60, 0.05)
    seas = drawn(task, 100)
    angle = board_angle(task, seas, np.tile(time, (100, 1)))
    assert np.abs(angle).max() <= height <= 7.0
    assert np.abs(np.diff(angle, axis=1)).max() / 0.05 <= 3.5
    np.testing.assert_array_equal(angle[:, 0], 0)
    assert np.abs(angle[:, 1]).max() < 2e-3, "at rest at first"
    worst = MOTIONS["sea"](
        dataclasses.replace(task, sea_heading=0.0), 2, lambda shape, low, high: np.zeros(shape)
    )
    assert worst.waves is not None
    steepest = -worst.waves.omega[:, None] * period + np.zeros((8, 2))
    worst = worst._replace(waves=worst.waves._replace(phase=steepest))
    turned = board_angle(task, worst, np.arange(0.9, 1.1, 1e-3) * period)
    rate = np.abs(np.diff(turned, axis=0)).max() / (1e-3 * period)
    most = min(3.5, 7.0 * 7.9731 / period)
    assert 0.99 * most < rate <= most


def test_waves_tilt_the_board_in_the_direction_in_which_they_run() -> None:
    """Rotated by the hinges, X outside, the board's surface has the slope of the wave."""
    task = dataclasses.replace(SEA, sea_heading=70.0)
    zeros = lambda shape, low, high: np.zeros(shape)  # noqa: E731
    scenario = MOTIONS["sea"](task, 2, zeros)
    x, y = np.radians(board_angle(task, scenario, np.asarray([23.0]))[0])
    normal = np.asarray([np.sin(y), -np.sin(x) * np.cos(y), np.cos(x) * np.cos(y)])
    slope = -normal[:2] / normal[2]
    along = np.asarray([np.cos(np.radians(70)), np.sin(np.radians(70))])
    assert abs(np.cross(slope, along)) < 1e-3 * np.linalg.norm(slope)
    waves = scenario.waves
    assert waves is not None
    size = np.linalg.norm(waves.amplitude, axis=-1)
    expected = (size * np.sin(waves.omega * 23.0)).sum()
    assert np.degrees(slope @ along) == pytest.approx(expected, rel=1e-3)


def test_a_platform_moves_as_the_surface_of_the_sea() -> None:
    """Airy's deep water: a deck that follows its surface feels gravity along its own normal.

    With one wave, whose slope is k a = w^2 a / g, at every time.
    """
    task = dataclasses.replace(SEA, sea_heading=-40.0, platform=True)
    sea = MOTIONS["sea"](task, 2, lambda shape, low, high: np.full(shape, 0.3))
    waves = sea.waves
    assert waves is not None
    height = np.linalg.norm(waves.amplitude[:, 2:4], axis=-1)
    np.testing.assert_allclose(height, waves.amplitude[:, 4])
    np.testing.assert_allclose((height**2).sum() / 2, 1.0 / 16)
    one = Waves(*(x[3:4] for x in waves))
    slope = np.degrees(one.omega[0] ** 2 * one.amplitude[0, 4] / 9.81)
    tilt = one.amplitude[:, :2] * slope / np.linalg.norm(one.amplitude[:, :2])
    raft = sea._replace(
        waves=one._replace(amplitude=np.concatenate((tilt, one.amplitude[:, 2:]), axis=1))
    )
    time = np.arange(12.0, 30.0, 0.01)
    x, y = np.radians(board_angle(task, raft, time)).T
    position = platform_position(task, raft, time)
    acceleration = np.diff(position, 2, axis=0) / 0.01**2
    felt = acceleration + np.asarray([0, 0, 9.81])
    np.testing.assert_allclose(felt[:, 0] / felt[:, 2], y[1:-1], atol=1e-3)
    np.testing.assert_allclose(felt[:, 1] / felt[:, 2], -x[1:-1], atol=1e-3)
    assert np.ptp(felt[:, 1] / felt[:, 2]) > 5e-3
    # A wave keeps its shape as it runs: heave rate = -speed * slope, with speed g / w.
    along = one.amplitude[0, 2:4] / height[3]
    rising = np.stack((-y, x), axis=-1) @ along
    heave_rate = np.gradient(position[:, 2], time)[1:-1]
    np.testing.assert_allclose(heave_rate, -9.81 / one.omega[0] * rising[1:-1], atol=1e-3)
    assert np.ptp(heave_rate) > 0.02


def test_tests_check_shapes() -> None:
    """Three directions and four magnitudes, of which NumPy would complain in its own words."""
    with pytest.raises(TypeCheckError, match="Expected type"):
        disc_targets(np.asarray(7.0), np.zeros(3), np.zeros(4))


def test_a_platform_in_training_moves_by_a_share_of_its_height() -> None:
    """Of another one in every episode, in all directions; the board turns as at sea.

    A wave of a height of 0.8 m has an amplitude of 0.8 / 8 m.
    """
    task = dataclasses.replace(SEA, platform=True, sea_height=0.8)
    waves, sea = drawn(task).waves, drawn(SEA).waves
    assert waves is not None
    assert sea is not None
    np.testing.assert_array_equal(waves.amplitude[..., :2], sea.amplitude)
    heave = waves.amplitude[..., 4]
    np.testing.assert_allclose(heave, heave[:, :1].repeat(8, axis=1))
    np.testing.assert_allclose(np.hypot(*waves.amplitude[..., 2:4].T).T, heave)
    share = np.sort(heave[:, 0]) / 0.1
    np.testing.assert_allclose(share, np.linspace(0, 1, 400), atol=0.1)  # uniform


def test_no_platform_falls_faster_than_the_bound() -> None:
    """At the greatest height, with all waves aligned, it falls with g for a moment."""
    task = dataclasses.replace(SEA, platform=True, sea_period=5.0)
    highest = GRAVITY * 25 / bounds()[1]
    task = dataclasses.replace(task, sea_height=highest)
    check_platform(task)
    worst = MOTIONS["sea"](task, 2, lambda shape, low, high: np.zeros(shape))
    assert worst.waves is not None
    at = worst.waves.omega[:, None] * 5.0 * np.ones(5)
    crest = worst._replace(waves=worst.waves._replace(phase=np.pi / 2 - at))
    heave = platform_position(task, crest, np.arange(4.5, 7.0, 1e-3))[:, 2]
    assert np.diff(heave, 2).min() / 1e-6 == pytest.approx(-9.81, rel=0.02)
    assert np.diff(heave, 2).min() / 1e-6 > -9.82


def test_without_a_sea_the_platform_rests(xp: types.ModuleType) -> None:
    ramps = random_scenarios(3)._replace(waves=None)
    still = platform_position(TASK, jax.tree.map(xp.asarray, ramps), xp.zeros((3, 7)))
    assert still.shape == (3, 7, 3)
    assert not still.any()


def test_jumps_leave_room_before_a_fall() -> None:
    """Up to 4 deg, two thirds of the limit of 6, at 20 deg/s; then the board rests."""
    steps = drawn(dataclasses.replace(TASK, board_motions=("steps",), square_share=0.5))
    assert steps.waves is None
    np.testing.assert_array_equal(steps.rate, 20.0)
    jumps = np.linalg.norm(np.diff(steps.targets, axis=1), axis=-1)
    assert 3.5 < jumps.max() <= 4.0
    flat = drawn(dataclasses.replace(TASK, board_motions=("steps",), max_incline=1.0))
    assert 0.9 < np.linalg.norm(flat.targets, axis=-1).max() <= 1.0


def test_several_kinds_are_drawn_equally_often() -> None:
    """Ramps and jumps have calm water, a sea has level targets; ramps alone are as before."""
    every = drawn(dataclasses.replace(TASK, board_motions=("ramps", "steps", "sea")), 600)
    assert every.waves is not None
    sailing, jumping = every.waves.amplitude.any(axis=(1, 2)), every.rate == 20
    moving = every.targets.any(axis=(1, 2))
    np.testing.assert_array_equal(sailing, ~moving)
    assert not (sailing & jumping).any()
    for kind in (sailing, jumping, moving & ~jumping):
        assert kind.mean() == pytest.approx(1 / 3, abs=4 * np.sqrt(2 / 9 / 600))
    ramps, alone = moving & ~jumping, drawn(TASK, 600)
    np.testing.assert_array_equal(every.targets[ramps], alone.targets[ramps])
    np.testing.assert_array_equal(every.phase[ramps], alone.phase[ramps])


def test_a_board_that_starts_tilted_stays_so_until_its_second_target() -> None:
    """In every direction, up to the bound; else the scenario is that of a board that is level."""
    task = dataclasses.replace(TASK, start_incline=5.0)
    level, tilted = drawn(TASK), drawn(task)
    assert level.start is None
    assert tilted.start is not None
    size = np.hypot(*tilted.start.T)
    assert 4.9 < size.max() <= 5.0
    np.testing.assert_allclose(size.mean(), 2.5, atol=0.2)
    np.testing.assert_allclose(tilted.start.mean(axis=0), 0, atol=0.3)
    np.testing.assert_array_equal(tilted.targets[:, 1:], level.targets[:, 1:])
    wait = TASK.target_period - tilted.phase
    times = wait[:, None] * np.asarray((0, 0.5, 0.99))
    angle = board_angle(task, tilted, times)
    np.testing.assert_array_equal(angle, np.tile(tilted.start[:, None], (1, 3, 1)))
    goal = np.clip(tilted.targets[:, 1] - tilted.start, -0.35, 0.35)
    after = board_angle(task, tilted, (wait + 0.1)[:, None])[:, 0]
    np.testing.assert_allclose(after, tilted.start + goal, atol=1e-9)
