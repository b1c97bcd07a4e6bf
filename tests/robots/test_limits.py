"""A config is made for a robot, or refused with the names of both."""

import dataclasses
import math
from typing import Any

import pytest

from mjx_balance.config import Config, ConfigError, RandomizationConfig, TaskConfig, preset
from mjx_balance.robots.catalogue import Robot
from mjx_balance.robots.limits import check_robot, for_robot, greatest_incline
from mjx_balance.sim.scene import load_scene


def test_reach_of_unequal_links_by_coordinates(robot: Robot, bodies: Any) -> None:
    """The foot's place as a complex number: the thigh, then the calf turned by the knee."""
    other = bodies.with_legs(robot, thigh=0.2, calf=0.25, knee=(-2.5, -0.5))
    least, most = (abs(0.2 + 0.25 * complex(math.cos(k), math.sin(k))) for k in (-2.5, -0.5))
    assert other.height_range == pytest.approx((least + 0.022, most + 0.022))


@pytest.mark.parametrize(("height", "room"), [(0.35, 0.0612), (0.16, 0.0489)])
def test_greatest_incline_by_hand(robot: Robot, height: float, room: float) -> None:
    """0.0612 m of leg above 0.35 m, or 0.0489 below 0.16, over 0.193 + 0.142 m."""
    incline = greatest_incline(TaskConfig(body_height=height), robot)
    assert incline == pytest.approx(math.degrees(math.atan(room / 0.335)), abs=0.02)


def section(name: str, **values: Any) -> Config:
    part = dataclasses.replace(getattr(preset("paper"), name), **values)
    return dataclasses.replace(preset("paper"), **{name: part})


REFUSED: list[tuple[Config, str]] = [
    (
        section("task", max_incline=12.0),
        "^max_incline is 12.0 deg; on both axes at once the legs of robot quadruped, from "
        "body_height 0.35 m, reach at most 10.3 deg$",
    ),
    (
        section("task", body_height=0.412),
        "^body_height is 0.412 m; the legs of robot quadruped reach from 0.111 to 0.411 m$",
    ),
    (section("task", body_height=0.11), "body_height is 0.11 m; the legs of robot quadruped"),
    (
        section("randomization", friction_max=0.7),
        "friction_max is 0.7; it must not be less than the friction of robot quadruped, 0.8",
    ),
    (
        section("randomization", friction_min=0.9),
        "friction_min is 0.9; it must not exceed the friction of robot quadruped, 0.8",
    ),
]


@pytest.mark.parametrize(("config", "message"), REFUSED)
def test_a_config_that_contradicts_its_robot_is_refused(
    config: Config, message: str, robot: Robot
) -> None:
    with pytest.raises(ConfigError, match=message):
        check_robot(config, robot)
    with pytest.raises(ConfigError, match=message):
        load_scene(config)


@pytest.mark.parametrize(
    "config",
    [
        section("task", max_incline=10.3),
        section("task", body_height=0.25),
        section("randomization", friction_min=0.9, friction_max=1.0),
        section("randomization", friction_max=0.8),
        section("randomization", friction_min=0.8),
        preset("best"),
    ],
)
def test_what_the_robot_can_do_is_possible(config: Config, robot: Robot) -> None:
    assert check_robot(config, robot) is config


def test_legs_that_obey_too_late_are_refused(robot: Robot) -> None:
    """In a decision of 0.2 s, whose ramp takes 0.02, a command may come 0.18 s late."""
    config = preset("paper")
    late = dataclasses.replace(robot, command_delay=0.18)
    assert check_robot(config, late) is config
    late = dataclasses.replace(robot, command_delay=0.184)
    message = (
        "^command_delay of robot quadruped is 0.184 s; for the legs to arrive before the next "
        "decision it must be at most 0.18: ctrl_dt, 0.2 s, less action_ramp's share of it$"
    )
    with pytest.raises(ConfigError, match=message):
        check_robot(config, late)


@pytest.mark.parametrize(
    ("kind", "most", "why"),
    [
        ("sensor", 0.2, "a sample may be a decision old, ctrl_dt"),
        ("command", 0.14, "the legs must arrive before the next decision"),
    ],
)
def test_delays_longer_than_a_decision_are_refused(
    robot: Robot, kind: str, most: float, why: str
) -> None:
    """Of 0.2 s; commands of a robot that takes 0.04 s itself, with a ramp of 0.02 s."""
    slow, config = dataclasses.replace(robot, command_delay=0.04), preset("paper")

    def late(delay: float) -> Config:
        ranges = {f"{kind}_delay": delay, f"{kind}_jitter": 0.02}
        randomization = dataclasses.replace(config.randomization, **ranges)
        return dataclasses.replace(config, randomization=randomization)

    assert check_robot(late(most - 0.02), slow)
    message = (
        f"^{kind}_delay is {most:g} s and {kind}_jitter 0.02 s, together {most + 0.02:g}; {why}: "
        f"together they must be at most {most:g}$"
    )
    with pytest.raises(ConfigError, match=message):
        check_robot(late(most), slow)


def test_another_robots_config_is_scaled_by_its_mass_and_size() -> None:
    """Of 83.5 kg and 0.3285 m, against 15.2 kg and 0.193 m: 5.493 and 1.702.

    It stands 0.571 m high on feet 0.1916 m aside, ours 0.35 m high and 0.142 m aside: it bears
    pushes of 0.1916 / 0.142 * sqrt(0.35 / 0.571) = 1.057 of ours.
    """
    best = preset("best")
    assert for_robot(best, "quadruped") == best
    big = for_robot(best, "b2")
    assert (big.robot, big.task.body_height, big.task.action_max) == ("b2", 0.571, 0.00511)
    assert big.task.height_scale == pytest.approx(0.01702)
    assert big.randomization.payload == pytest.approx(5 * 5.493)
    laid = dataclasses.replace(best, randomization=RandomizationConfig(event_payload=2.0))
    assert for_robot(laid, "b2").randomization.event_payload == pytest.approx(2 * 5.493)
    assert big.randomization.payload_offset == pytest.approx(0.05 * 1.702)
    assert big.randomization.payload_height == pytest.approx(0.08 * 1.702)
    assert big.randomization.push_max == pytest.approx(0.4 * 1.057)
    assert (big.task.fail_tilt, big.task.board_rate) == (6.0, 3.5)
    assert not for_robot(preset("default"), "b2").randomization.varies


def test_an_unknown_robot_is_refused_with_the_known_ones() -> None:
    message = "robot is 'rex'; known robots: aliengo, b2, go1, go2"
    with pytest.raises(ConfigError, match=message):
        for_robot(preset("paper"), "rex")
    with pytest.raises(ConfigError, match=message):
        load_scene(Config(robot="rex"))
