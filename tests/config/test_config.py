"""The presets are possible, impossible configs are refused by name."""

import ast
import dataclasses
import hashlib
import json
import re
import subprocess
import sys
import typing
from pathlib import Path
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
    check_same_config,
    expand_runs,
    flatten,
    from_dict,
    preset,
    to_dict,
)
from mjx_balance.files.run_folder import RunFolderError
from mjx_balance.training.sizing import size_to_device

SECTIONS = {"task": TaskConfig, "randomization": RandomizationConfig, "dqn": DQNConfig}
SECTION = {field.name: key for key, kind in SECTIONS.items() for field in dataclasses.fields(kind)}
"""Field -> section; those of the run itself are not in it."""
HINTS = {
    name: hint
    for kind in (*SECTIONS.values(), Config)
    for name, hint in typing.get_type_hints(kind).items()
    if name not in SECTIONS
}


def changed(config: Config | None = None, /, **values: Any) -> Config:
    """A config, the paper's if none, with fields of any section replaced."""
    config = config or preset("paper")
    for name, value in values.items():
        if name in SECTION:
            section = getattr(config, SECTION[name])
            name, value = SECTION[name], dataclasses.replace(section, **{name: value})
        config = dataclasses.replace(config, **{name: value})
    return config


def as_json(name: str, value: Any) -> dict[str, Any]:
    """A config file with one field."""
    return {SECTION[name]: {name: value}} if name in SECTION else {name: value}


def test_a_config_needs_no_robot_no_engine_and_no_jax() -> None:
    code = (
        "import sys, mjx_balance.config as c; c.check(c.preset('best')); print(*sys.modules);"
        "assert not {'mujoco', 'jax', 'mjx_balance.robots'} & set(sys.modules)"
    )
    package = "import sys, types; sys.modules['mjx_balance'] = m = types.ModuleType('mjx_balance')"
    folder = Path(sys.modules["mjx_balance"].__file__ or "").parent
    code = f"{package}; m.__path__ = [{str(folder)!r}]; {code}"
    subprocess.run([sys.executable, "-c", code], check=True, capture_output=True)


@pytest.mark.parametrize("name", PRESETS)
def test_every_preset_can_be_run_and_survives_json(name: str) -> None:
    config = preset(name)
    assert check(config) is config
    assert config.preset == name
    assert from_dict(Config, json.loads(json.dumps(to_dict(config)))) == config


def numbers(text: str) -> dict[str, Any]:
    """Reads "field=value ..."."""
    entries = (entry.partition("=") for entry in text.split())
    return {name: ast.literal_eval(value) for name, _, value in entries}


PAPER = numbers(  # sections 2 to 4 of the paper
    """sim_dt=0.004 ctrl_dt=0.2 body_height=0.35 fail_tilt=6.0 gamma=0.1 max_incline=7.0
    board_rate=3.5 target_period=10.0 square_share=0.0 action_levels=21 action_max=0.003
    num_env_steps=200_000 head='joint' reward_level=0.4 reward_sharpness=1.5 reward_fail=-0.5
    double=False gyro_lags=[0,1,2,3,4,5] accel_lags=[0,2,4,6,8,10,12,14,15] imu_mean=1
    command_lags=[] reward_tilt='end' learning_rate=1e-5 learning_rate_end_share=1.0"""
)
CHOSEN = numbers(  # where the paper is silent; scales of 1 deg and 9.81 sin(1 deg)
    """action_ramp=0.1 height_scale=0.01 episode_length=300 gyro_scale=0.01745329
    accel_scale=0.171208107 replay_capacity=131_072 epsilon_start=1.0 epsilon_end=0.05
    max_grad_norm=10.0 eval_scenarios=128 eval_duration=60.0 num_seeds=1 eval_every=20_000
    export='last' validation_scenarios=4 seed=0 validation_duration=20.0 num_devices=None
    payload_offset=0.05 payload_height=0.08 batch_size=32 replay_ratio=32 num_envs=64
    target_update_period=1_000 reward_toward=0.4 reward_toward_scale=1.0 hidden_sizes=[256,256]
    min_replay_size=4_096 epsilon_decay_steps=50_000 mirror=False whiten_steps=0 whiten_floor=1e-3
    gain_spread=0.0 push_min=0.0 friction_min=None friction_max=None log_every=1_024"""
)


