"""The config of a run: frozen dataclasses, presets, sweeps and consistency checks."""

from mjx_balance.config.presets import PRESETS, preset
from mjx_balance.config.schema import (
    ACTION_AXES,
    DEGREE,
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
