"""Suites are what they say, and their scenarios depend on nothing but the seed."""

import dataclasses
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from mjx_balance.config import Config, ConfigError, RandomizationConfig, preset
from mjx_balance.envs.balance import BalanceEnv
from mjx_balance.envs.batch import BatchEnv, Episodes, rows
from mjx_balance.evaluation.controllers import View, make_controller
from mjx_balance.evaluation.rollout import roll_out, run_suite, suite_scene
from mjx_balance.evaluation.suites import (
    SEEDS,
    SUITES,
    Suite,
    SuiteError,
    draw_suite,
    find_suite,
    standing_still,
)
from mjx_balance.robots.catalogue import Robot, find_robot
from mjx_balance.robots.limits import authority, for_robot, greatest_incline
from mjx_balance.sim.scene import Scene, load_scene
from mjx_balance.task.randomization import DRAWS, draw_params
from mjx_balance.task.sensors import draw_errors
from mjx_balance.task.tilt import MOTIONS, board_angle, numpy_uniform, platform_position


def with_task(config: Config, **values: float) -> Config:
    return dataclasses.replace(config, task=dataclasses.replace(config.task, **values))


def draw(config: Config, suite: str | Suite, *rest: Any) -> Episodes:
    """In a scene that fits the suite."""
    task = dataclasses.replace(config.task, platform=suite == "platform")
    return draw_suite(task, find_robot(config.robot), suite, *rest)


def draws(seed: int, k: int, targets: int = 7) -> tuple[np.ndarray, np.ndarray]:
    """Scenario k's own random numbers: two for every target, then those of its circumstances."""
    rng = np.random.default_rng((seed, k))
    return rng.uniform(size=(targets, 2)), rng.uniform(size=DRAWS + 2)


def test_scenarios_depend_on_the_seed_and_not_on_their_number(config: Config) -> None:
    for suite in SUITES:
        few, many = (draw(config, suite, n, 60, 3) for n in (2, 5))
        many = Episodes(*(rows(part, np.arange(2)) for part in many[:3]))
        jax.tree.map(np.testing.assert_array_equal, few[:3], many[:3])
    seeds = [draw(config, "paper", 5, 60, n).scenario.targets for n in range(4)]
    assert len(np.unique(np.concatenate(seeds)[:, 0], axis=0)) == 20, "no two are alike"


def test_every_target_of_paper_and_corner_by_its_draw(config: Config) -> None:
    """60 s need 7 targets. Published figures hold for these scenarios and no others."""
    paper, corner = (draw(config, name, 3, 60.0, 5).scenario for name in ("paper", "corner"))
    assert paper.targets.shape == corner.targets.shape == (3, 7, 2)
    for k in range(3):
        uniform, _ = draws(5, k)
        turn, size = 2 * np.pi * uniform[:, 0], 7 * uniform[:, 1]
        expected = np.stack((size * np.cos(turn), size * np.sin(turn)), axis=-1)
        np.testing.assert_allclose(paper.targets[k], expected, atol=1e-12)
        np.testing.assert_array_equal(corner.targets[k], np.where(uniform < 0.5, -7, 7))
    for scenario in (paper, corner):
        np.testing.assert_array_equal(scenario.phase, np.zeros(3))
        np.testing.assert_array_equal(scenario.rate, np.full(3, 3.5))


def test_circumstances_by_their_draws(config: Config) -> None:
    """Draw 0 is the payload, 1 and 2 its place, 3 the friction, 4 the gain."""
    names = ("payload", "friction", "gains")
    payload, friction, gains = (draw(config, name, 4, 60.0, 2).params for name in names)
    others = np.asarray([draws(2, k)[1] for k in range(4)])
    np.testing.assert_allclose(payload.payload, 5 * others[:, 0])
    np.testing.assert_allclose(payload.payload_at[:, 0], 0.1 * others[:, 1] - 0.05)
    np.testing.assert_allclose(payload.payload_at[:, 1], 0.1 * others[:, 2] - 0.05)
    np.testing.assert_allclose(friction.friction[:, 3], 0.4 + 0.6 * others[:, 3])
    np.testing.assert_allclose(gains.gain[:, 3, 2], 0.8 + 0.4 * others[:, 4])
    noise = draw(config, "noise", 2, 60.0, 2).rngs
    own = [np.random.default_rng((2, k, 1)).normal() for k in range(2)]
    assert [rng.normal() for rng in noise] == own, "from generators of their own"