def test_preset_paper_has_the_papers_numbers() -> None:
    flat = flatten(to_dict(preset("paper")))
    for field, value in (PAPER | CHOSEN).items():
        assert flat[field] == (pytest.approx(value) if isinstance(value, float) else value), field
    assert Config(num_envs=64) == preset("paper")
    assert Config().num_envs is None


@pytest.mark.parametrize(
    ("name", "digest"),
    [
        ("default", "4d84e143"),
        ("best", "ccea5988"),
        ("quick", "57c944df"),
        ("smoke", "51dacd1d"),
        ("real", "0ad9ffae"),
    ],
)
def test_presets_are_those_that_results_were_measured_with(name: str, digest: str) -> None:
    """Digests of what differs from the paper: who means to change it, changes it here."""
    bare, own = (flatten(to_dict(config)) for config in (Config(), preset(name)))
    changes = {field: value for field, value in own.items() if value != bare[field]}
    text = json.dumps(changes, sort_keys=True)
    assert hashlib.sha256(text.encode()).hexdigest()[:8] == digest, changes


@pytest.mark.parametrize(
    ("name", "samples"),
    [("paper", 32), ("default", 32), ("best", 64), ("quick", 128), ("smoke", 32), ("real", 64)],
)
@pytest.mark.parametrize("num_envs", [None, 64, 512, 2_048])
def test_the_replay_ratio_does_not_depend_on_the_number_of_envs(
    name: str, samples: int, num_envs: int | None
) -> None:
    """The paper's is one gradient step of 32 transitions per decision, as in a DQN of one env."""
    unsized = changed(preset(name), num_envs=num_envs)
    config = size_to_device(unsized)
    assert config.num_envs is not None
    updates = config.dqn.updates_per_step(config.num_envs)
    assert updates * config.dqn.batch_size == samples * config.num_envs
    assert config.dqn == unsized.dqn, "nothing that a user set was changed"


def test_numbers_that_follow_from_others() -> None:
    """0.1 s of 4 ms steps are 25; 0.3 of them 7.5, so 8."""
    task = TaskConfig(ctrl_dt=0.1, action_ramp=0.3)
    assert (task.sim_steps, task.ramp_steps) == (25, 8)
    assert TaskConfig(action_ramp=1e-4).ramp_steps == 1
    assert TaskConfig(action_levels=5).num_actions == 25


