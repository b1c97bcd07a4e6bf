"""What a reader who does not see the figures is told: numbers from the data, no empty words."""

import dataclasses
from typing import Any

import numpy as np

from mjx_balance.config import Config
from mjx_balance.evaluation.envelope import Envelope
from mjx_balance.evaluation.rollout import Rollout
from mjx_balance.report import alt_texts


def test_curves_tell_where_the_longest_run_begins_and_ends(metrics_line: Any) -> None:
    short, long = [metrics_line(0, 1)], [metrics_line(k, 1) for k in range(4)]
    text = alt_texts.curves_alt([short, long])
    assert "over 4,096 decisions" in text
    assert "mean tilt in degrees goes from 1 to 0.25 and the number of falls" in text


def test_a_rollout_tells_how_much_each_body_tilts(config: Config) -> None:
    tilt = np.asarray([[0.5, 1.5]])
    stands = Rollout(config.task, tilt, np.asarray([2]), np.zeros((1, 1)), None, 1.0)
    falls = dataclasses.replace(stands, tilt=4 * tilt, fell_at=np.asarray([1]))
    text = alt_texts.rollout_alt("corner", {"policy": stands, "pd-imu": falls})
    assert "of suite corner" in text
    assert "policy 1.000 on average and 1.50 at most; pd-imu 4.000" in text
    assert text.endswith("6.00 at most, and falls.")


def test_a_distribution_tells_what_each_exceeds_in_a_hundredth_of_the_time() -> None:
    edges = np.asarray([0.0, 0.1, 0.5, 2.0, 6.0])
    shares = {
        "policy": np.asarray([0.98, 0.01, 0.01, 0.0]),
        "none": np.asarray([0.1, 0.1, 0.1, 0.7]),
    }
    assert alt_texts.tilt_alt(shares, edges).endswith("in degrees: policy 0.50, none 6.00.")


def test_an_envelope_tells_how_many_cells_have_falls_within_reach_and_beyond() -> None:
    falls = [[0.0, 0.5, 1.0], [0.0, 0.0, 0.5], [1.0, 0.0, 1.0]]
    envelope = Envelope([2.0, 6.0, 12.0], [2.5, 4.0, 6.0], falls, falls, 4.5, 10.0, 2, 30.0, 0)
    text = alt_texts.envelope_alt(envelope)
    assert "speeds from 2.5 to 6 degrees per second and board angles from 2 to 12 degrees" in text
    assert text.endswith(
        "in 1 of the 4 cells that actions and legs can follow, and in 4 of the 5 beyond."
    )


def test_the_reward_is_that_of_the_task(config: Config) -> None:
    task = dataclasses.replace(config.task, reward_level=0.7, reward_toward=0.9, fail_tilt=8.0)
    text = alt_texts.reward_alt(task)
    assert "from 0.7 when level toward 0 at 8 degrees" in text
    assert "from -0.9 to 0.9 as" in text
