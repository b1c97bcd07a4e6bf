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
    """Returns a config, a section of one, or another dataclass as plain JSON values."""
    return json.loads(json.dumps(dataclasses.asdict(section)))


def from_dict(kind: type[T], values: Any) -> T:
    """Builds a dataclass from JSON values and defaults; raises `ConfigError` for invalid ones."""
    return parse(kind, values, ConfigError)


def flatten(values: Mapping[str, Any]) -> dict[str, Any]:
    """Returns all fields of nested sections in one dict; field names are unique."""
    flat = {}
    for name, value in values.items():
        flat |= flatten(value) if isinstance(value, dict) else {name: value}
    return flat


def read_config(file: Path) -> Config:
    """Reads and checks a config.json; raises ValueError if it is not JSON or not valid."""
    return check(from_dict(Config, read_json(file)))


def read_run_config(path: Path) -> Config:
    """Reads the config of an unfinished run; raises `RunFolderError` if that is impossible."""
    file = unfinished_run(path).config
    try:
        return read_config(file)
    except ValueError as error:
        raise RunFolderError(f"{file} cannot be used: {shorten(error, MESSAGE)}") from error


def check_same_config(saved: Config, config: Config, path: Path) -> None:
    """Raises `RunFolderError` with the field if the run in `path` is resumed otherwise."""
    before = flatten(to_dict(saved))
    for name, value in flatten(to_dict(config)).items():
        if before[name] != value:
            raise RunFolderError(
                f"{path} was started with {name} = {before[name]}, not {value}; resume it "
                "without that flag, or start a new run"
            )