ABOVE_0, SHARE = (0, -1), (-0.01, 1.01)
BOUNDS: list[tuple[str, tuple[Any, ...], tuple[Any, ...]]] = [
    # fields, values that are possible, values that are not
    ("sim_dt", (0.001, 0.2), (0.0, -0.004, 1e-320)),
    ("ctrl_dt", (0.004, 0.4), (0.0, -0.2, 0.201)),
    ("body_height board_rate payload_offset", (1.4,), (-0.3,)),
    ("body_height board_rate", (100.0,), (0.0,)),
    ("max_incline", (0.1, 10.0), (0.0, -1.0, 45.0)),
    ("square_share gamma latency_share ideal_share soft_share", (0.0, 1.0), SHARE),
    ("epsilon_start epsilon_end", (0.0, 1.0), SHARE),
    ("target_period", (4.0, 60.0), (0.0, -10.0, 3.99)),
    ("board_motions", (("sea",), ("ramps", "steps", "sea")), ((), ("sail",), ("sea", "sea"))),
    ("step_rate", (0.4, 100.0), (0.0, -1.0, 0.39)),
    ("start_incline", (0.0, 5.99), (-1.0, 6.0, 90.0)),
    ("sea_angle", (None, 0.0, 4.38), (-1.0, 4.4, 7.01)),
    ("sea_period", (1.0, 30.0), (0.0, -10.0)),
    ("sea_height", (0.0, 1.0, 30.0), (-0.5,)),
    ("sea_heading", (None, -360.0, 0.0, 360.0), (-361.0, 361.0)),
    ("fail_tilt", (0.1, 89.9), (0.0, -6.0, 90.0)),
    ("action_max", (1e-4, 0.01), (0.0, -0.003)),
    ("action_levels", (3, 5, 41), (0, 1, 2, 4, -21, 203)),
    ("action_ramp", (1e-3, 1.0), (0.0, -0.1, 1.01)),
    ("gyro_lags accel_lags", ((0,), (30, 2)), ((), (-1,), (3, -2), (10_001,))),
    ("command_lags", ((), (0,), (3, 1)), ((-1,), (2, -1), (1_001,))),
    ("imu_mean", (1, 10), (0, -1, 10_001)),
    ("mean_times filter_times", ((), (0.5,), (30.0, 4.0)), ((0.0,), (4.0, -1.0), (10_001.0,))),
    ("height_scale gyro_scale accel_scale reward_toward_scale", (1e-3, 1.0), (0.0, -0.01)),
    ("reward_level reward_toward reward_fail", (-1e6, 1e6), (-1.1e6, 1.1e6)),
    ("reward_sharpness", (0.0, 10.0), (-0.1,)),
    ("gyro_noise accel_noise payload push_max", (0.0, 0.1), (-0.1,)),
    ("gyro_bias gyro_bias_drift accel_bias accel_bias_drift", (0.0, 0.1), (-0.1,)),
    ("sensor_delay sensor_jitter command_delay command_jitter", (0.0, 0.1), (-0.1,)),
    ("encoder_offset reading_offset", (0.0, 0.1), (-0.1,)),
    ("imu_tilt", (0.0, 0.5), (-0.1, 0.51)),
    ("event_payload", (0.0, 5.0), (-0.1,)),
    ("event_grip event_strength", (0.01, 1.0), (0.0, -0.1, 1.01)),
    ("imu_scale dropout", (0.0, 0.9), (-0.1, 1.0)),
    ("friction_min friction_max", (None, 0.8), (0.0, -0.5)),
    ("gain_spread", (0.0, 0.9), (1.0, -0.01)),
    ("push_min", (0.0,), (-0.1, 0.3)),
    ("push_period huber_delta", (0.1, 60.0), (0.0, -1.0)),
    ("learning_rate", (1e-6, 0.1), (0.0, -1e-5)),
    ("learning_rate_end_share", (0.0, 1.0), (-1e-5,)),
    ("replay_ratio", (0.5, 8), (0, -1, 0.1)),
    ("replay_capacity", (4_096, 2**20), (*ABOVE_0, 63)),
    ("min_replay_size", (1, 131_072), (*ABOVE_0, 131_073)),
    ("batch_size target_update_period epsilon_decay_steps num_seeds", (1, 2_048), ABOVE_0),
    ("exploration_noise whiten_steps eval_every", (0, 1, 10**6), (-1,)),
    ("hidden_sizes", ((1,), (32, 64, 32)), ((), (0,), (64, -1))),
    ("whiten_floor max_grad_norm checkpoint_seconds", (1e-6, 100.0), (0.0, -1e-3)),
    ("seed", (0, 2**31 - 1), (-1, 2**31)),
    ("num_envs", (None, 1, 131_072), ABOVE_0),
    ("num_devices", (None, 1, 8), ABOVE_0),
    ("num_env_steps log_every episode_length eval_scenarios", (1, 10**6), ABOVE_0),
    ("solver_iterations line_search_iterations", (1, 1_000), (0, 1_001)),
    ("eval_duration validation_duration", (0.2, 600.0), (0.0, -60.0)),
    ("validation_scenarios", (1, 64), ABOVE_0),
]


def bounds(which: int) -> list[tuple[str, Any]]:
    """Every field with each of its possible (1) or impossible (2) values."""
    return [(name, value) for row in BOUNDS for name in row[0].split() for value in row[which]]


@pytest.mark.parametrize(("name", "value"), bounds(1))
def test_value_at_its_bound_is_possible(name: str, value: Any) -> None:
    check(changed(**{name: value}))