def test_soft_servos_and_delayed_actions_come_independently(config: Config) -> None:
    """Of each kind half: a quarter has both. The delays are those of a suite without softness."""
    late = RandomizationConfig(latency_share=0.5)
    suites = Suite(late), Suite(dataclasses.replace(late, soft_share=0.5))
    alone, both = (draw(config, suite, 400, 1.0, 0).params for suite in suites)
    np.testing.assert_array_equal(both.delay, alone.delay)
    kinds = 2 * (both.delay > 0) + (both.softness > 0)
    counts = np.bincount(kinds, minlength=4)
    assert counts.min() > 75
    assert counts.max() < 125
    own = np.random.default_rng((0, 7, 7)).uniform()
    assert both.softness[7] == (2 * own if own < 0.5 else 0)


def test_fast_and_steep_by_their_draws(config: Config, robot: Robot) -> None:
    """The targets of `paper`, at up to 4.453 deg/s or stretched up to the legs' reach."""
    paper, fast, steep = (
        draw(config, name, 4, 60.0, 2).scenario for name in ("paper", "fast", "steep")
    )
    others = np.asarray([draws(2, k)[1] for k in range(4)])
    np.testing.assert_allclose(fast.rate, 3.5 + (4.4531 - 3.5) * others[:, DRAWS], atol=1e-4)
    np.testing.assert_array_equal(fast.targets, paper.targets)
    reach = greatest_incline(config.task, robot)
    stretch = (7 + (reach - 7) * others[:, DRAWS + 1]) / 7
    np.testing.assert_allclose(steep.targets, paper.targets * stretch[:, None, None])
    np.testing.assert_array_equal(steep.rate, paper.rate)


def test_pushes_by_their_draws(config: Config) -> None:
    """Pushes of 0.2 to 0.4 m/s every 5 s; a scenario's come from a generator of their own."""
    pushes = draw(config, "push", 3, 60.0, 5).pushes
    assert pushes.due[2].tolist() == [25, 50, 75, 100, 125, 150, 175, 200, 225, 250, 275]
    for k in range(3):
        speed, turn = np.random.default_rng((5, k, 2)).uniform(size=(11, 2)).T
        speed, turn = 0.2 + 0.2 * speed, 2 * np.pi * turn
        expected = np.stack((speed * np.cos(turn), speed * np.sin(turn)), axis=-1)
        np.testing.assert_allclose(pushes.velocity[k], expected, atol=1e-12)
    fewer = draw(config, "push", 2, 60.0, 5).pushes
    shorter = draw(config, "push", 3, 26, 5).pushes
    np.testing.assert_array_equal(fewer.velocity, pushes.velocity[:2])
    np.testing.assert_array_equal(shorter.velocity, pushes.velocity[:, :5])


def test_pushes_happen_in_the_scenarios_of_paper_and_in_no_other_suite(config: Config) -> None:
    push, paper = (draw(config, name, 4, 60.0, 2) for name in ("push", "paper"))
    for ours, theirs in zip(push.scenario, paper.scenario, strict=True):
        np.testing.assert_array_equal(ours, theirs)
    for values in (push.params.payload, push.params.imu_noise, push.params.delay):
        assert not values.any()
    for name in SUITES:
        pushes = draw(config, name, 4, 60.0, 2).pushes
        assert (pushes is not None) == (name == "push")


def test_a_config_beyond_the_limits_is_left_as_it_is(config: Config) -> None:
    """A board that is faster or steeper than can be followed is neither slower nor flatter."""
    quick = with_task(config, board_rate=6.0)
    assert draw(quick, "fast", 3, 20, 0).scenario.rate.tolist() == [6.0] * 3
    high = with_task(config, max_incline=12.0)
    steep, paper = (draw(high, name, 3, 20, 0).scenario.targets for name in ("steep", "paper"))
    np.testing.assert_array_equal(steep, paper)


