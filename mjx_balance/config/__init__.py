"""Every number of the task and the training, and whether they can go together.

A config is a frozen value. What depends on the robot is in `robots.limits`.
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