@pytest.mark.parametrize(("name", "value"), bounds(2))
def test_value_beyond_its_bound_is_refused(name: str, value: Any) -> None:
    """By a sentence that begins with field and value, or names both beside what they clash with."""
    with pytest.raises(ConfigError) as caught:
        check(changed(**{name: value}))
    message = str(caught.value)
    assert name in message
    assert str(value) in message
    assert "; " in message


def test_every_number_has_its_bounds_tested() -> None:
    tested = {name for row in BOUNDS for name in row[0].split()}
    numbers = {name for name, hint in HINTS.items() if hint not in (str, bool, tuple[str, ...])}
    literals = {name for name, hint in HINTS.items() if typing.get_origin(hint) is typing.Literal}
    assert numbers - literals - tested == {"payload_height"}


@pytest.mark.parametrize(
    ("values", "message"),
    [
        ({"target_period": 3.9}, "target_period is 3.9 s, but a board ramp .* 4 s; the period"),
        ({"board_rate": 1.0}, "target_period is 10.0 s, but .* 14 s; the period"),
        # From 5 deg on one side to 2 on the other, at 0.5 deg/s; jumps are of up to 2 deg.
        (
            {"max_incline": 2.0, "board_rate": 0.5, "target_period": 8.0, "start_incline": 5.0},
            "target_period is 8.0 s, but a board ramp .* from 5 deg to .* 14 s; the period",
        ),
        (
            {"step_rate": 0.6, "start_incline": 5.0},
            "step_rate is 0.6 deg/s; for a jump to end within target_period, .* at least 0.7$",
        ),
        ({"sea_angle": -2.0}, "sea_angle is -2.0; it must be at least 0"),
        ({"sea_angle": 8.0}, "sea_angle is 8.0 deg; it must not exceed max_incline, 7.0 deg"),
        (
            {"sea_angle": 4.0, "sea_period": 8.0},
            r"sea_angle is 4.0 deg; with sea_period 8.0 s .* exceed board_rate, 3.5 .* 3.51 deg",
        ),
        ({"sea_period": -8.0}, "sea_period is -8.0; it must be greater than 0"),
        ({"platform": True}, r"platform is True, but board_motions is \('ramps',\); .* name sea"),
        (
            {"platform": True, "board_motions": ("sea",), "sea_height": 2.0, "sea_period": 3.0},
            "sea_height is 2.0 m; with sea_period 3.0 s .* fall faster .* at most 1.19 m",
        ),
        ({"sea_height": -1.0}, "sea_height is -1.0; it must be at least 0"),
        ({"board_motions": ("waves",)}, r"board_motions is \('waves',\); .* ramps, steps, sea"),
        ({"ctrl_dt": 0.202}, "ctrl_dt is 0.202 s; .* whole multiple of sim_dt, 0.004 s"),
        ({"action_levels": 20}, "action_levels is 20; it must be odd"),
        ({"gyro_lags": (0, -1)}, r"gyro_lags is \(0, -1\); each entry must be at least 0"),
        ({"gamma": 1.5}, "^gamma is 1.5; it must be at most 1$"),
        ({"payload_height": 1e300}, "payload_height is 1e.300; it must be less than"),
        ({"reward_tilt": "middle"}, "reward_tilt is 'middle'; it must be one of end, mean"),
        ({"action": "both"}, "action is 'both'; it must be one of grid, continuous"),
        (
            {"action": "continuous", "head": "joint"},
            "action is 'continuous', but head is 'joint', .*; action must be 'grid', or head 'rad",
        ),
        ({"zero_at_rest": True}, "zero_at_rest is True, but head is 'joint', .*; head must be"),
        ({"head": "round"}, "head is 'round'; it must be one of joint, factored, radial"),
        ({"export": "first"}, "export is 'first'; it must be one of last, best"),
        ({"export": "best", "eval_every": 0}, "export is 'best', but eval_every is 0"),
        ({"preset": "papr"}, "'papr'; did you mean paper?"),
        (
            {"friction_min": 0.9, "friction_max": 0.8},
            "friction_max is 0.8; it must not be less than friction_min, 0.9",
        ),
        ({"push_min": 0.3}, "push_max is 0.0; it must not be less than push_min, 0.3"),
        ({"push_max": 0.2, "push_period": 0.1}, "push_period is 0.1 s; .* ctrl_dt, 0.2 s"),
        ({"min_replay_size": 200_000}, "min_replay_size is 200000; .* replay_capacity, 131072"),
        ({"num_envs": 262_144}, "replay_capacity is 131072; .* all num_envs = 262144 envs"),
        ({"seed": 2**31 - 5, "num_seeds": 6}, r"seed is .*; the last of all seeds .* 2\*\*31"),
        ({"num_envs": 48, "batch_size": 64, "replay_ratio": 2.0}, "replay_ratio is 2: .* 1.5 grad"),
    ],
)
def test_impossible_config_is_refused(values: dict[str, Any], message: str) -> None:
    """The message names the field, its value and what it clashes with."""
    with pytest.raises(ConfigError, match=message):
        check(changed(**values))


