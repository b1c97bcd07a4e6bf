"""The board goes where its scenario says, no faster than it may."""

import types

import jax.numpy as jnp
import numpy as np
import pytest

from mjx_balance.config import Config, TaskConfig
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


def test_numpy_and_jax_agree() -> None:
    scenario, times = random_scenarios(4), np.tile(TIMES[::25], (4, 1))
    jaxed = Scenario(*(jnp.asarray(x) for x in scenario))
    got = board_angle(TASK, jaxed, jnp.asarray(times))
    np.testing.assert_allclose(got, board_angle(TASK, scenario, times), atol=1e-4)


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


@pytest.mark.parametrize(("duration", "count"), [(60.0, 7), (61.0, 8), (5.0, 2)])
def test_targets_last_for_any_phase(duration: float, count: int, config: Config) -> None:
    """An episode that starts just before a turn still finds a fresh target for its last one."""
    assert num_targets(config.task, duration) == count
    assert np.floor((duration + 9.999) / 10.0) <= count - 1
