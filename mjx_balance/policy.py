"""The exported policy: a self-describing safetensors file and its NumPy forward pass.

Nothing here needs JAX. The file holds float32 weights and, in its metadata, a JSON
manifest with everything a user needs to run the policy elsewhere: config,
observation layout and scaling, action table, rates, scene fingerprint, versions
and where the training came from.
"""

import hashlib
import importlib.metadata
import json
import math
import os
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np
import safetensors
import safetensors.numpy

from mjx_balance.config import Config, check, from_dict, to_dict
from mjx_balance.dqn import heads
from mjx_balance.task.actions import action_table
from mjx_balance.task.observation import observation_names, observation_scale

FORMAT = "mjx_balance.policy"
FORMAT_VERSION = 2
VERSIONED = ("mjx_balance", "mujoco", "mujoco-mjx", "jax", "flax", "numpy")


class PolicyError(ValueError):
    """A policy file that cannot be used; the message says what is wrong with it."""


class Policy:
    """A greedy policy in NumPy.

    Calling it maps observations to action indices. `.manifest` is the file's JSON,
    `.config` the config it was trained with, `.actions` the (num_actions, 2) height
    changes in m that the indices stand for.
    """

    def __init__(self, manifest: dict[str, Any], weights: Mapping[str, np.ndarray]):
        """Takes what a policy file holds.

        Raises:
          PolicyError: if manifest and weights do not fit together.
        """
        if not isinstance(manifest, dict):
            raise PolicyError("its manifest is not a JSON object")
        if manifest.get("format") != FORMAT:
            raise PolicyError(f"format is {manifest.get('format')!r}; it must be {FORMAT!r}")
        if manifest.get("version") != FORMAT_VERSION:
            raise PolicyError(
                f"format version is {manifest.get('version')!r}; this release reads "
                f"version {FORMAT_VERSION}"
            )
        try:
            self.config = check(from_dict(Config, manifest["config"]))
            network = manifest["network"]
            self.factors = tuple(int(n) for n in network["factors"])
            self.radial = bool(network["radial"])
            hidden_sizes = tuple(int(n) for n in network["hidden_sizes"])
            self.actions = np.asarray(manifest["actions"]["table_m"], np.float32)
            obs_size = len(manifest["observation"]["names"])
            self.scene_hash = str(manifest["scene_hash"])
            scale = np.asarray(manifest["observation"]["scale"], np.float32)
        except (KeyError, TypeError, ValueError, OverflowError) as error:
            raise PolicyError(f"its manifest cannot be used: {error}") from error
        task, robot = self.config.task, self.config.robot
        if self.actions.shape != (math.prod(self.factors), 2):
            raise PolicyError(
                f"its action table has shape {self.actions.shape}; its network chooses among "
                f"{math.prod(self.factors)} actions"
            )
        agrees = {
            "action table": np.array_equal(self.actions, action_table(task)),
            "observation names": tuple(manifest["observation"]["names"])
            == observation_names(task, robot),
            "observation scale": np.array_equal(scale, observation_scale(task, robot)),
        }
        for name, same in agrees.items():
            if not same:
                raise PolicyError(f"its {name} is not the one that its own config gives")
        self.manifest = manifest
        self.observation_size = obs_size
        names = [f"hidden_{i}" for i in range(len(hidden_sizes))] + ["head"]
        rows = [obs_size, *hidden_sizes]
        columns = [*hidden_sizes, sum(self.factors)]
        if self.radial:
            rows[-1] += obs_size
            columns[-1] = 1 + len(self.factors)
            self._profile = _weight(weights, "profile", (4,))
            self._stretch = _weight(weights, "stretch", (len(self.factors),))
            self._points = heads.points(self.factors)
        self._layers = []
        for name, n, m in zip(names, rows, columns, strict=True):
            kernel = _weight(weights, f"{name}/kernel", (n, m))
            self._layers.append((kernel, _weight(weights, f"{name}/bias", (m,))))

    @property
    def fingerprint(self) -> str:
        """Short digest of the weights."""
        arrays = [array for layer in self._layers for array in layer]
        if self.radial:  # as they enter the head
            arrays += [np.logaddexp(0, self._profile), np.exp(self._stretch)]
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
        obs = x = np.asarray(obs, np.float32)
        if x.ndim not in (1, 2) or x.shape[-1] != self.observation_size:
            raise ValueError(
                f"obs has shape {x.shape}; it must be ({self.observation_size},) or "
                f"(batch, {self.observation_size})"
            )
        for kernel, bias in self._layers[:-1]:
            x = np.maximum(x @ kernel + bias, 0.0)
        kernel, bias = self._layers[-1]
        if not self.radial:
            return heads.added_up(x @ kernel + bias, self.factors)
        out = np.concatenate((x, obs), axis=-1) @ kernel + bias
        return heads.radial(out, self._profile, self._stretch, self._points)

    def __call__(self, obs: np.ndarray) -> np.ndarray:
        """Index of the best action: () for (obs_size,), (batch,) for (batch, obs_size)."""
        return np.argmax(self.q_values(obs), axis=-1)


