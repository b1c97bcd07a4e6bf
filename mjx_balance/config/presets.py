"""Named configs to start from."""

import dataclasses
from collections.abc import Mapping

from mjx_balance.config.schema import (
    DEGREE,
    Config,
    ConfigError,
    DQNConfig,
    RandomizationConfig,
    TaskConfig,
)
from mjx_balance.errors import quote, suggest

_LAST_600_MS = tuple(range(0, 150, 5))
# The grid adds some 40% to 75% to the mean tilt of the same network (docs/how_it_works.md).
_TASK = TaskConfig(
    square_share=0.5,
    action="continuous",
    reward_tilt="mean",
    reward_toward=1.0,
    reward_toward_scale=2.5,
)
_DQN = DQNConfig(
    learning_rate=1e-2,
    learning_rate_end_share=1 / 300,
    batch_size=256,
    replay_ratio=32.0,
    min_replay_size=1_024,
    target_update_period=200,
    epsilon_decay_steps=5_000,
    exploration_noise=2,
    hidden_sizes=(64, 64),
    head="radial",
    mirror=True,
    whiten_steps=50_000,
)

# Inputs: all IMU samples of the last three decisions, as means over 20 ms, and the commands of
# these decisions. Sensor noise hides the small differences that `default` reads, so the inputs
# must be averaged. Noise is as in a data sheet. Delayed actions need the larger gamma.
_BEST = Config(
    preset="best",
    num_env_steps=200_000,
    log_every=2_048,
    task=dataclasses.replace(
        _TASK,
        gyro_lags=_LAST_600_MS,
        accel_lags=_LAST_600_MS,
        imu_mean=5,
        command_lags=(0, 1, 2),
    ),
    randomization=RandomizationConfig(
        gyro_noise=0.002,
        accel_noise=0.023,
        payload=5.0,
        latency_share=0.15,
        push_max=0.4,
        push_period=2.5,
    ),
    # The smaller batches and the higher learning rate of `default` raise the mean tilt of
    # `corner` by an eighth here. Pushes and delayed actions are unpredictable: the Huber loss
    # keeps their TD errors from dominating all others.
    dqn=dataclasses.replace(
        _DQN,
        gamma=0.4,
        learning_rate=3e-3,
        batch_size=512,
        replay_ratio=64.0,
        min_replay_size=2_048,
        epsilon_decay_steps=10_000,
        whiten_floor=0.02,
        huber_delta=0.03,
    ),
)

PRESETS: Mapping[str, Config] = {
    # 64 envs: about what two cores step at the rate at which they learn.
    "paper": Config(preset="paper", num_envs=64),
    "default": Config(preset="default", num_env_steps=40_000, task=_TASK, dqn=_DQN),
    "best": _BEST,
    # For a robot: sensors, encoders, commands and servos that err, decks that move, things that
    # happen, tilted starts. The leaky means and filters show biases.
    "real": dataclasses.replace(
        _BEST,
        preset="real",
        num_env_steps=600_000,
        task=dataclasses.replace(
            _BEST.task,
            board_motions=("ramps", "sea", "steps"),
            platform=True,
            start_incline=5.0,
            mean_times=(4.0, 20.0),
            filter_times=(1.0, 4.0),
        ),
        randomization=dataclasses.replace(
            _BEST.randomization,
            gyro_bias=0.5 * DEGREE,
            gyro_bias_drift=0.01 * DEGREE,
            encoder_offset=0.02,
            reading_offset=0.02,
            sensor_delay=0.03,
            sensor_jitter=0.01,
            command_delay=0.03,
            command_jitter=0.01,
            dropout=0.1,
            ideal_share=0.4,
            gain_spread=0.1,
            soft_share=0.25,
            event_payload=5.0,
            event_grip=0.1,
            event_strength=0.2,
        ),
        # Without it, mu is off by some 0.02 deg of tilt, from noise, and the robot stands so.
        dqn=dataclasses.replace(_BEST.dqn, zero_at_rest=True),
    ),
    # Few decisions, each replayed often: trains a policy within seconds.
    "quick": Config(
        preset="quick",
        num_env_steps=8_192,
        eval_every=0,
        eval_scenarios=16,
        eval_duration=20.0,
        task=_TASK,
        dqn=dataclasses.replace(_DQN, replay_ratio=128.0, epsilon_decay_steps=3_000),
    ),
    "smoke": Config(
        preset="smoke",
        num_envs=64,
        num_env_steps=8_192,
        log_every=1_024,
        eval_every=4_096,
        validation_scenarios=2,
        validation_duration=10.0,
        eval_scenarios=16,
        eval_duration=20.0,
        task=dataclasses.replace(_TASK, action="grid"),  # so that tests train on it, too
        dqn=dataclasses.replace(
            _DQN,
            min_replay_size=512,
            replay_capacity=8_192,
            epsilon_decay_steps=4_096,
            whiten_steps=2_048,
        ),
    ),
}
"""Configs by name, for the flag `--preset`."""


def preset(name: str) -> Config:
    """Returns the preset called `name`; raises `ConfigError` with the known names."""
    if name not in PRESETS:
        raise ConfigError(f"unknown preset {quote(name)}; {suggest('preset', name, PRESETS)}")
    return PRESETS[name]
