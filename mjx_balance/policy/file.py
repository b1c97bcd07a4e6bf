"""The exported policy: a self-describing safetensors file and its NumPy forward pass.

Nothing here needs JAX. The file holds float32 weights and, in its metadata, a JSON
manifest with everything a user needs to run the policy elsewhere: config,
observation layout and scaling, action table, rates, scene fingerprint, versions
and where the training came from.
"""

import hashlib
import importlib.metadata
import json
import os
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np
import safetensors
import safetensors.numpy

from mjx_balance.config import (
    ACTION_AXES,
    Config,
    ConfigError,
    check,
    from_dict,
    shown,
    to_dict,
)
from mjx_balance.errors import InputError
from mjx_balance.files.run_folder import RunFolder, write_atomically
from mjx_balance.policy import heads
from mjx_balance.robots.catalogue import Robot, find_robot, robot_from_dict
from mjx_balance.task.actions import action_table
from mjx_balance.task.observation import input_rows

FORMAT = "mjx_balance.policy"
FORMAT_VERSION = 4
UPGRADED = 3
UPGRADE = ", and policies/upgrade.py in the project's repository rewrites files of 3"
MOST_BYTES = 64 * 2**20
MOST_MANIFEST = 4 * 2**20
"""Larger files and manifests are no policies, whatever they say."""
VERSIONED = ("mjx_balance", "mujoco", "mujoco-mjx", "jax", "flax", "numpy")


class PolicyError(InputError):
    """A policy file that cannot be used; the message says what is wrong with it."""


class Policy:
    """A greedy policy in NumPy.

    Calling it maps observations to action indices. `.manifest` is the file's JSON,
    `.config` the config it was trained with, `.robot` the robot, `.actions` the
    (num_actions, 2) height changes in m that the indices stand for, `.layers` the kernels
    and biases.
    """

    def __init__(self, manifest: dict[str, Any], weights: Mapping[str, np.ndarray]):
        """Takes what a policy file holds.

        Raises:
          PolicyError: if manifest and weights do not fit together.
        """
        self.config, self.robot = _read_config(manifest)
        self.manifest = manifest
        self.scene_hash: str = manifest["scene_hash"]
        self.actions = action_table(self.config.task)
        self.factors = network_branches(self.config)
        self.radial = self.config.dqn.head == "radial"
        self.observation_size = len(manifest["observation"]["names"])
        hidden = self.config.dqn.hidden_sizes
        names = [f"hidden_{i}" for i in range(len(hidden))] + ["head"]
        rows = [self.observation_size, *hidden]
        columns = [*hidden, sum(self.factors)]
        shapes: dict[str, tuple[int, ...]] = {}
        if self.radial:
            rows[-1] += self.observation_size
            columns[-1] = 1 + len(self.factors)
            shapes |= {"profile": (4,), "stretch": (len(self.factors),)}
        for name, n, m in zip(names, rows, columns, strict=True):
            shapes |= {f"{name}/kernel": (n, m), f"{name}/bias": (m,)}
        _check_weights(weights, shapes)
        self.layers = [(weights[f"{name}/kernel"], weights[f"{name}/bias"]) for name in names]
        if self.radial:
            self.profile, self.stretch = weights["profile"], weights["stretch"]

    @property
    def fingerprint(self) -> str:
        """Short digest of the weights."""
        arrays = [array for layer in self.layers for array in layer]
        if self.radial:  # as they enter the head
            arrays += [np.logaddexp(0, self.profile), np.exp(self.stretch)]
        return hashlib.sha256(b"".join(array.tobytes() for array in arrays)).hexdigest()[:16]

    def q_values(self, obs: np.ndarray) -> np.ndarray:
        """Action values.

        Args:
          obs: (obs_size,) or (batch, obs_size) scaled observations.

        Returns:
          (num_actions,) or (batch, num_actions) float32.

        Raises:
          ValueError: if obs has another size.
        """
        return self._head(obs).q_values()

    def __call__(self, obs: np.ndarray) -> np.ndarray:
        """Index of the best action: () for (obs_size,), (batch,) for (batch, obs_size)."""
        return self._head(obs).argmax()

    def _head(self, obs: np.ndarray) -> heads.Head:
        obs = x = np.asarray(obs, np.float32)
        if x.ndim not in (1, 2) or x.shape[-1] != self.observation_size:
            raise ValueError(
                f"obs has shape {x.shape}; it must be ({self.observation_size},) or "
                f"(batch, {self.observation_size})"
            )
        for kernel, bias in self.layers[:-1]:
            x = np.maximum(x @ kernel + bias, 0.0)
        kernel, bias = self.layers[-1]
        if not self.radial:
            return heads.Added(x @ kernel + bias, self.factors)
        out = np.concatenate((x, obs), axis=-1) @ kernel + bias
        return heads.Radial(out, self.profile, self.stretch, self.factors)


