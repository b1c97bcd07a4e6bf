"""The presets are possible, impossible configs are refused by name."""

import dataclasses
import json
import math
import typing
from typing import Any

import pytest
from hypothesis import example, given, settings
from hypothesis import strategies as st

from mjx_balance.config import (
    PRESETS,
    Config,
    ConfigError,
    DQNConfig,
    RandomizationConfig,
    TaskConfig,
    check,
    fitted,
    flatten,
    from_dict,
    greatest_incline,
    members,
    preset,
    to_dict,
)
from mjx_balance.robots.catalogue import Robot

SECTIONS = {
    "run": Config,
    "task": TaskConfig,
    "randomization": RandomizationConfig,
    "dqn": DQNConfig,
}
NAN, INF = float("nan"), float("inf")


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


def test_a_bare_config_is_preset_papers_and_says_so() -> None:
    """But for the number of envs, which it leaves to the device."""
    assert Config(num_envs=64) == preset("paper")
    assert Config().num_envs is None


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
    assert (dqn.learning_rate, dqn.learning_rate_end_share, dqn.gamma) == (1e-5, 1.0, 0.1)
    assert (dqn.head, dqn.double) == ("joint", False)
    assert config.num_env_steps == 200_000


def test_chosen_numbers_are_those_that_the_benchmarks_were_made_with() -> None:
    """Where the paper is silent; benchmarks/README.md and the shipped policies stand on these."""
    paper, default, best = (preset(name) for name in ("paper", "default", "best"))
    for config in (paper, default, best):
        task, dqn = config.task, config.dqn
        assert (task.action_ramp, task.height_scale, task.episode_length) == (0.1, 0.01, 300)
        assert task.gyro_scale == pytest.approx(0.0174533, rel=1e-5)
        assert task.accel_scale == pytest.approx(0.1712079, rel=1e-5)
        assert dqn.replay_capacity == 2**17
        assert (dqn.epsilon_start, dqn.epsilon_end, dqn.max_grad_norm) == (1.0, 0.05, 10.0)
        assert (config.eval_scenarios, config.eval_duration, config.num_seeds) == (128, 60.0, 1)
        assert (config.eval_every, config.export) == (20_000, "last")
        assert (config.validation_scenarios, config.validation_duration) == (4, 20.0)
        assert (config.seed, config.num_devices) == (0, None)
        assert (config.randomization.payload_offset, config.randomization.payload_height) == (
            0.05,
            0.08,
        )
    task, dqn = paper.task, paper.dqn
    assert (task.imu_mean, task.command_lags, task.reward_tilt) == (1, (), "end")
    assert (dqn.batch_size, dqn.replay_ratio, dqn.target_update_period) == (32, 32, 1_000)
    assert (paper.num_envs, default.num_envs, best.num_envs) == (64, None, None)
    assert (task.reward_toward, task.reward_toward_scale) == (0.4, 1.0)
    assert (dqn.hidden_sizes, dqn.min_replay_size, dqn.epsilon_decay_steps) == (
        (256, 256),
        4_096,
        50_000,
    )
    assert (dqn.mirror, dqn.whiten_steps) == (False, 0)
    for config in (default, best):
        task, dqn = config.task, config.dqn
        assert (task.square_share, task.reward_tilt) == (0.5, "mean")
        assert (dqn.target_update_period, dqn.exploration_noise) == (200, 2)
        assert dqn.learning_rate_end_share == 1 / 300
        assert (task.reward_toward, task.reward_toward_scale) == (1.0, 2.5)
        assert (dqn.head, dqn.hidden_sizes) == ("radial", (64, 64))
        assert (dqn.mirror, dqn.double, dqn.whiten_steps) == (True, False, 50_000)
    assert (default.dqn.gamma, default.dqn.whiten_floor) == (0.1, 1e-3)
    assert (best.dqn.gamma, best.dqn.whiten_floor) == (0.4, 0.02)
    assert (default.dqn.learning_rate, best.dqn.learning_rate) == (1e-2, 3e-3)
    assert (default.dqn.batch_size, best.dqn.batch_size) == (256, 512)
    assert (default.dqn.replay_ratio, best.dqn.replay_ratio) == (32, 64)
    assert (default.dqn.min_replay_size, best.dqn.min_replay_size) == (1_024, 2_048)
    assert (default.dqn.epsilon_decay_steps, best.dqn.epsilon_decay_steps) == (5_000, 10_000)
    assert (default.num_env_steps, best.num_env_steps) == (40_000, 200_000)
    random = best.randomization
    assert (random.gyro_noise, random.accel_noise) == (0.002, 0.023)
    assert (random.payload, random.latency_share) == (5.0, 0.15)
    assert (random.push_min, random.push_max, random.push_period) == (0.0, 0.4, 2.5)
    assert (random.friction_min, random.friction_max, random.gain_spread) == (None, None, 0.0)