@pytest.mark.parametrize(
    "values",
    [
        {"friction_min": 0.9, "friction_max": 0.9},
        {"max_incline": 2.0, "board_rate": 0.5, "target_period": 14.0, "start_incline": 5.0},
        {"step_rate": 0.7, "start_incline": 5.0},
        {"push_min": 0.2, "push_max": 0.2, "push_period": 0.2},
        {"ctrl_dt": 0.4, "sim_dt": 0.4 / 10_000},
        {"min_replay_size": 64, "replay_capacity": 64},
    ],
)
def test_two_numbers_may_be_equal(values: dict[str, Any]) -> None:
    check(changed(**values))


@pytest.mark.parametrize("value", [None, 3, "paper", PRESETS, TaskConfig()], ids=repr)
def test_what_is_no_config_is_refused(value: Any) -> None:
    with pytest.raises(ConfigError, match=r"^config is .*; it must be a Config, as `preset`"):
        check(value)
    with pytest.raises(ConfigError, match=r"^task is .*; it must be a TaskConfig$"):
        check(dataclasses.replace(Config(), task=RandomizationConfig()))  # pyright: ignore


@pytest.mark.parametrize("field", dataclasses.fields(RandomizationConfig), ids=lambda x: x.name)
def test_places_and_times_of_what_is_not_there_vary_nothing(field: dataclasses.Field[Any]) -> None:
    """Each alone, at 0.1: another robot's, scaled to its size, differ from ours in these."""
    alone = dataclasses.replace(RandomizationConfig(), **{field.name: 0.1})
    idle = {"payload_offset", "payload_height", "push_min", "push_period", "ideal_share"}
    assert alone.varies == (field.name not in idle)


def test_flat_names_are_unique() -> None:
    """The command line and the tables have one flag and one row for each."""
    leaves = [x.name for kind in (*SECTIONS.values(), Config) for x in dataclasses.fields(kind)]
    assert len(leaves) == len(set(leaves))
    assert flatten(to_dict(preset("paper"))).keys() == set(leaves) - {*SECTIONS}
    assert flatten({"a": 1, "b": {"c": [2], "d": {"e": None}}}) == {"a": 1, "c": [2], "e": None}


def test_missing_fields_take_their_defaults() -> None:
    config = from_dict(Config, {"seed": 3, "task": {"gyro_lags": [1, 2]}})
    assert config == Config(seed=3, task=TaskConfig(gyro_lags=(1, 2)))


@pytest.mark.parametrize(
    ("values", "message"),
    [
        ({"sede": 1}, r"unknown field 'sede' in Config; did you mean seed\?"),
        ({"task": {"gravity": 9.8}}, "unknown field 'gravity' in TaskConfig; it has sim_dt, ctr"),
        ({"dqn": 3}, "dqn is 3; it must map its fields to values"),
        ([1], r"Config is \[1\]; it must map its fields to values"),
        ({"seed": 10**5000}, "a number of thousands of digits cannot be written as JSON"),
    ],
)
def test_values_that_are_no_config_are_refused(values: Any, message: str) -> None:
    with pytest.raises(ConfigError, match=message):
        from_dict(Config, values)


