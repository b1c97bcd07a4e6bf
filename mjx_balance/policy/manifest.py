"""The manifest of a policy: all that a runtime needs besides the weights, as JSON values.

`inputs` are the rows of the observation; a runtime follows them and needs no config. `scene_hash`,
`versions` and `training` are provenance; all other parts follow from `config` and `robot`.
"""

import contextlib
import importlib.metadata
import json
import math
from collections.abc import Iterator, Mapping
from typing import Annotated, Any

import numpy as np
from annotated_types import Ge, Le, Len

from mjx_balance.config import ACTION_AXES, Config, check, from_dict, to_dict
from mjx_balance.errors import InputError, quote
from mjx_balance.files.validation import parse
from mjx_balance.robots.catalogue import Robot, find_robot
from mjx_balance.robots.limits import check_body, check_robot
from mjx_balance.runtime import TRIM_MOST
from mjx_balance.task.actions import action_table
from mjx_balance.task.observation import Row, input_rows

FORMAT, FORMAT_VERSION = "mjx_balance.policy", 5
CONVERTIBLE = 4  #: older version that `upgrade` converts
MOST_PART = 2**18  #: greatest size of config, robot, versions and training, characters
REMEDY = "; `mjx-balance export OLD.safetensors --out NEW.safetensors` converts a file of version 4"
VERSIONED = ("mjx_balance", "mujoco", "mujoco-mjx", "jax", "flax", "numpy")
"""Packages whose versions a manifest records."""


Trim = Annotated[float, Ge(-TRIM_MOST), Le(TRIM_MOST)]  #: rad
TRIMS: Any = Annotated[list[Annotated[list[Trim], Len(3, 3)]], Len(4, 4)]


class PolicyError(InputError):
    """Unusable policy file; the message says why."""


@contextlib.contextmanager
def naming(subject: object) -> Iterator[None]:
    """Says of invalid input what cannot be used: a file, or a part of one."""
    try:
        yield
    except InputError as error:
        raise PolicyError(f"{subject} cannot be used: {error}") from error


def make_manifest(
    config: Config,
    scene_hash: str,
    training: Mapping[str, Any],
    leg_trim: np.ndarray | None = None,
) -> dict[str, Any]:
    """Returns the manifest of a policy, as JSON values.

    Args:
      config: of the training.
      scene_hash: fingerprint of the training's scene.
      training: provenance, e.g. decisions and seconds.
      leg_trim: (legs, 3) `Stance.leg_trim` of the scene, rad; without it, a runtime knows no
        feed-forward torque.
    """
    trim = {} if leg_trim is None else {"leg_trim_rad": leg_trim.tolist()}
    return {
        "format": FORMAT,
        "version": FORMAT_VERSION,
        "config": to_dict(config),
        **describe(config, find_robot(config.robot)),
        "scene_hash": scene_hash,
        "versions": {package: installed_version(package) for package in VERSIONED},
        "training": dict(training),
        **trim,
    }


def describe(config: Config, robot: Robot) -> dict[str, Any]:
    """Returns the parts of a manifest that follow from config and robot, as JSON values."""
    task = config.task
    return {
        "robot": to_dict(robot),
        "inputs": [_input(row) for row in input_rows(task, robot)],
        "network": {
            "hidden_sizes": list(config.dqn.hidden_sizes),
            "factors": list(network_factors(config)),
            "radial": config.dqn.head == "radial",
        },
        "action": task.action,
        "actions": {"table_m": action_table(task).tolist()},
        "timing": {
            "sample_s": task.sim_dt,
            "decision_samples": task.sim_steps,
            "ramp_samples": task.ramp_steps,
        },
        "body_height_m": task.body_height,
        "fail_tilt_deg": task.fail_tilt,
    }


def _input(row: Row) -> dict[str, Any]:
    """A row as JSON values; only rows with a time constant have one, as in the first files."""
    values = row._asdict() | {"mirror": row.mirror._asdict()}
    return {name: value for name, value in values.items() if value is not None}


def network_factors(config: Config) -> tuple[int, ...]:
    """Factors of the Q-network: one for all actions (head "joint"), or one per axis."""
    levels = (config.task.action_levels,) * ACTION_AXES
    return (math.prod(levels),) if config.dqn.head == "joint" else levels


def read_manifest(manifest: Any) -> tuple[Config, Robot]:
    """Checks a manifest, and returns its config and robot.

    Raises:
      PolicyError: if format or version differ, config or robot are invalid, or another part does
        not follow from them.
    """
    if not isinstance(manifest, dict):
        raise PolicyError("its manifest is not a JSON object")
    for name, expected in (("format", FORMAT), ("version", FORMAT_VERSION)):
        value = manifest.get(name)
        if value != expected:
            remedy = REMEDY if value == CONVERTIBLE else ""
            raise PolicyError(f"{name} is {quote(value)}; this release reads {expected!r}{remedy}")
    config, robot = _config_and_robot(manifest)
    if "leg_trim_rad" in manifest:
        parse(TRIMS, manifest["leg_trim_rad"], PolicyError, name="leg_trim_rad")
    # The first files of format 5 do not say what kind of action they have, nor a command delay.
    parts = {"action": "grid"} | manifest | {"robot": to_dict(robot)}
    for part, expected in describe(config, robot).items():
        if parts.get(part) != expected:
            raise PolicyError(f"its {part} is not what its own config gives")
    return config, robot


def upgrade(manifest: Any) -> Any:
    """Returns a manifest of format 4 in format 5, and anything else unchanged.

    Format 4 has only names and scales of the observation; format 5 has the rows as `inputs`.

    Raises:
      PolicyError: if a part has the wrong type, or config or robot are invalid.
    """
    if not isinstance(manifest, dict):
        return manifest
    if (manifest.get("format"), manifest.get("version")) != (FORMAT, CONVERTIBLE):
        return manifest
    parts = describe(*_config_and_robot(manifest)) | {"version": FORMAT_VERSION}
    same = ("format", "config", "scene_hash", "versions", "training")
    return {name: manifest[name] for name in same} | parts


def _config_and_robot(manifest: Mapping[str, Any]) -> tuple[Config, Robot]:
    """Checks all parts of a manifest of format 4 or 5 that do not follow from others."""
    for name in ("config", "robot", "versions", "training"):
        with contextlib.suppress(RecursionError):  # the checks of its fields find that
            if len(json.dumps(manifest.get(name))) > MOST_PART:
                raise PolicyError(f"its {name} has more than {MOST_PART} characters")
    for name, kind in (("scene_hash", str), ("versions", dict), ("training", dict)):
        parse(kind, manifest.get(name), PolicyError, name=name)
    with naming("its robot"):
        robot = from_dict(Robot, manifest.get("robot"))
        check_body(robot)
    with naming("its config"):
        return check_robot(check(from_dict(Config, manifest.get("config"))), robot), robot


def installed_version(package: str) -> str | None:
    """Returns the version of a package, or None if it is not installed."""
    try:
        return importlib.metadata.version(package)
    except importlib.metadata.PackageNotFoundError:
        return None