def test_preset_quick_replays_few_decisions_often() -> None:
    quick, default = preset("quick"), preset("default")
    assert (quick.num_env_steps, quick.dqn.replay_ratio) == (8_192, 128)
    assert (quick.dqn.epsilon_decay_steps, quick.eval_every) == (3_000, 0)
    dqn = dataclasses.replace(quick.dqn, replay_ratio=32, epsilon_decay_steps=5_000)
    like = dataclasses.replace(quick, preset="default", num_env_steps=40_000, dqn=dqn)
    assert dataclasses.replace(like, eval_every=default.eval_every) == default


def test_preset_smoke_is_the_default_made_small() -> None:
    smoke, default = preset("smoke"), preset("default")
    assert (smoke.task, smoke.randomization) == (default.task, default.randomization)
    assert (smoke.num_envs, smoke.num_env_steps, smoke.log_every) == (64, 8_192, 1_024)
    assert (smoke.eval_scenarios, smoke.eval_duration) == (16, 20.0)
    assert (smoke.eval_every, smoke.validation_scenarios, smoke.validation_duration) == (
        4_096,
        2,
        10.0,
    )
    assert smoke.dqn.head == default.dqn.head
    assert smoke.dqn.epsilon_decay_steps < smoke.num_env_steps
    assert smoke.dqn.whiten_steps < smoke.num_env_steps


def test_numbers_that_follow_from_others() -> None:
    """0.1 s of 4 ms steps are 25; 0.3 of them 7.5, so 8."""
    task = TaskConfig(ctrl_dt=0.1, action_ramp=0.3)
    assert (task.sim_steps, task.ramp_steps) == (25, 8)
    assert TaskConfig(action_ramp=1e-4).ramp_steps == 1
    assert TaskConfig(action_levels=5).num_actions == 25


def test_reach_of_the_legs_at_the_knee_limits(robot: Robot) -> None:
    """Two equal links of 0.213 m span 0.426 * cos(knee / 2); the foot adds its radius."""
    assert robot.height_range == pytest.approx((0.1111, 0.4112), abs=1e-4)
    assert robot.half_track == pytest.approx(0.142)


def test_reach_of_unequal_links_by_coordinates(robot: Robot, bodies: Any) -> None:
    """The foot's place as a complex number: the thigh, then the calf turned by the knee."""
    other = bodies.with_legs(robot, thigh=0.2, calf=0.25, knee=(-2.5, -0.5))
    least, most = (abs(0.2 + 0.25 * complex(math.cos(k), math.sin(k))) for k in (-2.5, -0.5))
    assert other.height_range == pytest.approx((least + 0.022, most + 0.022))


def test_greatest_incline_by_hand(robot: Robot) -> None:
    """0.0612 m of leg above 0.35 m, over 0.335 m: 10.35 deg; from 0.16 m the room is below."""
    task = TaskConfig()
    assert greatest_incline(task, robot) == pytest.approx(10.35, abs=0.02)
    low = dataclasses.replace(task, body_height=0.16)
    assert greatest_incline(low, robot) == pytest.approx(
        math.degrees(math.atan(0.0489 / 0.335)), abs=0.02
    )


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
        ("task", {"reward_fail": NAN}, ("reward_fail is nan",)),
        ("task", {"square_share": -0.1}, ("square_share is -0.1",)),
        ("task", {"reward_tilt": "middle"}, ("reward_tilt is 'middle'", "end, mean")),
        ("randomization", {"payload": -1.0}, ("payload is -1.0",)),
        (
            "randomization",
            {"friction_min": 0.9, "friction_max": 0.8},
            ("friction_max is 0.8", "0.9"),
        ),
        ("randomization", {"latency_share": 1.1}, ("latency_share is 1.1",)),
        (
            "randomization",
            {"push_min": 0.3, "push_max": 0.2},
            ("push_max is 0.2", "push_min, 0.3"),
        ),
        ("randomization", {"push_min": 0.3}, ("push_max is 0.0", "push_min, 0.3")),
        (
            "randomization",
            {"push_max": 0.2, "push_period": 0.1},
            ("push_period is 0.1 s", "ctrl_dt, 0.2 s"),
        ),
        ("dqn", {"head": "round"}, ("head is 'round'", "radial")),
        ("dqn", {"exploration_noise": -1}, ("exploration_noise is -1",)),
        ("dqn", {"gamma": 1.5}, ("gamma is 1.5",)),
        ("dqn", {"learning_rate": NAN}, ("learning_rate is nan",)),
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


