"""Named configs to start from."""

import dataclasses
from collections.abc import Mapping

from mjx_balance.config.schema import (
    Config,
    ConfigError,
    DQNConfig,
    RandomizationConfig,
    TaskConfig,
)

_LAST_600_MS = tuple(range(0, 150, 5))
_TASK = TaskConfig(square_share=0.5, reward_tilt="mean", reward_toward=1.0, reward_toward_scale=2.5)
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

PRESETS: Mapping[str, Config] = {
    # 64 envs: about what two cores step at the rate at which they learn.
    "paper": Config(preset="paper", num_envs=64),
    "default": Config(preset="default", num_env_steps=40_000, task=_TASK, dqn=_DQN),
    # All IMU samples of the last three decisions, as means over 20 ms, and these decisions'
    # commands, under noise of a data sheet, payloads, late actions and kicks: what `default` reads
    # off tiny differences, this one has to average. The greater gamma is for the late actions.
    "best": Config(
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
        # `default`'s smaller batches at a higher rate cost an eighth of `corner`'s mean tilt here.
        # Nobody can foresee a kick or a late action: squared, their TD errors drown all others.
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
    ),
    # Few decisions, each replayed often: a policy that balances within seconds.
    "quick": Config(
        preset="quick",
        num_env_steps=8_192,
        eval_every=0,
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
        task=_TASK,
        dqn=dataclasses.replace(
            _DQN,
            min_replay_size=512,
            replay_capacity=8_192,
            epsilon_decay_steps=4_096,
            whiten_steps=2_048,
        ),
    ),
}
"""Named starting points of the command line."""


def preset(name: str) -> Config:
    """Returns the preset called `name`; raises `ConfigError` with the known names."""
    if name not in PRESETS:
        raise ConfigError(f"unknown preset {name!r}; known presets: {', '.join(PRESETS)}")
    return PRESETS[name]