def _read_config(manifest: Any) -> tuple[Config, Robot]:
    """Config and robot of a manifest, all of whose other parts follow from them.

    Raises:
      PolicyError: for another format, a config that cannot be run, or a part that differs.
    """
    if not isinstance(manifest, dict):
        raise PolicyError("its manifest is not a JSON object")
    for name, wanted in (("format", FORMAT), ("version", FORMAT_VERSION)):
        if manifest.get(name) != wanted:
            remedy = UPGRADE if manifest.get(name) == UPGRADED else ""
            raise PolicyError(
                f"{name} is {shown(manifest.get(name))}; this release reads {wanted!r}{remedy}"
            )
    for name, kind in (
        ("config", dict),
        ("robot", dict),
        ("scene_hash", str),
        ("versions", dict),
        ("training", dict),
    ):
        if not isinstance(manifest.get(name), kind):
            what = {dict: "a JSON object", str: "a string"}[kind]
            raise PolicyError(f"its {name} is {shown(manifest.get(name))}; it must be {what}")
    try:
        robot = robot_from_dict(manifest["robot"])
    except ValueError as error:
        raise PolicyError(f"its robot cannot be used: {error}") from error
    try:
        config = check(from_dict(Config, manifest["config"]), robot)
    except ConfigError as error:
        raise PolicyError(f"its config cannot be used: {error}") from error
    for part, wanted in _described(config, robot).items():
        if manifest.get(part) != wanted:
            raise PolicyError(f"its {part} is not what its own config gives")
    return config, robot


def _check_weights(
    weights: Mapping[str, np.ndarray], shapes: Mapping[str, tuple[int, ...]]
) -> None:
    extra = sorted(set(weights) - set(shapes))
    if extra:
        raise PolicyError(f"weight {shown(extra[0])} is none of this network's")
    for name, shape in shapes.items():
        if name not in weights:
            raise PolicyError(f"weight {name} is missing")
        value = weights[name]
        if value.shape != shape or value.dtype != np.float32:
            raise PolicyError(
                f"weight {name} is {value.dtype} of shape {value.shape}; it must be float32 of "
                f"shape {shape}"
            )
        if not np.isfinite(value).all():
            raise PolicyError(f"weight {name} holds values that are not finite numbers")


def network_branches(config: Config) -> tuple[int, ...]:
    """Output branches of the network: all actions at once, or roll and pitch apart."""
    levels = config.task.action_levels
    return (levels**ACTION_AXES,) if config.dqn.head == "joint" else (levels,) * ACTION_AXES


def make_manifest(config: Config, scene_hash: str, training: Mapping[str, Any]) -> dict[str, Any]:
    """Describes a policy.

    Args:
      config: what it was trained with.
      scene_hash: fingerprint of the scene it was trained in.
      training: provenance, e.g. decisions and seconds.
    """
    return {
        "format": FORMAT,
        "version": FORMAT_VERSION,
        "config": to_dict(config),
        **_described(config, find_robot(config.robot)),
        "scene_hash": scene_hash,
        "versions": {package: installed_version(package) for package in VERSIONED},
        "training": dict(training),
    }


def installed_version(package: str) -> str | None:
    """Version of an installed package, none of one that is not."""
    try:
        return importlib.metadata.version(package)
    except importlib.metadata.PackageNotFoundError:
        return None


def _described(config: Config, robot: Robot) -> dict[str, Any]:
    """What follows from a config, written out for whoever runs the policy elsewhere."""
    task, rows = config.task, input_rows(config.task, robot)
    return {
        "robot": to_dict(robot),
        "network": {
            "hidden_sizes": list(config.dqn.hidden_sizes),
            "factors": list(network_branches(config)),
            "radial": config.dqn.head == "radial",
        },
        "observation": {
            "names": [row.name for row in rows],
            "scale": [row.scale for row in rows],
            "height_offset_m": task.body_height,
            "imu_lag_s": task.sim_dt,
            "imu_mean_samples": task.imu_mean,
        },
        "actions": {
            "table_m": action_table(task).tolist(),
            "ramp_s": task.ramp_steps * task.sim_dt,
        },
        "rates_hz": {"decision": 1 / task.ctrl_dt, "imu": 1 / task.sim_dt},
    }


