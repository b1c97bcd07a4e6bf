"""The config of a run: frozen dataclasses, presets, sweeps and consistency checks."""

from mjx_balance.config.presets import PRESETS as PRESETS
from mjx_balance.config.presets import preset as preset
from mjx_balance.config.schema import ACTION_AXES as ACTION_AXES
from mjx_balance.config.schema import Config as Config
from mjx_balance.config.schema import ConfigError as ConfigError
from mjx_balance.config.schema import DQNConfig as DQNConfig
from mjx_balance.config.schema import RandomizationConfig as RandomizationConfig
from mjx_balance.config.schema import TaskConfig as TaskConfig
from mjx_balance.config.serialization import check_same_config as check_same_config
from mjx_balance.config.serialization import flatten as flatten
from mjx_balance.config.serialization import from_dict as from_dict
from mjx_balance.config.serialization import read_config as read_config
from mjx_balance.config.serialization import read_run_config as read_run_config
from mjx_balance.config.serialization import to_dict as to_dict
from mjx_balance.config.sweep import SWEEPABLE as SWEEPABLE
from mjx_balance.config.sweep import expand_runs as expand_runs
from mjx_balance.config.sweep import sweep_grid as sweep_grid
from mjx_balance.config.validation import check as check