@pytest.mark.parametrize(("duration", "targets"), [(5.0, 2), (10.0, 2), (10.1, 3), (60.0, 7)])
def test_there_are_targets_to_the_end(config: Config, duration: float, targets: int) -> None:
    assert draw(config, "paper", 2, duration, 0).scenario.targets.shape == (2, targets, 2)


def test_a_board_that_does_not_arrive_is_refused(config: Config) -> None:
    """14 deg at 3.5 deg/s take 4 s; in `steep` they may be 2 * 10.3 deg."""
    just = with_task(config, target_period=4.0)
    for suite in ("paper", "corner", "fast"):
        draw(just, suite, 5, 20, 0)
    with pytest.raises(SuiteError, match=r"period is 4\.0 s, but in suite 'steep' .* [45]\.\d"):
        draw(just, "steep", 50, 20, 0)
    with pytest.raises(SuiteError, match=r"period is 3\.99 s, but in suite 'corner' .* 4\.0"):
        draw(with_task(config, target_period=3.99), "corner", 1, 20, 0)


def test_a_board_does_not_arrive_from_a_start_that_is_steeper_than_its_targets(
    config: Config,
) -> None:
    """It starts at up to 6 - 0.14 deg and goes to 2 deg on the other side, at 0.5 deg/s: 15.7 s."""
    slow = {"max_incline": 2.0, "board_rate": 0.5}
    with pytest.raises(SuiteError, match=r"period is 15\.6 s, but in suite 'recover' .* 15\.7 s"):
        draw(with_task(config, target_period=15.6, **slow), "recover", 1, 20, 0)
    draw(with_task(config, target_period=15.8, **slow), "recover", 1, 20, 0)
    draw(with_task(config, target_period=8.0, **slow), "paper", 1, 20, 0)


def test_steps_and_sea_have_generators_of_their_own(config: Config) -> None:
    """So that no draw of another suite changes; a heading of the config holds for all scenarios."""
    for suite in ("steps", "sea"):
        own = np.random.default_rng((4, 1, 3))
        expected = MOTIONS[suite](config.task, 7, numpy_uniform(own))
        got = rows(draw(config, suite, 2, 60.0, 4).scenario, np.asarray([1]))
        jax.tree.map(lambda x, y: np.testing.assert_array_equal(x[0], y), got, expected)
    waves = draw(with_task(config, sea_heading=90.0), "sea", 200, 60.0, 0).scenario.waves
    assert waves is not None
    about_x, about_y = waves.amplitude.mean(axis=(0, 1))
    assert about_x > 0.8 * 4.38 / 8, "waves that run to the left roll the deck"
    assert abs(about_y) < 0.05


def test_a_sea_out_of_bounds_is_refused(config: Config) -> None:
    with pytest.raises(ConfigError, match=r"sea_angle is 9.0 deg; it must not exceed max_incline"):
        draw(with_task(config, sea_angle=9.0), "sea", 1, 10, 0)


@pytest.mark.parametrize(("suite", "most"), [("steps", 0.3), ("sea", 0.06)])
def test_the_board_goes_where_the_suite_says(config: Config, suite: str, most: float) -> None:
    """Its servo is 10 ms late: 0.2 deg at 20 deg/s, 0.035 deg at 3.5; and swings a little."""
    scene = load_scene(config)
    episodes = draw(config, suite, 2, 16.0, 1)
    rollout = roll_out(scene, make_controller("pd-imu", scene), episodes, 16.0, record=True)
    assert rollout.qpos is not None
    assert not rollout.fell.any()
    time = np.tile(scene.task.sim_dt * np.arange(1, 4001), (2, 1))
    error = np.degrees(rollout.qpos[..., scene.board_qpos]) - board_angle(
        scene.task, episodes.scenario, time
    )
    assert np.abs(board_angle(scene.task, episodes.scenario, time)).max() > 1
    assert np.abs(error).max() < most