def _weight(weights: Mapping[str, np.ndarray], name: str, shape: tuple[int, ...]) -> np.ndarray:
    if name not in weights:
        raise PolicyError(f"weight {name} is missing")
    value = weights[name]
    if value.shape != shape:
        raise PolicyError(f"weight {name} has shape {value.shape}; it must be {shape}")
    if not np.isfinite(value).all():
        raise PolicyError(f"weight {name} holds values that are not finite numbers")
    return value.astype(np.float32)


def make_manifest(
    config: Config, scene_hash: str, factors: tuple[int, ...], training: Mapping[str, Any]
) -> dict[str, Any]:
    """Describes a policy.

    Args:
      config: what it was trained with.
      scene_hash: fingerprint of the scene it was trained in.
      factors: sizes of the network's action branches.
      training: provenance, e.g. decisions and seconds.
    """
    task = config.task
    versions = {}
    for package in VERSIONED:
        try:
            versions[package] = importlib.metadata.version(package)
        except importlib.metadata.PackageNotFoundError:
            versions[package] = None
    return {
        "format": FORMAT,
        "version": FORMAT_VERSION,
        "config": to_dict(config),
        "network": {
            "hidden_sizes": list(config.dqn.hidden_sizes),
            "factors": list(factors),
            "radial": config.dqn.head == "radial",
        },
        "observation": {
            "names": list(observation_names(task, config.robot)),
            "scale": observation_scale(task, config.robot).tolist(),
            "height_offset_m": task.body_height,
            "imu_lag_s": task.sim_dt,
        },
        "actions": {
            "table_m": action_table(task).tolist(),
            "ramp_s": task.ramp_steps * task.sim_dt,
        },
        "rates_hz": {"decision": 1 / task.ctrl_dt, "imu": 1 / task.sim_dt},
        "scene_hash": scene_hash,
        "versions": versions,
        "training": dict(training),
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
    """
    weights = flat_weights(params)
    policy = Policy(manifest, weights)
    part = Path(path).with_suffix(".part")
    safetensors.numpy.save_file(weights, part, metadata={"manifest": json.dumps(manifest)})
    part.replace(path)
    return policy


def load_policy(path: str | os.PathLike[str]) -> Policy:
    """Reads a policy file.

    Raises:
      PolicyError: if it is missing, truncated, or not a policy this release can run.
    """
    if not Path(path).is_file():
        raise PolicyError(f"no policy file at {path}; `mjx-balance train` writes one")
    try:
        with safetensors.safe_open(path, framework="numpy") as file:
            metadata = file.metadata() or {}
            weights = {name: file.get_tensor(name) for name in file.keys()}  # noqa: SIM118
        if "manifest" not in metadata:
            raise PolicyError("it carries no manifest, so it is no policy of mjx_balance")
        return Policy(json.loads(metadata["manifest"]), weights)
    except (safetensors.SafetensorError, json.JSONDecodeError) as error:
        raise PolicyError(f"{path} is damaged or no safetensors file: {error}") from error
    except PolicyError as error:
        raise PolicyError(f"{path} cannot be used: {error}") from error
