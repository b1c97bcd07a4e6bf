"""The Q-network of an exported policy in NumPy."""

import copy
import dataclasses
import hashlib
from collections.abc import Mapping
from typing import Any, Self

import numpy as np

from mjx_balance.config import check, to_dict
from mjx_balance.errors import quote
from mjx_balance.policy import heads
from mjx_balance.policy.manifest import PolicyError, describe, network_factors, read_manifest
from mjx_balance.task.actions import action_table


class Policy:
    """A greedy policy in NumPy: a callable from observations to action indices.

    Attributes: `manifest` (JSON values), `config`, `robot`, `actions` ((num_actions, 2) height
    changes a_x and a_y, m) and `layers` (pairs of kernel and bias).
    """

    def __init__(self, manifest: dict[str, Any], weights: Mapping[str, np.ndarray]):
        """Checks manifest and weights.

        Args:
          manifest: from `make_manifest` or a file.
          weights: {name: float32 array}, as `flat_weights`.

        Raises:
          PolicyError: if manifest and weights do not match, or one of them is invalid.
        """
        self.config, self.robot = read_manifest(manifest)
        self.manifest = manifest
        self.scene_hash: str = manifest["scene_hash"]
        self.actions = action_table(self.config.task)
        self.factors = network_factors(self.config)
        self.radial = self.config.dqn.head == "radial"
        self.observation_size = len(manifest["inputs"])
        hidden = self.config.dqn.hidden_sizes
        names = [f"hidden_{i}" for i in range(len(hidden))] + ["head"]
        rows, columns = [self.observation_size, *hidden], [*hidden, sum(self.factors)]
        shapes: dict[str, tuple[int, ...]] = {}
        if self.radial:
            rows[-1] += self.observation_size
            columns[-1] = 1 + len(self.factors)
            shapes = {"profile": (4,), "stretch": (len(self.factors),)}
        for name, n, m in zip(names, rows, columns, strict=True):
            shapes |= {f"{name}/kernel": (n, m), f"{name}/bias": (m,)}
        _check_weights(weights, shapes)
        self.layers = [(weights[f"{name}/kernel"], weights[f"{name}/bias"]) for name in names]
        if self.radial:
            self.profile, self.stretch = weights["profile"], weights["stretch"]

    def __repr__(self) -> str:
        """What it is, in one line."""
        dqn, training = self.config.dqn, self.manifest["training"]
        steps = training.get("env_steps")
        after = f" after {steps:,} decisions" if isinstance(steps, int) else ""
        layers = " x ".join(map(str, dqn.hidden_sizes))
        return (
            f"Policy(preset {quote(self.config.preset)}{after}, robot {quote(self.robot.name)}, "
            f"{self.observation_size} inputs, hidden layers {layers}, head {dqn.head}, "
            f"action {self.config.task.action}, weights {self.fingerprint})"
        )

    @property
    def fingerprint(self) -> str:
        """Digest of the weights, 16 hexadecimal digits."""
        arrays = [array for layer in self.layers for array in layer]
        if self.radial:
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

    def command(self, obs: np.ndarray) -> np.ndarray:
        """The height changes a_x and a_y that the policy commands, m.

        With `config.task.action` "grid" they are the best action's; with "continuous" those of the
        best point, of which the best action is the nearest on the grid.

        Args:
          obs: (obs_size,) or (batch, obs_size) scaled observations.

        Returns:
          (2,) or (batch, 2) float32, within the range of `actions`.

        Raises:
          ValueError: if obs has another size.
        """
        head = self._head(obs)
        if self.config.task.action == "continuous" and isinstance(head, heads.Radial):
            return head.peak() * self.actions.max(axis=0)
        return self.actions[head.argmax()]

    def with_action(self, action: str) -> Self:
        """The same weights as a policy of another `config.task.action`: "grid" or "continuous".

        Raises:
          ConfigError: for another word, or a head that has values of the grid's actions only.
        """
        other, task = copy.copy(self), dataclasses.replace(self.config.task, action=action)
        other.config = check(dataclasses.replace(self.config, task=task))
        parts = {"config": to_dict(other.config), **describe(other.config, self.robot)}
        other.manifest = self.manifest | parts
        return other

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
            return heads.Additive(x @ kernel + bias, self.factors)
        out = np.concatenate((x, obs), axis=-1) @ kernel + bias
        return heads.Radial(out, self.profile, self.stretch, self.factors)


def _check_weights(
    weights: Mapping[str, np.ndarray], shapes: Mapping[str, tuple[int, ...]]
) -> None:
    if extra := sorted(set(weights) - set(shapes)):
        raise PolicyError(f"weight {quote(extra[0])} is none of this network's")
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