def test_a_platform_has_the_sea_of_suite_sea(config: Config) -> None:
    """With surge, sway and heave beside it; `sea` moves no platform, though the scene has one."""
    sea, platform = (draw(config, name, 3, 60.0, 1).scenario.waves for name in ("sea", "platform"))
    assert sea is not None
    assert platform is not None
    np.testing.assert_array_equal(platform.amplitude[..., :2], sea.amplitude)
    np.testing.assert_array_equal(platform.omega, sea.omega)
    np.testing.assert_allclose(platform.amplitude[..., 4], 1 / 8)
    task = dataclasses.replace(config.task, platform=True)
    still = draw_suite(task, find_robot(config.robot), "sea", 3, 60.0, 1).scenario.waves
    assert still is not None
    assert not still.amplitude[..., 2:].any()
    with pytest.raises(SuiteError, match="'platform' moves a platform, which the scene does not"):
        draw_suite(config.task, find_robot(config.robot), "platform", 1, 60.0, 1)
    low = with_task(config, sea_period=1.0)
    with pytest.raises(ConfigError, match=r"sea_height is 1.0 m; with sea_period 1.0 s"):
        draw(low, "platform", 1, 60.0, 1)


def test_a_standing_robot_feels_the_platforms_acceleration(config: Config) -> None:
    """Where the deck does not tilt: the servos are 10 ms late, and the legs yield by a little."""
    scene = suite_scene(load_scene(config), "platform")
    scene = dataclasses.replace(scene, task=dataclasses.replace(scene.task, sea_angle=0.0))
    episodes = draw_suite(scene.task, scene.robot, "platform", 2, 20.0, 1)
    stand, felt = make_controller("none", scene), []

    def watch(view: View) -> np.ndarray:
        felt.append(view.imu[..., 3:])
        return stand(view)

    rollout = roll_out(scene, watch, episodes, 20.0, record=True)
    assert rollout.qpos is not None
    time = np.tile(0.004 * np.arange(1, 5001), (2, 1))
    commanded = platform_position(scene.task, episodes.scenario, time)
    at = rollout.qpos[..., scene.platform_qpos]
    np.testing.assert_allclose(at, commanded, atol=0.004)
    assert np.ptp(at, axis=1).min() > 0.1
    assert rollout.tilt.max() < 0.1
    acceleration = np.diff(commanded, 2, axis=1) / 0.004**2
    imu = np.concatenate(felt[1:], axis=1)[:, 2500:] - (0, 0, 9.81)
    expected = acceleration[:, 2495 : 2495 + imu.shape[1]]
    assert expected.std(axis=1).min() > 0.05
    np.testing.assert_allclose(imu, expected, atol=0.03)


def test_baselines_run_on_a_platform(config: Config) -> None:
    """Built in the scene without one, where the trunk has other addresses in qpos."""
    scene = load_scene(config)
    for name in ("pd-attitude", "rate-oracle"):
        rollout = run_suite(scene, make_controller(name, scene), "platform", 2, 8.0, 0)
        assert not rollout.fell.any()
        assert rollout.tilt.mean() < 0.1


def test_soft_is_the_scene_of_our_soft_robot(config: Config) -> None:
    soft = suite_scene(load_scene(config), "soft")
    expected = load_scene(dataclasses.replace(config, robot="quadruped_soft"))
    assert soft.hash == expected.hash
    np.testing.assert_allclose(soft.stance.leg_trim, expected.stance.leg_trim, atol=1e-9)
    again = suite_scene(soft, "soft")
    assert again.hash == soft.hash, "soft servos stay as they are"


def test_a_suite_may_have_a_platform_and_soft_servos(config: Config, scene: Scene) -> None:
    both = suite_scene(scene, Suite(motion="sea", platform=True, soft=True))
    expected = load_scene(config.replace(robot="quadruped_soft", platform=True))
    assert both.hash == expected.hash
    assert both.hash not in (suite_scene(scene, "soft").hash, suite_scene(scene, "platform").hash)


def test_soft_goes_with_weight_and_leg() -> None:
    """B2 has 5.493 times our weight and 0.7 / 0.426 times our leg; its 10 N m s / rad is softer."""
    scene = load_scene(for_robot(preset("default"), "b2"))
    model = suite_scene(scene, "soft").model
    stiffness = 60 * 5.493 * 0.7 / 0.426
    gains = model.actuator_gainprm[scene.leg_ctrl, 0]
    np.testing.assert_allclose(gains, stiffness, rtol=1e-3)
    np.testing.assert_array_equal(model.actuator_biasprm[scene.leg_ctrl, 1], -gains)
    joints = model.actuator_trnid[scene.leg_ctrl, 0]
    np.testing.assert_array_equal(model.dof_damping[model.jnt_dofadr[joints]], 10.0)