ABOVE_0 = (0, -1)
NOT_BELOW_0 = (-1,)
SHARE = (-0.01, 1.01)
BOUNDS: list[tuple[str, str, tuple[Any, ...], tuple[Any, ...]]] = [
    # section, field, values that are possible, values that are not
    ("task", "sim_dt", (0.001, 0.2), (0.0, -0.004)),
    ("task", "ctrl_dt", (0.004, 0.4), (0.0, -0.2, 0.201)),
    ("task", "body_height", (0.25, 0.36), (0.0, -0.3, 0.412, 0.11)),
    ("task", "max_incline", (0.1, 10.0), (0.0, -1.0, 10.5)),
    ("task", "board_rate", (1.4, 100.0), (0.0, -3.5)),
    ("task", "square_share", (0.0, 1.0), SHARE),
    ("task", "target_period", (4.0, 60.0), (0.0, -10.0, 3.99)),
    ("task", "fail_tilt", (0.1, 89.9), (0.0, -6.0, 90.0)),
    ("task", "action_max", (1e-4, 0.01), (0.0, -0.003)),
    ("task", "action_levels", (3, 5, 41), (0, 1, 2, 4, -21)),
    ("task", "action_ramp", (1e-3, 1.0), (0.0, -0.1, 1.01)),
    ("task", "gyro_lags", ((0,), (30, 2)), ((), (-1,), (3, -2))),
    ("task", "accel_lags", ((0,), (30, 2)), ((), (-1,), (3, -2))),
    ("task", "command_lags", ((), (0,), (3, 1)), ((-1,), (2, -1))),
    ("task", "imu_mean", (1, 10), ABOVE_0),
    ("task", "height_scale", (1e-3, 1.0), (0.0, -0.01)),
    ("task", "gyro_scale", (1e-3, 1.0), (0.0, -0.01)),
    ("task", "accel_scale", (1e-3, 1.0), (0.0, -0.01)),
    ("task", "reward_sharpness", (0.0, 10.0), (-0.1,)),
    ("task", "reward_toward_scale", (0.1, 10.0), (0.0, -1.0)),
    ("task", "episode_length", (1, 10_000), ABOVE_0),
    ("randomization", "gyro_noise", (0.0, 0.1), (-0.1,)),
    ("randomization", "accel_noise", (0.0, 0.1), (-0.1,)),
    ("randomization", "payload", (0.0, 8.0), (-0.1,)),
    ("randomization", "payload_offset", (0.0, 0.1), (-0.1,)),
    ("randomization", "friction_min", (None, 0.1, 0.8), (0.0, -0.5)),
    ("randomization", "friction_max", (None, 0.8, 1.5), (0.0, -0.5)),
    ("randomization", "gain_spread", (0.0, 0.9), SHARE),
    ("randomization", "latency_share", (0.0, 1.0), SHARE),
    ("randomization", "push_min", (0.0,), (-0.1,)),
    ("randomization", "push_max", (0.0, 0.1), (-0.1,)),
    ("randomization", "push_period", (0.1, 60.0), (0.0, -1.0)),
    ("dqn", "gamma", (0.0, 1.0), SHARE),
    ("dqn", "learning_rate", (1e-6, 0.1), (0.0, -1e-5)),
    ("dqn", "learning_rate_end_share", (0.0, 1.0), (-1e-5,)),
    ("dqn", "batch_size", (1, 2048), ABOVE_0),
    ("dqn", "replay_ratio", (0.5, 8), (0, -1, 0.1)),
    ("dqn", "replay_capacity", (4_096, 2**20), ABOVE_0),
    ("dqn", "min_replay_size", (1, 131_072), (*ABOVE_0, 131_073)),
    ("dqn", "target_update_period", (1, 10_000), ABOVE_0),
    ("dqn", "epsilon_start", (0.0, 1.0), SHARE),
    ("dqn", "epsilon_end", (0.0, 1.0), SHARE),
    ("dqn", "epsilon_decay_steps", (1, 10**6), ABOVE_0),
    ("dqn", "exploration_noise", (0, 3), NOT_BELOW_0),
    ("dqn", "hidden_sizes", ((1,), (32, 64, 32)), ((), (0,), (64, -1))),
    ("dqn", "whiten_steps", (0, 10**6), NOT_BELOW_0),
    ("dqn", "whiten_floor", (1e-6, 1.0), (0.0, -1e-3)),
    ("dqn", "max_grad_norm", (0.1, 100.0), (0.0, -1.0)),
    ("run", "seed", (0, 2**31 - 1), (-1, 2**31)),
    ("run", "num_envs", (None, 1, 131_072), ABOVE_0),
    ("run", "num_seeds", (1, 10), ABOVE_0),
    ("run", "num_env_steps", (1, 10**9), ABOVE_0),
    ("run", "num_devices", (None, 1, 8), ABOVE_0),
    ("run", "log_every", (1, 10**6), ABOVE_0),
    ("run", "checkpoint_seconds", (0.1, 1e6), ABOVE_0),
    ("run", "solver_iterations", (1, 100), ABOVE_0),
    ("run", "line_search_iterations", (1, 100), ABOVE_0),
    ("run", "eval_scenarios", (1, 4096), ABOVE_0),
    ("run", "eval_duration", (0.2, 600.0), (0.0, -60.0)),
    ("run", "eval_every", (0, 1, 10**6), NOT_BELOW_0),
    ("run", "validation_scenarios", (1, 64), ABOVE_0),
    ("run", "validation_duration", (0.2, 60.0), (0.0, -20.0)),
]


