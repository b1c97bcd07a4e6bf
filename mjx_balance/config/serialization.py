"""A config as JSON, and back."""

import dataclasses
import json
from collections.abc import Mapping
from pathlib import Path
from typing import Any, TypeVar

from mjx_balance.config.schema import Config, ConfigError
from mjx_balance.config.validation import check
from mjx_balance.files.run_folder import RunFolderError, read_json, unfinished_run
from mjx_balance.files.text import MESSAGE, shorten
from mjx_balance.files.validation import parse

T = TypeVar("T")


def to_dict(section: Any) -> dict[str, Any]:
    """Returns a config, or a section of one, as plain JSON values."""
    return json.loads(json.dumps(dataclasses.asdict(section)))


def from_dict(kind: type[T], values: Any) -> T:
    """Rebuilds the config or section `kind` from `to_dict`'s values; what is missing is default.

    Raises:
      ConfigError: for a field that `kind` does not have, or a value that is none of its field's.
    """
    return parse(kind, values, ConfigError)


def flatten(values: Mapping[str, Any]) -> dict[str, Any]:
    """Returns the fields of `to_dict`'s values without their sections; no two have one name."""
    flat = {}
    for name, value in values.items():
        flat |= flatten(value) if isinstance(value, dict) else {name: value}
    return flat


def read_config(file: Path) -> Config:
    """Reads a run's config.json.

    Raises:
      ValueError: if it is no JSON, or no config that can be run.
    """
    return check(from_dict(Config, read_json(file)))


def read_run_config(path: Path) -> Config:
    """Reads the config of an existing run that is not finished.

    Raises:
      RunFolderError: if `path` is no run folder, or its run is finished.
    """
    file = unfinished_run(path).config
    try:
        return read_config(file)
    except ValueError as error:
        raise RunFolderError(f"{file} cannot be used: {shorten(error, MESSAGE)}") from error


def check_same_config(saved: Config, config: Config, path: Path) -> None:
    """Refuses to resume the run in `path` as another one.

    Raises:
      RunFolderError: naming the first field that differs.
    """
    before = flatten(to_dict(saved))
    for name, value in flatten(to_dict(config)).items():
        if before[name] != value:
            raise RunFolderError(
                f"{path} was started with {name} = {before[name]}, not {value}; resume it "
                "without that flag, or start a new run"
            )
