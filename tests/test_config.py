"""The presets are possible, impossible configs are refused by name."""

import dataclasses
import json
from typing import Any

import pytest

from mjx_balance.config import (
    PRESETS,
    Config,
    ConfigError,
    RandomConfig,
    RobotConfig,
    TaskConfig,
    check,
    from_dict,
    preset,
    to_dict,
)


def changed(section: str, **values: Any) -> Config:
    """The paper's config with fields of one section replaced."""
    config = preset("paper")
    if section == "run":
        return dataclasses.replace(config, **values)
    part = dataclasses.replace(getattr(config, section), **values)
    return dataclasses.replace(config, **{section: part})


@pytest.mark.parametrize("name", PRESETS)
def test_every_preset_can_be_run_and_knows_its_name(name: str) -> None:
    assert check(preset(name)).preset == name


def test_preset_paper_has_the_papers_numbers() -> None:
    config = preset("paper")
    task, dqn = config.task, config.dqn
    assert (task.sim_dt, 1 / task.ctrl_dt, task.sim_steps) == (0.004, 5.0, 50)
    assert (task.body_height, task.fail_tilt) == (0.35, 6.0)
    assert (task.max_incline, task.board_rate, task.target_period) == (7.0, 3.5, 10.0)
    assert (task.action_levels, task.action_max, task.num_actions) == (21, 0.003, 441)
    assert (task.reward_level, task.reward_sharpness, task.reward_fail) == (0.4, 1.5, -0.5)
    assert task.gyro_lags == (0, 1, 2, 3, 4, 5)
    assert task.accel_lags == (0, 2, 4, 6, 8, 10, 12, 14, 15)
    assert task.square_share == 0
    assert (dqn.learning_rate, dqn.learning_rate_end, dqn.gamma) == (1e-5, 1e-5, 0.1)
    assert (dqn.head, dqn.double) == ("joint", False)
    assert config.num_env_steps == 200_000


def test_reach_of_the_legs_at_the_knee_limits() -> None:
    """Two equal links of 0.213 m span 0.426 * cos(knee / 2); the foot adds its radius."""
    assert RobotConfig().height_range == pytest.approx((0.1111, 0.4112), abs=1e-4)


@pytest.mark.parametrize(
    ("section", "values", "words"),
    [
        ("task", {"target_period": 3.9}, ("target_period is 3.9", "4 s")),
        ("task", {"board_rate": 1.0}, ("target_period is 10.0", "14 s")),
        ("task", {"ctrl_dt": 0.0}, ("ctrl_dt is 0.0",)),
        ("task", {"ctrl_dt": 0.202}, ("ctrl_dt is 0.202", "sim_dt, 0.004")),
        ("task", {"ctrl_dt": 0.001}, ("ctrl_dt is 0.001", "sim_dt, 0.004")),
        ("task", {"sim_dt": 0.0}, ("sim_dt is 0.0",)),
        ("task", {"max_incline": 12.0}, ("max_incline is 12.0", "10.3 deg")),
        ("task", {"max_incline": 45.0, "board_rate": 20.0}, ("max_incline is 45.0",)),
        ("task", {"body_height": 0.42}, ("body_height is 0.42", "0.411")),
        ("task", {"fail_tilt": 90.0}, ("fail_tilt is 90.0",)),
        ("task", {"action_levels": 20}, ("action_levels is 20", "odd")),
        ("task", {"action_levels": 1}, ("action_levels is 1",)),
        ("task", {"imu_mean": 0}, ("imu_mean is 0",)),
        ("task", {"action_ramp": 0.0}, ("action_ramp is 0.0",)),
        ("task", {"action_ramp": 1.1}, ("action_ramp is 1.1",)),
        ("task", {"gyro_lags": (0, -1)}, ("gyro_lags is (0, -1)",)),
        ("task", {"accel_lags": ()}, ("accel_lags is ()",)),
        ("task", {"reward_fail": float("nan")}, ("reward_fail is nan",)),
        ("task", {"square_share": -0.1}, ("square_share is -0.1",)),
        ("robot", {"total_mass": float("inf")}, ("total_mass is inf",)),
        ("task", {"reward_tilt": "middle"}, ("reward_tilt is 'middle'", "end, mean")),
        ("random", {"payload": -1.0}, ("payload is -1.0",)),
        ("random", {"friction_min": 0.9, "friction_max": 0.8}, ("friction_max is 0.8", "0.9")),
        ("random", {"rate_max": 3.0}, ("rate_max is 3.0", "3.5")),
        ("random", {"incline_max": 11.0}, ("incline_max is 11.0", "10.3 deg")),
        ("random", {"latency_share": 1.1}, ("latency_share is 1.1",)),
        ("dqn", {"head": "round"}, ("head is 'round'", "radial")),
        ("dqn", {"dither": -1}, ("dither is -1",)),
        ("dqn", {"gamma": 1.5}, ("gamma is 1.5",)),
        ("dqn", {"learning_rate": float("nan")}, ("learning_rate is nan",)),
        ("dqn", {"batch_size": 0}, ("batch_size is 0",)),
        ("dqn", {"hidden_sizes": (256, 0)}, ("hidden_sizes is (256, 0)",)),
        ("dqn", {"min_replay_size": 200_000}, ("min_replay_size is 200000", "131072")),
        ("run", {"num_envs": 0}, ("num_envs is 0",)),
        ("run", {"num_envs": 262_144}, ("replay_capacity is 131072", "num_envs = 262144")),
    ],
)
def test_impossible_config_is_refused(
    section: str, values: dict[str, Any], words: tuple[str, ...]
) -> None:
    """The message names the field, its value and what it clashes with."""
    with pytest.raises(ConfigError) as caught:
        check(changed(section, **values))
    for word in words:
        assert word in str(caught.value)


def test_nothing_is_random_in_the_paper() -> None:
    assert preset("paper").random == RandomConfig()
    assert preset("default").random == RandomConfig()


def test_preset_best_sees_every_sample_of_three_decisions_once() -> None:
    task = preset("best").task
    for lags in (task.gyro_lags, task.accel_lags):
        seen = [lag + k for lag in lags for k in range(task.imu_mean)]
        assert seen == list(range(3 * task.sim_steps))
    assert task.command_lags == (0, 1, 2)


def test_a_ramp_may_fill_its_whole_period() -> None:
    check(changed("task", target_period=4.0))


def test_unknown_preset_lists_the_known_ones() -> None:
    with pytest.raises(ConfigError, match="'papr'") as caught:
        preset("papr")
    for name in PRESETS:
        assert name in str(caught.value)


@pytest.mark.parametrize("name", PRESETS)
def test_config_survives_json(name: str) -> None:
    config = preset(name)
    assert from_dict(Config, to_dict(config)) == config
    assert from_dict(Config, json.loads(json.dumps(to_dict(config)))) == config


def test_missing_fields_take_their_defaults() -> None:
    config = from_dict(Config, {"seed": 3, "task": {"gyro_lags": [1, 2]}})
    assert config == Config(seed=3, task=TaskConfig(gyro_lags=(1, 2)))


@pytest.mark.parametrize(
    ("values", "message"),
    [
        ({"sede": 1}, "unknown field 'sede' in Config"),
        ({"task": {"gravity": 9.8}}, "unknown field 'gravity' in TaskConfig"),
    ],
)
def test_unknown_field_is_refused(values: dict[str, Any], message: str) -> None:
    with pytest.raises(ConfigError, match=message):
        from_dict(Config, values)