@pytest.mark.parametrize(
    ("section", "name", "value"),
    [(section, name, value) for section, name, values, _ in BOUNDS for value in values],
)
def test_value_at_its_bound_is_possible(section: str, name: str, value: Any) -> None:
    check(changed(section, **{name: value}))


@pytest.mark.parametrize(
    ("section", "name", "value"),
    [(section, name, value) for section, name, _, values in BOUNDS for value in values],
)
def test_value_beyond_its_bound_is_refused(section: str, name: str, value: Any) -> None:
    """By a sentence that begins with the field and the value, and says what would be right."""
    with pytest.raises(ConfigError) as caught:
        check(changed(section, **{name: value}))
    assert f"{name} is {value}" in str(caught.value)
    assert len(str(caught.value)) > len(f"{name} is {value}") + 10


def test_an_unknown_robot_is_refused_with_the_known_ones() -> None:
    with pytest.raises(ConfigError, match="robot is 'rex'; known robots: aliengo"):
        check(changed("run", robot="rex"))


def numbers() -> list[tuple[str, str]]:
    """Every field of every section that is a number."""
    return [
        (section, field.name)
        for section, kind in SECTIONS.items()
        for field in dataclasses.fields(kind)
        if typing.get_type_hints(kind)[field.name] in (int, float, int | None, float | None)
    ]


@pytest.mark.parametrize(("section", "name"), numbers())
@pytest.mark.parametrize("value", [NAN, INF, -INF])
def test_no_number_may_be_infinite(section: str, name: str, value: float) -> None:
    with pytest.raises(ConfigError, match=f"{name} is "):
        check(changed(section, **{name: value}))


@pytest.mark.parametrize(
    ("values", "words"),
    [
        ({"seed": 2**31 - 5, "num_seeds": 6}, ("seed is", "2**31")),
        ({"preset": "papr"}, ("papr", "paper, default, best, quick, smoke")),
        ({"export": "first"}, ("export is 'first'; it must be one of last, best",)),
        ({"export": "best", "eval_every": 0}, ("export is 'best', but eval_every is 0",)),
    ],
)
def test_impossible_run_is_refused(values: dict[str, Any], words: tuple[str, ...]) -> None:
    with pytest.raises(ConfigError) as caught:
        check(changed("run", **values))
    for word in words:
        assert word in str(caught.value)