def test_impossible_wishes_are_refused(config: Config) -> None:
    with pytest.raises(SuiteError, match="seed is -1; it must not be negative"):
        draw(config, "paper", 1, 10, -1)
    names = (
        "paper, corner, noise, payload, friction, gains, soft, latency, push, fast, steep, "
        "recover, steps, sea, platform, bias, encoder, delay, dropout, shift, slip, weak"
    )
    with pytest.raises(SuiteError, match=f"unknown suite 'moon'; known suites: {names}"):
        draw(config, "moon", 1, 10, 0)


@pytest.mark.parametrize(
    ("values", "sentence"),
    [
        ({"push_min": 0.3}, "^push_max is 0.0; it must not be less than push_min, 0.3$"),
        ({"push_max": 0.3, "push_period": 0.1}, "^push_period is 0.1 s; .* ctrl_dt, 0.2 s$"),
        ({"friction_min": 0.5, "friction_max": 0.4}, "^friction_max is 0.4; .* friction_min, 0.5$"),
        ({"friction_min": 7.0}, "^friction_min is 7.0; .* robot quadruped, 0.[0-9]*, unless"),
        ({"friction_max": 0.1}, "^friction_max is 0.1; .* robot quadruped, 0.[0-9]*, unless"),
    ],
)
def test_a_suite_whose_ranges_contradict_is_refused(
    config: Config, values: dict[str, float], sentence: str
) -> None:
    """Else it would run without its pushes, or the other way round."""
    with pytest.raises(ConfigError, match=sentence):
        draw(config, Suite(RandomizationConfig(**values)), 1, 10.0, 0)


@pytest.mark.parametrize("motion", [None, "steps"])
def test_a_platform_without_a_sea_is_refused(scene: Scene, motion: str | None) -> None:
    with pytest.raises(SuiteError, match=r"^platform of suite own is True, but .* must be 'sea'$"):
        suite_scene(scene, Suite(motion=motion, platform=True))


def test_a_tilted_start_of_a_board_that_is_on_its_way_is_refused() -> None:
    with pytest.raises(SuiteError, match=r"^tilted of suite own is True, but .* None or 'sea'$"):
        find_suite(Suite(motion="steps", tilted=True))


def test_no_seed_serves_two_purposes() -> None:
    """What a policy is chosen or tuned by must not be what it is judged by."""
    seeds = dataclasses.astuple(SEEDS)
    assert len(set(seeds)) == len(seeds) == 6


def test_authority_and_reach_by_hand(config: Config, robot: Robot) -> None:
    """15 mm/s over 193 mm, and 61 mm of leg over 335 mm."""
    assert authority(config.task, robot) == pytest.approx(np.degrees(0.015 / 0.193))
    double = with_task(config, action_max=0.006)
    assert authority(double.task, robot) == pytest.approx(np.degrees(0.030 / 0.193))
    slow = with_task(config, ctrl_dt=0.4)
    assert authority(slow.task, robot) == pytest.approx(np.degrees(0.0075 / 0.193))
    reach = greatest_incline(config.task, robot)
    assert reach == pytest.approx(np.degrees(np.arctan(0.061 / 0.335)), abs=0.2)


@pytest.mark.parametrize(
    ("suite", "field", "least", "most"),
    [
        ("payload", "payload", 0.0, 5.0),
        ("friction", "friction", 0.4, 1.0),
        ("gains", "gain", 0.8, 1.2),
        ("latency", "delay", 1.0, 1.0),
        ("noise", "imu_noise", 0.002, 0.023),
    ],
)
def test_conditions_fill_their_range(
    config: Config, suite: str, field: str, least: float, most: float
) -> None:
    params = draw(config, suite, 300, 10, 0).params
    values = getattr(params, field)
    margin = 0.03 * (most - least)
    assert least <= values.min() <= least + margin
    assert most - margin <= values.max() <= most
    nominal = draw_params(RandomizationConfig(), find_robot("quadruped"), np.zeros((300, DRAWS)))
    for name in params._fields:
        if name not in (field, "payload_at"):
            np.testing.assert_array_equal(getattr(params, name), getattr(nominal, name))