JSON = st.recursive(
    st.none() | st.booleans() | st.integers() | st.floats() | st.text(max_size=5),
    lambda x: st.lists(x, max_size=3) | st.dictionaries(st.text(max_size=5), x, max_size=3),
    max_leaves=6,
)


def complaint(values: Any) -> str | None:
    """What reading and checking values says against them; none if they are possible."""
    try:
        check(from_dict(Config, values))
    except ConfigError as error:
        return str(error)
    return None


@settings(deadline=None, max_examples=150)
@given(name=st.sampled_from(sorted(HINTS)), value=JSON)
@example(name="gyro_lags", value=3)
@example(name="hidden_sizes", value=[None])
@example(name="preset", value=[])
@example(name="robot", value="\ud800")
def test_a_field_of_any_shape_is_possible_or_refused_by_name(name: str, value: Any) -> None:
    """What a damaged file may hold in a field that exists: never another error."""
    message = complaint(as_json(name, value))
    assert message != ""
    assert message is not None or not isinstance(value, dict)


@settings(deadline=None, max_examples=100)
@given(garbage=JSON)
def test_garbage_is_refused(garbage: Any) -> None:
    message = complaint(garbage)
    assert message if garbage != {} else message is None


def wrong(hint: Any) -> list[Any]:
    """JSON values that are not of a field's type."""
    values: list[Any] = ["many", [1], {"a": 1}, True]
    if hint in (bool, str) or typing.get_origin(hint) is typing.Literal:
        values = [3, [1], {"a": 1}]
    if typing.get_origin(hint) is tuple:
        values = ["many", 3, {"a": 1}, [None], [[1]], ["x"], [True], [1.5]]
        values.remove(["x"] if hint == tuple[str, ...] else "many")
        if hint == tuple[float, ...]:
            values.remove([1.5])
    if hint in (int, int | None):
        values += [2.5]
    if type(None) not in typing.get_args(hint):
        values += [None]
    return values


@pytest.mark.parametrize(("name", "hint"), HINTS.items())
def test_a_value_of_another_type_is_refused_by_name(name: str, hint: Any) -> None:
    for value in wrong(hint):
        assert name in (complaint(as_json(name, value)) or ""), value
    if hint in (int, float, int | None, float | None):
        for value in (float("nan"), float("inf"), -float("inf")):
            with pytest.raises(ConfigError, match=f"{name} is "):
                check(changed(**{name: value}))


def test_another_config_is_refused_by_the_name_of_its_field(tmp_path: Path) -> None:
    check_same_config(preset("smoke"), preset("smoke"), tmp_path)
    with pytest.raises(RunFolderError, match=r"was started with gamma = 0.1, not 0.7"):
        check_same_config(preset("smoke"), changed(preset("smoke"), gamma=0.7), tmp_path)


SWEEP = ("gamma=0.1,0.4", "epsilon_decay_steps=10,2e3")


def test_a_sweep_is_every_combination_with_seeds_of_its_own() -> None:
    config = changed(preset("default"), seed=7, num_seeds=2, sweep=SWEEP)
    runs = expand_runs(check(config))
    assert [run.seed for run in runs] == list(range(7, 15))
    values = [(run.dqn.gamma, run.dqn.epsilon_decay_steps) for run in runs]
    assert values[::2] == values[1::2] == [(0.1, 10), (0.1, 2_000), (0.4, 10), (0.4, 2_000)]
    for run in runs:
        assert (run.num_seeds, run.sweep) == (1, ())
        assert check(run).dqn.learning_rate == config.dqn.learning_rate
    plain = changed(preset("default"), num_seeds=3)
    assert expand_runs(plain) == [changed(plain, num_seeds=1, seed=k) for k in range(3)]