def flat_weights(params: Mapping[str, Any]) -> dict[str, np.ndarray]:
    """Names every array of a flax network's variables, e.g. `hidden_0/kernel`."""
    weights = {}
    for layer, value in params["params"].items():
        arrays = value.items() if isinstance(value, Mapping) else [("", value)]
        for name, array in arrays:
            key = f"{layer}/{name}" if name else layer
            weights[key] = np.ascontiguousarray(array, np.float32)
    return weights


def save_policy(
    path: str | os.PathLike[str], params: Mapping[str, Any], manifest: dict[str, Any]
) -> Policy:
    """Writes a policy file, whole or not at all.

    Args:
      path: where to.
      params: the flax network's variables, {"params": {layer: {kernel, bias}, name: array}}.
      manifest: from `make_manifest`.

    Returns:
      The policy as it will be loaded.

    Raises:
      PolicyError: if weights and manifest make no policy.
      OSError: if it cannot be written.
    """
    weights = flat_weights(params)
    policy = Policy(manifest, weights)
    content = safetensors.numpy.save(weights, metadata={"manifest": json.dumps(manifest)})
    write_atomically(Path(path), content)
    return policy


def shipped_policies() -> dict[str, Path]:
    """The policies that come with this package, by name: `best`, and one for each other robot."""
    package = Path(__file__).resolve().parents[1]
    installed = package / "policies"
    folder = installed if installed.is_dir() else package.parent / "policies"
    found = [*folder.glob("*.safetensors"), *(folder / "robots").glob("*.safetensors")]
    return {path.stem: path for path in sorted(found)}


def find_policy(name: str | os.PathLike[str]) -> Path:
    """The file of a policy.

    Args:
      name: the file's, a run folder's, or a shipped policy's.

    Raises:
      PolicyError: if there is none.
    """
    path, shipped = Path(name), shipped_policies()
    try:
        for file in (path, RunFolder(path).policy):
            if file.is_file():
                return file
    except OSError as error:  # a name that is too long
        raise PolicyError(
            f"policy is {shown(str(path))}; it cannot be read: {error.strerror}"
        ) from error
    if str(path) not in shipped:
        raise PolicyError(
            f"no policy file at {path}; `mjx-balance train` writes one, and "
            f"{', '.join(shipped)} are shipped"
        )
    return shipped[str(path)]


def load_policy(path: str | os.PathLike[str]) -> Policy:
    """Reads a policy file.

    Args:
      path: of the file, of the run folder that it is in, or a shipped policy's name.

    Raises:
      PolicyError: if it is missing, truncated, or not a policy this release can run.
    """
    path = find_policy(path)
    if path.stat().st_size > MOST_BYTES:
        raise PolicyError(
            f"{path} has {path.stat().st_size} bytes; no policy has more than {MOST_BYTES}"
        )
    try:
        return Policy(*_read(path))
    except (safetensors.SafetensorError, OSError, UnicodeDecodeError) as error:
        raise PolicyError(f"{path} is damaged or no safetensors file: {error}") from error
    except PolicyError as error:
        raise PolicyError(f"{path} cannot be used: {error}") from error


def _read(path: Path) -> tuple[Any, dict[str, np.ndarray]]:
    """Manifest and weights of a safetensors file."""
    with safetensors.safe_open(path, framework="numpy") as file:
        text = (file.metadata() or {}).get("manifest")
        if text is None:
            raise PolicyError("it carries no manifest, so it is no policy of mjx_balance")
        if len(text) > MOST_MANIFEST:
            raise PolicyError(f"its manifest has {len(text)} characters, more than {MOST_MANIFEST}")
        for name in file.keys():  # noqa: SIM118
            # NumPy has no name for some of the types that safetensors knows.
            if file.get_slice(name).get_dtype() != "F32":
                kind = file.get_slice(name).get_dtype()
                raise PolicyError(f"weight {shown(name)} is {kind}; it must be F32 (float32)")
        weights = {name: file.get_tensor(name) for name in file.keys()}  # noqa: SIM118
    try:
        return json.loads(text), weights
    except (ValueError, RecursionError) as error:
        raise PolicyError(f"its manifest is no JSON: {error}") from error
