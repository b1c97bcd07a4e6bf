"""A config as JSON, and back."""

import contextlib
import dataclasses
import json
import os
from collections.abc import Mapping
from pathlib import Path
from typing import Any, TypeVar

from mjx_balance.config.schema import Config, ConfigError
from mjx_balance.config.validation import check
from mjx_balance.files.run_folder import RunFolderError, read_json, unfinished_run
from mjx_balance.files.validation import parse

T = TypeVar("T")


def to_dict(section: Any) -> dict[str, Any]:
    """Returns a config, a section of one, or another dataclass as plain JSON values."""
    return json.loads(json.dumps(dataclasses.asdict(section)))


def from_dict(kind: type[T], values: Any) -> T:
    """Builds a dataclass from `to_dict`'s values; missing fields take their defaults.

    Raises:
      ConfigError: if a field is unknown, or a value has the wrong type or is out of bounds.
    """
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
    """Reads the config of an unfinished run.

    A robot file has the path at which the run began, unless it is gone from there: from here, the
    config's own path may lead to another robot.

    Raises:
      RunFolderError: if `path` is not a run folder, its run is finished, or its config is invalid.
    """
    folder = unfinished_run(path)
    try:
        config = read_config(folder.config)
    except ValueError as error:
        raise RunFolderError(f"{folder.config} cannot be used: {error}") from error
    if _is_file(config.robot):
        with contextlib.suppress(ValueError, LookupError, TypeError):
            # Whatever is wrong with the provenance, `check_same_provenance` says it.
            began_with = str(Path(read_json(folder.provenance)["robot_file"]))
            same = os.path.realpath(config.robot) == os.path.realpath(began_with)
            if os.path.isfile(began_with) and not same:
                return dataclasses.replace(config, robot=began_with)
    return config


def _is_file(robot: str) -> bool:
    return robot.endswith(".toml")


def check_same_config(saved: Config, config: Config, path: Path) -> None:
    """Checks that the run in `path`, of config `saved`, is resumed with the same config.

    A robot file may have moved; `check_same_provenance` compares its numbers.

    Raises:
      RunFolderError: names the first field that differs.
    """
    before = flatten(to_dict(saved))
    moved = _is_file(saved.robot) and _is_file(config.robot)
    for name, value in flatten(to_dict(config)).items():
        if before[name] != value and not (name == "robot" and moved):
            raise RunFolderError(
                f"{path} was started with {name} = {before[name]}, not {value}; resume it "
                "without that flag, or start a new run"
            )