def test_last_seed_may_be_the_greatest() -> None:
    check(changed("run", seed=2**31 - 5, num_seeds=5))


def test_check_returns_what_it_was_given() -> None:
    config = preset("paper")
    assert check(config) is config


def test_nothing_is_random_in_the_paper() -> None:
    assert preset("paper").randomization == RandomizationConfig()
    assert preset("default").randomization == RandomizationConfig()


@pytest.mark.parametrize("field", dataclasses.fields(RandomizationConfig), ids=lambda x: x.name)
def test_places_and_times_of_what_is_not_there_vary_nothing(field: dataclasses.Field[Any]) -> None:
    """Each alone, at 0.1: another robot's, scaled to its size, differ from ours in these."""
    alone = dataclasses.replace(RandomizationConfig(), **{field.name: 0.1})
    idle = {"payload_offset", "payload_height", "push_min", "push_period"}
    assert alone.varies == (field.name not in idle)
    assert not fitted(preset("default"), "b2").randomization.varies


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


def any_value(kind: Any) -> st.SearchStrategy:
    """Any value of a field's type, possible or not."""
    known = {
        bool: st.booleans(),
        int: st.integers(),
        float: st.floats(allow_nan=False),
        str: st.text(),
        tuple[int, ...]: st.lists(st.integers(), max_size=4).map(tuple),
        tuple[str, ...]: st.lists(st.text(), max_size=4).map(tuple),
    }
    if kind in known:
        return known[kind]
    if dataclasses.is_dataclass(kind):
        hints = typing.get_type_hints(kind)
        return st.builds(
            typing.cast(Any, kind), **{name: any_value(hint) for name, hint in hints.items()}
        )
    if typing.get_origin(kind) is typing.Literal:
        return st.sampled_from(typing.get_args(kind))
    return st.one_of(*(st.none() if k is type(None) else any_value(k) for k in kind.__args__))


@pytest.mark.slow
@settings(deadline=None, max_examples=40)
@given(config=any_value(Config))
def test_any_config_survives_json(config: Config) -> None:
    assert from_dict(Config, json.loads(json.dumps(to_dict(config)))) == config


def test_flat_names_are_unique() -> None:
    """The command line and the tables have one flag and one row for each."""
    leaves = [field.name for kind in SECTIONS.values() for field in dataclasses.fields(kind)]
    flat = flatten(to_dict(preset("paper")))
    for name in set(leaves) - {*SECTIONS, "robot"}:
        assert leaves.count(name) == 1
        assert name in flat
    assert flat["gamma"] == 0.1
    assert not any(isinstance(value, dict) for value in flat.values())
    assert flatten({"a": 1, "b": {"c": [2], "d": {"e": None}}}) == {"a": 1, "c": [2], "e": None}


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
        ({"dqn": 3}, "DQNConfig is 3; it must map"),
        ([1], r"Config is \[1\]; it must map"),
    ],
)
def test_unknown_field_is_refused(values: dict[str, Any], message: str) -> None:
    with pytest.raises(ConfigError, match=message):
        from_dict(Config, values)


JSON = st.recursive(
    st.one_of(st.none(), st.booleans(), st.integers(), st.floats(), st.text(max_size=5)),
    lambda inner: st.one_of(
        st.lists(inner, max_size=3), st.dictionaries(st.text(max_size=5), inner, max_size=3)
    ),
    max_leaves=6,
)


FIELDS = [
    (section, field.name)
    for section, kind in SECTIONS.items()
    for field in dataclasses.fields(kind)
    if field.name not in SECTIONS and field.name != "robot"
]


def complaint(values: Any) -> str | None:
    """What reading and checking values says against them; none if they are possible."""
    try:
        check(from_dict(Config, values))
    except ConfigError as error:
        return str(error)
    return None


@settings(deadline=None, max_examples=300)
@given(field=st.sampled_from(FIELDS), value=JSON)
@example(field=("task", "gyro_lags"), value=3)
@example(field=("task", "command_lags"), value=["x"])
@example(field=("dqn", "hidden_sizes"), value=[None])
@example(field=("run", "preset"), value=[])
@example(field=("task", "reward_level"), value="much")
def test_a_field_of_any_shape_is_possible_or_refused_by_name(
    field: tuple[str, str], value: Any
) -> None:
    """What a damaged file may hold in a field that exists: never another error."""
    section, name = field
    says = complaint({name: value} if section == "run" else {section: {name: value}})
    assert says != ""
    assert says is not None or not isinstance(value, dict)


