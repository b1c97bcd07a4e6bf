"""The config of a run: the numbers of task and training, presets, sweeps and consistency checks.

Configs are frozen dataclasses. `robots.limits` adapts them to a robot and checks them against it.
"""

from mjx_balance.config.presets import PRESETS, preset
from mjx_balance.config.schema import (
    ACTION_AXES,
    Config,
    ConfigError,
    DQNConfig,
    RandomizationConfig,
    TaskConfig,
)
from mjx_balance.config.serialization import (
    check_same_config,
    flatten,
    from_dict,
    read_config,
    read_run_config,
    to_dict,
)
from mjx_balance.config.sweep import SWEEPABLE, expand_runs, sweep_grid
from mjx_balance.config.validation import check

__all__ = [
    "ACTION_AXES",
    "PRESETS",
    "SWEEPABLE",
    "Config",
    "ConfigError",
    "DQNConfig",
    "RandomizationConfig",
    "TaskConfig",
    "check",
    "check_same_config",
    "expand_runs",
    "flatten",
    "from_dict",
    "preset",
    "read_config",
    "read_run_config",
    "sweep_grid",
    "to_dict",
]