@pytest.mark.parametrize(
    ("suite", "most"),
    [
        ("bias", {"bias": np.radians(0.5), "mounting": np.radians(0.5)}),
        ("encoder", {"encoders": 0.02, "readings": 0.02}),
        ("delay", {"delay": 0.03, "jitter": 0.01}),
        ("dropout", {"dropout": 0.1}),
    ],
)
def test_sensor_errors_fill_their_range(config: Config, suite: str, most: dict[str, float]) -> None:
    """By a generator of each scenario's own; targets and noise are those of `paper`."""
    episodes, paper = (draw(config, name, 200, 10, 0) for name in (suite, "paper"))
    np.testing.assert_array_equal(episodes.scenario.targets, paper.scenario.targets)
    errors = episodes.errors
    for name, values in errors._asdict().items():
        if name not in most:
            assert (suite == "bias" and name == "drift") or not values.any(), name
    for name, limit in most.items():
        values = getattr(errors, name)
        if name == "bias":  # of the gyro; the accelerometer has 0.05 m/s^2
            assert 0.97 * 0.05 < np.abs(values[:, 3:]).max() <= 0.05
            values = values[:, :3]
        assert 0.97 * limit < np.abs(values).max() <= limit * (1 + 1e-9)
    drawn = draw_errors(
        SUITES[suite].randomization,
        find_robot("quadruped"),
        np.random.default_rng((0, 7, 5)).uniform(size=41),
    )
    for ours, theirs in zip(rows(errors, np.asarray(7)), drawn, strict=True):
        np.testing.assert_array_equal(ours, theirs)
    assert paper.errors is None


def test_a_controller_sees_what_the_sensors_give(config: Config, scene: Scene) -> None:
    """From the first samples on; the truth about tilt and joints stays true."""
    episodes, seen = draw(config, "bias", 3, 0.4, 0), []

    def watch(view: View) -> np.ndarray:
        seen.append(view.imu)
        return np.zeros((3, 2))

    roll_out(scene, watch, episodes, 0.4)
    errors = episodes.errors
    assert errors is not None
    # Gravity is along z, and so a small turn about y shows in x.
    shown = errors.bias[:, 3] - 9.81 * errors.mounting[:, 1]
    np.testing.assert_allclose(seen[0][:, 0, 3] - scene.stance.imu[3], shown, atol=2e-3)
    np.testing.assert_allclose(seen[0][:, -1, :3], errors.bias[:, :3], atol=1e-4)
    assert not np.allclose(seen[1], seen[0])


def test_a_suite_whose_delays_are_longer_than_a_decision_is_refused(config: Config) -> None:
    with pytest.raises(ConfigError, match=r"^sensor_delay is 0.03 s .* at most 0.02$"):
        draw(with_task(config, ctrl_dt=0.02), "delay", 1, 1.0, 0)


def test_every_suite_follows_the_configs_incline(config: Config) -> None:
    flat = with_task(config, max_incline=2.0)
    for name, suite in SUITES.items():
        if not suite.steep:
            assert np.abs(draw(flat, name, 20, 60, 0).scenario.targets).max() <= 2.0


def test_loads_and_pushes_go_with_the_robot() -> None:
    """B2 is 5.493 times as heavy as ours, 1.702 times as long, and bears 1.057 times the push."""
    config = for_robot(preset("default"), "b2")
    conditions = draw(config, "payload", 200, 1.0, 0).params
    assert conditions.payload.max() == pytest.approx(5 * 5.493, rel=0.03)
    assert np.abs(conditions.payload_at[:, :2]).max() == pytest.approx(0.05 * 1.702, rel=0.03)
    speeds = np.linalg.norm(draw(config, "push", 100, 60.0, 0).pushes.velocity, axis=-1)
    limits = (speeds.min(), speeds.max())
    assert limits == pytest.approx((0.2 * 1.057, 0.4 * 1.057), rel=0.01)


