"""Suites are what they say, and their scenarios depend on nothing but the seed."""

import dataclasses

import numpy as np
import pytest

from mjx_balance.config import Config, greatest_incline
from mjx_balance.suites import HEADLINE, SEEDS, SUITES, authority, make_scenarios


def test_scenarios_depend_on_the_seed_and_not_on_their_number(config: Config) -> None:
    for suite in SUITES:
        few, many = (make_scenarios(config, suite, n, 60, 3) for n in (2, 5))
        for short, long in zip((*few[0], *few[1]), (*many[0], *many[1]), strict=True):
            np.testing.assert_array_equal(short, long[:2])
    first, other = (make_scenarios(config, "paper", 2, 60, n)[0].targets for n in (3, 4))
    assert not np.array_equal(first, other)


def test_paper_fills_the_disc_and_corner_its_corners(config: Config) -> None:
    paper = make_scenarios(config, "paper", 400, 60, 0)[0].targets
    size = np.linalg.norm(paper, axis=-1)
    assert size.max() <= 7
    assert np.mean(size) == pytest.approx(3.5, abs=0.15)
    assert np.abs(paper.mean(axis=(0, 1))).max() < 0.2
    corner = make_scenarios(config, "corner", 50, 60, 0)[0].targets
    assert np.all(np.abs(corner) == 7)
    assert len(np.unique(corner.reshape(-1, 2), axis=0)) == 4


def test_authority_and_reach_by_hand(config: Config) -> None:
    """15 mm/s over 193 mm, and 61 mm of leg over 335 mm."""
    assert authority(config) == pytest.approx(np.degrees(0.015 / 0.193))
    reach = greatest_incline(config.task, config.robot)
    assert reach == pytest.approx(np.degrees(np.arctan(0.061 / 0.335)), abs=0.2)


def test_fast_and_steep_stay_within_what_can_be_followed(config: Config) -> None:
    fast, _ = make_scenarios(config, "fast", 200, 60, 0)
    assert 3.5 <= fast.rate.min() < 3.6
    assert 4.4 < fast.rate.max() <= authority(config)
    steep, _ = make_scenarios(config, "steep", 400, 60, 0)
    size = np.linalg.norm(steep.targets, axis=-1).max(axis=-1)
    assert 7 < size.max() <= greatest_incline(config.task, config.robot)


@pytest.mark.parametrize(
    ("suite", "field", "least", "most"),
    [
        ("payload", "payload", 0.0, 5.0),
        ("friction", "friction", 0.4, 1.0),
        ("gains", "gain", 0.8, 1.2),
        ("latency", "latency", 1.0, 1.0),
    ],
)
def test_conditions_fill_their_range(
    config: Config, suite: str, field: str, least: float, most: float
) -> None:
    conditions = make_scenarios(config, suite, 300, 10, 0)[1]
    values = getattr(conditions, field)
    margin = 0.03 * (most - least)
    assert least <= values.min() <= least + margin
    assert most - margin <= values.max() <= most
    nominal = make_scenarios(config, "paper", 300, 10, 0)[1]
    for name in conditions._fields:
        if name not in (field, "payload_at"):
            np.testing.assert_array_equal(getattr(conditions, name), getattr(nominal, name))


def test_noise_is_that_of_a_data_sheet(config: Config) -> None:
    sigma = make_scenarios(config, "noise", 3, 10, 0)[1].imu_noise
    np.testing.assert_array_equal(sigma, np.tile((0.002,) * 3 + (0.023,) * 3, (3, 1)))


def test_every_suite_follows_the_configs_incline(config: Config) -> None:
    flat = dataclasses.replace(config, task=dataclasses.replace(config.task, max_incline=2.0))
    for name, suite in SUITES.items():
        if not suite.steep:
            assert np.abs(make_scenarios(flat, name, 20, 60, 0)[0].targets).max() <= 2.0


def test_no_two_purposes_share_a_seed() -> None:
    """What chose or tuned something must not also measure it."""
    seeds = list(dataclasses.asdict(SEEDS).values())
    assert len(set(seeds)) == len(seeds)
    assert set(HEADLINE) <= set(SUITES)