@settings(deadline=None, max_examples=100)
@given(garbage=JSON)
def test_garbage_is_refused(garbage: Any) -> None:
    says = complaint(garbage)
    assert says if garbage != {} else says is None


def wrong(kind: Any) -> list[Any]:
    """Values that are not of a field's type."""
    values: list[Any] = ["many", [1], {"a": 1}, True]
    if kind is bool or kind is str or typing.get_origin(kind) is typing.Literal:
        values = [3, [1], {"a": 1}]
    if kind in (tuple[int, ...], tuple[str, ...]):
        values = ["many", 3, {"a": 1}, [None], [[1]], ["x"], [True], [1.5]]
    if kind in (int, int | None):
        values += [2.5]
    if type(None) not in typing.get_args(kind):
        values += [None]
    return values


def test_a_value_of_another_type_is_refused_by_name() -> None:
    unnoticed = []
    for section, name in FIELDS:
        for value in wrong(typing.get_type_hints(SECTIONS[section])[name]):
            says = complaint({name: value} if section == "run" else {section: {name: value}})
            if says is None or name not in says:
                unnoticed.append((section, name, value, says))
    assert not unnoticed


SWEEP = ("gamma=0.1,0.4", "epsilon_decay_steps=10,2e3")


def test_a_sweep_is_every_combination_with_seeds_of_its_own() -> None:
    config = dataclasses.replace(preset("default"), seed=7, num_seeds=2, sweep=SWEEP)
    runs = members(check(config))
    assert [own.seed for own in runs] == list(range(7, 15))
    tried = [(own.dqn.gamma, own.dqn.epsilon_decay_steps) for own in runs[::2]]
    assert tried == [(0.1, 10), (0.1, 2_000), (0.4, 10), (0.4, 2_000)]
    assert runs[0].dqn == runs[1].dqn
    for own in runs:
        assert (own.num_seeds, own.sweep) == (1, ())
        assert check(own).dqn.learning_rate == config.dqn.learning_rate
    plain = dataclasses.replace(preset("default"), num_seeds=3)
    assert members(plain) == [dataclasses.replace(plain, num_seeds=1, seed=k) for k in range(3)]


@pytest.mark.parametrize(
    ("sweep", "said"),
    [
        (("batch_size=1,2",), "sweep is 'batch_size=1,2'; it must name one of learning_rate, "),
        (("gamma=0.1", "gamma=0.2"), "sweep is 'gamma=0.2'; it must name one of .*at most once"),
        (("gamma",), "sweep is 'gamma'; after gamma= it must list numbers, as 0.1,0.4"),
        (("gamma=0.1,",), "sweep is 'gamma=0.1,'; after gamma= it must list numbers"),
        (("gamma=0.1,1.5",), "gamma is 1.5; it must be at most 1"),
        (("epsilon_decay_steps=2.7,3",), "epsilon_decay_steps is 2.7; it must be a whole number"),
        (("epsilon_decay_steps=inf",), "epsilon_decay_steps is inf; it must be a whole number"),
        (("epsilon_decay_steps=nan",), "epsilon_decay_steps is nan; it must be a whole number"),
        (("gamma=0.4",), "which is one run; give it more values, or set num_seeds to 2"),
        (("learning_rate=nan",), "learning_rate is nan; it must be a finite number"),
        ("gamma=1", "sweep is 'gamma=1'; it must be texts"),
    ],
)
def test_a_sweep_that_cannot_be_is_refused(sweep: Any, said: str) -> None:
    with pytest.raises(ConfigError, match=said):
        check(dataclasses.replace(preset("default"), sweep=sweep))


def test_the_last_seed_of_a_sweep_counts() -> None:
    config = dataclasses.replace(preset("default"), seed=2**31 - 4, num_seeds=2, sweep=SWEEP[:1])
    check(config)
    with pytest.raises(ConfigError, match="the last of all seeds must be less than"):
        check(dataclasses.replace(config, seed=config.seed + 1))