def test_robots_recover_from_a_start_on_a_tilted_board(config: Config) -> None:
    """Up to what the board turns in a decision from a fall; whoever stands still is no better."""
    scenario = draw(config, "recover", 200, 20.0, 5).scenario
    assert scenario.start is not None
    assert 4.8 < np.hypot(*scenario.start.T).max() <= 6 - np.hypot(0.7, 0.7)
    np.testing.assert_array_equal(
        scenario.targets, draw(config, "paper", 200, 20.0, 5).scenario.targets
    )
    scene = load_scene(config)
    rollouts = {
        name: run_suite(scene, make_controller(name, scene), "recover", 16, 4.0, 5)
        for name in ("none", "pd-imu")
    }
    size = np.hypot(*draw(config, "recover", 16, 4.0, 5).scenario.start.T)
    for rollout in rollouts.values():
        np.testing.assert_allclose(rollout.tilt[:, 0], size, atol=0.1)
    assert not rollouts["pd-imu"].fell.any()
    assert rollouts["pd-imu"].tilt[:, -50:].mean() < 0.3 < 2 < size.mean()


def test_training_starts_tilted_as_evaluation_does(config: Config) -> None:
    """The same start in MJX's env and in plain MuJoCo: observation, tilt before, first decision."""
    config = dataclasses.replace(with_task(config, start_incline=5.0), engine="mujoco")
    env = BalanceEnv(config)
    state = jax.jit(jax.vmap(env.reset))(jax.random.split(jax.random.PRNGKey(0), 4))
    scenario = jax.tree.map(np.asarray, state.pipeline_state.scenario)
    batch = BatchEnv(load_scene(config), Episodes(scenario, rngs=[np.random.default_rng(0)] * 4))
    np.testing.assert_allclose(np.asarray(state.obs), batch.initial_obs, atol=2e-4)
    before = batch.state.memory.tilt
    np.testing.assert_allclose(before, np.hypot(*scenario.start.T), atol=0.02)  # of the stance
    np.testing.assert_allclose(state.pipeline_state.memory.tilt, before, rtol=1e-4)
    after = jax.jit(jax.vmap(env.step))(state, jnp.full(4, 220))
    outcome = batch.step(np.zeros((4, 2)))
    np.testing.assert_allclose(after.metrics["tilt_deg"], outcome.tilt.mean(axis=1), rtol=1e-3)
    np.testing.assert_allclose(after.reward, outcome.reward, atol=1e-3)
    again = Episodes(jax.tree.map(lambda x: x[:1], scenario), rngs=[np.random.default_rng(0)])
    batch.reset(np.asarray([2]), again)
    np.testing.assert_array_equal(batch.initial_obs[2], batch.initial_obs[0])


def test_an_episode_begun_anew_is_as_noisy_as_its_generator(config: Config) -> None:
    """Env 1 of 3 after a reset equals the first env of another batch, sample by sample."""
    scene = load_scene(config)
    first, second = (draw(config, "noise", 3, 10.0, seed) for seed in (5, 6))
    batch, other = BatchEnv(scene, first), BatchEnv(scene, second)
    one = Episodes(*(rows(part, np.arange(1)) for part in second[:3]), rngs=[second.rngs[0]])
    batch.step(np.zeros((3, 2)))
    imu = other.step(np.zeros((3, 2))).imu[0]
    (again,) = draw(config, "noise", 1, 10.0, 6).rngs
    batch.reset(np.asarray([1]), one._replace(rngs=[again]))
    np.testing.assert_array_equal(batch.step(np.zeros((3, 2))).imu[1], imu)


def test_a_robot_that_stands_still_tilts_as_the_board_does(config: Config, scene: Scene) -> None:
    """The closed form is that of a simulation, falls included."""
    size = (6, 20.0, 5)
    for suite, precision in (("paper", 0.15), ("corner", 0.01)):
        simulated = run_suite(scene, make_controller("none", scene), suite, *size)
        still = standing_still(scene.task, scene.robot, suite, *size)
        assert still == pytest.approx(simulated.tilt.mean(), abs=precision)
        assert simulated.fell.any() or suite == "paper"