@pytest.mark.parametrize(
    ("sweep", "message"),
    [
        (("batch_size=1,2",), "sweep is 'batch_size=1,2'; it must name one of learning_rate, "),
        (("gamma=0.1", "gamma=0.2"), "sweep is 'gamma=0.2'; it must name one of .*at most once"),
        (("gamma",), "sweep is 'gamma'; after gamma= it must list numbers, as 0.1,0.4"),
        (("gamma=0.1,",), "sweep is 'gamma=0.1,'; after gamma= it must list numbers"),
        (("gamma=0.1,1.5",), "gamma is 1.5; it must be at most 1"),
        (("epsilon_decay_steps=2.7,3",), "epsilon_decay_steps is 2.7; it must be a whole number"),
        (("epsilon_decay_steps=inf",), "epsilon_decay_steps is inf; it must be a whole number"),
        (("gamma=0.4",), "which is one run; give it more values, or set num_seeds to 2"),
        (("learning_rate=nan",), "learning_rate is nan; it must be a finite number"),
        ("gamma=1", "sweep is 'gamma=1'; it must be a list"),
    ],
)
def test_a_sweep_that_cannot_be_is_refused(sweep: Any, message: str) -> None:
    with pytest.raises(ConfigError, match=message):
        check(changed(preset("default"), sweep=sweep))


def test_the_last_seed_of_a_sweep_counts() -> None:
    config = changed(preset("default"), seed=2**31 - 4, num_seeds=2, sweep=SWEEP[:1])
    check(config)
    with pytest.raises(ConfigError, match="the last of all seeds must be less than"):
        check(changed(config, seed=config.seed + 1))


def test_names_of_fields_are_unique() -> None:
    """So that `Config.replace`, flags and `flatten` need no section."""
    names = [
        field.name for kind in (*SECTIONS.values(), Config) for field in dataclasses.fields(kind)
    ]
    assert len(set(names)) == len(names)


def test_a_field_is_replaced_by_its_name_alone() -> None:
    config = preset("best").replace(reward_toward=0.5, gamma=0.2, seed=7, hidden_sizes=[8, 4])
    expected = changed(preset("best"), reward_toward=0.5, gamma=0.2, seed=7, hidden_sizes=(8, 4))
    assert config == check(expected)
    assert preset("best").replace() == preset("best")
    both = preset("best").replace(task=TaskConfig(reward_fail=-3.0), reward_toward=0.7)
    assert both.task == TaskConfig(reward_fail=-3.0, reward_toward=0.7)
    assert both.dqn == preset("best").dqn


@pytest.mark.parametrize("value", [{"gamma": 1}, None, DQNConfig()])
def test_a_section_is_replaced_by_one_of_its_kind(value: Any) -> None:
    with pytest.raises(ConfigError, match=r"^task is .*; it must be a TaskConfig$"):
        preset("best").replace(task=value, gamma=0.5)


def test_a_whole_number_is_as_good_as_a_float() -> None:
    """Else arrays made from it hold whole numbers, and a policy's manifest differs."""
    whole = TaskConfig(fail_tilt=8, sea_angle=3, mean_times=(1, 2), episode_length=100)
    assert repr(whole) == repr(
        TaskConfig(fail_tilt=8.0, sea_angle=3.0, mean_times=(1.0, 2.0), episode_length=100)
    )
    config = preset("best").replace(task=whole, payload=5, huber_delta=1, eval_duration=60, seed=3)
    values = config.task, config.randomization.payload, config.dqn.huber_delta, config.eval_duration
    assert repr(values) == f"({whole}, 5.0, 1.0, 60.0)"
    assert repr(check(config).seed) == "3"
    assert repr(dataclasses.replace(config.task, board_rate=3).board_rate) == "3.0"


@pytest.mark.parametrize(
    ("name", "sentence"),
    [
        ("reward_towards", "unknown field 'reward_towards'; did you mean reward_toward?"),
        ("push_maximum", "unknown field 'push_maximum'; did you mean push_max?"),
        ("learning_rat", "did you mean learning_rate?"),
        ("nume_envs", "did you mean num_envs?"),
    ],
)
def test_a_field_that_does_not_exist_is_not_replaced(name: str, sentence: str) -> None:
    with pytest.raises(ConfigError, match=re.escape(sentence)):
        preset("paper").replace(**{name: 1, "gamma": 0.5})
