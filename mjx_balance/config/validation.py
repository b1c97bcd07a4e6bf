"""Checks of a config that do not depend on the robot."""

from mjx_balance.config.presets import preset
from mjx_balance.config.schema import Config, ConfigError, RandomizationConfig, TaskConfig
from mjx_balance.config.sea import check_platform, significant_angle
from mjx_balance.config.sweep import sweep_grid, with_values
from mjx_balance.errors import quote
from mjx_balance.files.validation import check_types

MOST_STEPS = 10_000  #: greatest number of physics steps per decision
MOST_READ = 1_000_000  #: greatest number of IMU samples that an observation averages


def check(config: Config) -> Config:
    """Returns `config` if it is valid; `robots.limits.check_robot` checks it against its robot.

    Raises:
      ConfigError: names the first invalid field, its value and a remedy.
    """
    if not isinstance(config, Config):
        raise ConfigError(
            f"config is {quote(config)}; it must be a Config, as `preset` and `for_robot` return"
        )
    check_types(config, ConfigError)
    preset(config.preset)
    _check_runs(config)
    _check_timing(config.task)
    _check_motions(config.task)
    _check_inputs(config.task)
    _check_learning(config)
    check_randomization(config.randomization, config.task)
    if config.export == "best" and not config.eval_every:
        raise ConfigError(
            "export is 'best', but eval_every is 0, so that nothing is validated to choose from; "
            "eval_every must be at least 1, or export last"
        )
    return config


def _check_runs(config: Config) -> None:
    grid = sweep_grid(config)
    for values in grid:
        check_types(with_values(config.dqn, values), ConfigError)
    runs = len(grid) * config.num_seeds
    if config.sweep and runs == 1:
        raise ConfigError(
            f"sweep is {quote(config.sweep)}, which is one run; give it more values, or set "
            "num_seeds to 2 or more"
        )
    if config.seed + runs > 2**31:
        raise ConfigError(f"seed is {config.seed}; the last of all seeds must be less than 2**31")


def _check_timing(task: TaskConfig) -> None:
    steps = task.ctrl_dt / task.sim_dt
    if not 0.5 < steps < MOST_STEPS + 0.5 or abs(steps - round(steps)) > 1e-6:
        raise ConfigError(
            f"ctrl_dt is {task.ctrl_dt} s; it must be a whole multiple of sim_dt, {task.sim_dt} s, "
            f"at most {MOST_STEPS} times as long"
        )
    if task.action_levels % 2 == 0:
        raise ConfigError(
            f"action_levels is {task.action_levels}; it must be odd, so that standing still is an "
            "action"
        )
    steepest = max(task.max_incline, task.start_incline)
    ramp = (steepest + task.max_incline) / task.board_rate
    if ramp > task.target_period:
        raise ConfigError(
            f"target_period is {task.target_period} s, but a board ramp at board_rate, from "
            f"{steepest:g} deg to max_incline on the other side, may last {ramp:g} s; the period "
            "must not be shorter"
        )


def _check_motions(task: TaskConfig) -> None:
    if len(set(task.board_motions)) < len(task.board_motions):
        raise ConfigError(
            f"board_motions is {task.board_motions}; it must name each kind at most once"
        )
    jump = task.jump_incline
    slowest = (max(jump, task.start_incline) + jump) / task.target_period
    if task.step_rate < slowest:
        raise ConfigError(
            f"step_rate is {task.step_rate} deg/s; for a jump to end within target_period, "
            f"{task.target_period} s, it must be at least {slowest:.3g}"
        )
    if task.start_incline >= task.fail_tilt:
        raise ConfigError(
            f"start_incline is {task.start_incline} deg; it must be less than fail_tilt, "
            f"{task.fail_tilt} deg: a robot that starts with it has fallen"
        )
    significant_angle(task)
    if task.platform and "sea" not in task.board_motions:
        raise ConfigError(
            f"platform is True, but board_motions is {task.board_motions}; a platform moves with "
            "the sea alone: name sea there"
        )
    if task.platform:
        check_platform(task)


def _check_inputs(task: TaskConfig) -> None:
    samples = 2 * (len(task.gyro_lags) + len(task.accel_lags)) * task.imu_mean
    if samples > MOST_READ:
        raise ConfigError(
            f"imu_mean is {task.imu_mean}; with {len(task.gyro_lags)} gyro_lags and "
            f"{len(task.accel_lags)} accel_lags an observation averages {samples:,} samples; it "
            f"must be at most {MOST_READ:,}"
        )


def _check_learning(config: Config) -> None:
    dqn, num_envs = config.dqn, config.num_envs
    if config.task.action == "continuous" and dqn.head != "radial":
        raise ConfigError(
            f"action is 'continuous', but head is {quote(dqn.head)}, which has values of the "
            "grid's actions only; action must be 'grid', or head 'radial'"
        )
    if dqn.zero_at_rest and dqn.head != "radial":
        raise ConfigError(
            f"zero_at_rest is True, but head is {quote(dqn.head)}, which has no best point to hold "
            "at 0; head must be 'radial'"
        )
    if dqn.min_replay_size > dqn.replay_capacity:
        raise ConfigError(
            f"min_replay_size is {dqn.min_replay_size}; it must not exceed replay_capacity, "
            f"{dqn.replay_capacity}"
        )
    if num_envs is None:
        return
    if dqn.replay_capacity < num_envs:
        raise ConfigError(
            f"replay_capacity is {dqn.replay_capacity}; it must hold at least one decision of "
            f"all num_envs = {num_envs} envs"
        )
    updates = dqn.replay_ratio * num_envs / dqn.batch_size
    if not 0.5 < updates < 2**31 or abs(updates - round(updates)) > 1e-6:
        raise ConfigError(
            f"replay_ratio is {dqn.replay_ratio:g}: with num_envs {num_envs} and batch_size "
            f"{dqn.batch_size} that makes {updates:g} gradient steps after each decision of "
            "all envs; it must be a whole number of them"
        )


def check_randomization(ranges: RandomizationConfig, task: TaskConfig) -> None:
    """Raises `ConfigError` if ranges contradict each other or the length of a decision."""
    least, most = ranges.friction_min, ranges.friction_max
    if least is not None and most is not None and most < least:
        raise ConfigError(f"friction_max is {most}; it must not be less than friction_min, {least}")
    if ranges.push_max < ranges.push_min:
        raise ConfigError(
            f"push_max is {ranges.push_max}; it must not be less than push_min, {ranges.push_min}"
        )
    if ranges.push_max and ranges.push_period < task.ctrl_dt:
        raise ConfigError(
            f"push_period is {ranges.push_period} s; it must not be shorter than ctrl_dt, "
            f"{task.ctrl_dt} s"
        )
