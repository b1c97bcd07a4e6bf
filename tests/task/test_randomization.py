"""Random numbers become domain parameters: each its own, over the whole of its range."""

import types
from functools import partial
from typing import Any

import numpy as np
import pytest

from mjx_balance.config import RandomizationConfig
from mjx_balance.robots.catalogue import Robot
from mjx_balance.task.randomization import DRAWS, DomainParams, draw_params, param_draws

RANDOM = RandomizationConfig(
    gyro_noise=0.01,
    accel_noise=0.2,
    payload=5.0,
    payload_offset=0.04,
    payload_height=0.07,
    friction_min=0.4,
    friction_max=1.2,
    gain_spread=0.3,
    latency_share=0.25,
)


def test_every_draw_lands_in_its_own_field(
    xp: types.ModuleType, robot: Robot, compiled: Any
) -> None:
    """Payload, its place on x and on y, friction, gain, delay, by hand; noise per channel."""
    draws = ([0.1, 0.2, 0.7, 0.25, 0.9, 0.2], [0.0] * 6, [1 - 1e-7] * 6)
    got = compiled(partial(draw_params, RANDOM, robot))(xp.asarray(draws))
    np.testing.assert_allclose(got.imu_noise, [(0.01,) * 3 + (0.2,) * 3] * 3, rtol=1e-6)
    np.testing.assert_allclose(got.payload, (0.5, 0, 5), rtol=1e-6)
    at = [(-0.024, 0.016, 0.07), (-0.04, -0.04, 0.07), (0.04, 0.04, 0.07)]
    np.testing.assert_allclose(got.payload_at, at, rtol=1e-5)
    np.testing.assert_allclose(got.friction, np.outer((0.6, 0.4, 1.2), np.ones(4)), rtol=1e-6)
    gain = np.asarray((1.24, 0.7, 1.3))[:, None, None] * np.ones((4, 3))
    np.testing.assert_allclose(got.gain, gain, rtol=1e-6)
    assert got.delay.tolist() == [1, 1, 0]


@pytest.mark.parametrize(
    ("least", "most", "expected"),
    [(None, None, (0.8, 0.8)), (0.5, None, (0.5, 0.8)), (None, 0.9, (0.8, 0.9))],
)
def test_friction_that_is_not_given_is_the_robots(
    robot: Robot, least: float | None, most: float | None, expected: tuple[float, float]
) -> None:
    ranges = RandomizationConfig(friction_min=least, friction_max=most)
    uniform = np.stack((np.zeros(DRAWS), np.full(DRAWS, 1 - 1e-12)))
    np.testing.assert_allclose(draw_params(ranges, robot, uniform).friction[:, 0], expected)


@pytest.mark.parametrize("share", [0.0, 0.25, 1.0])
def test_share_of_delayed_envs(robot: Robot, share: float) -> None:
    """A draw equal to the share is not delayed: of share 0, nobody is."""
    uniform = np.tile(np.linspace(0, 1, 10, endpoint=False)[:, None], DRAWS)
    got = draw_params(RandomizationConfig(latency_share=share), robot, uniform).delay
    assert got.tolist() == [float(k < 10 * share) for k in range(10)]


def test_the_paper_leaves_everything_as_it_is(robot: Robot) -> None:
    got = draw_params(RandomizationConfig(), robot, np.random.default_rng(0).uniform(size=DRAWS))
    assert not got.imu_noise.any()
    assert (got.payload, got.delay) == (0.0, 0.0)
    assert (set(got.friction.ravel()), set(got.gain.ravel())) == ({0.8}, {1.0})


def test_a_share_of_the_envs_has_softer_servos(robot: Robot) -> None:
    """Of softness uniform in [0, 1); the number is drawn after all others."""
    ranges = RandomizationConfig(soft_share=0.4)
    assert ranges.varies
    assert (param_draws(ranges), param_draws(RandomizationConfig())) == (7, 6)
    uniform = np.zeros((4, 7))
    uniform[:, 6] = 0.0, 0.1, 0.39, 0.41
    np.testing.assert_allclose(draw_params(ranges, robot, uniform).softness, (0, 0.25, 0.975, 0))


def test_a_batch_keeps_its_shape_and_type(
    xp: types.ModuleType, robot: Robot, compiled: Any
) -> None:
    uniform = xp.asarray(np.random.default_rng(0).uniform(size=(2, 3, DRAWS)), xp.float32)
    draw = compiled(partial(draw_params, RANDOM, robot))
    got = draw(uniform)
    shapes = DomainParams((2, 3, 6), (2, 3), (2, 3, 3), (2, 3, 4), (2, 3, 4, 3), (2, 3), (2, 3))
    assert DomainParams(*(value.shape for value in got)) == shapes
    assert {value.dtype for value in got} == {np.dtype(np.float32)}
    alone = draw(uniform[1, 2])
    for whole, one in zip(got, alone, strict=True):
        np.testing.assert_array_equal(whole[1, 2], one)
