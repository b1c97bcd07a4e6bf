"""A second DQN, in NumPy and by hand, for a replay of one row per device.

A device whose ring holds a single row trains on that row alone, whatever it draws: what
one step of the learner makes of its parameters can then be computed from the rows.
"""

import dataclasses
from collections.abc import Mapping
from typing import Any

import numpy as np

from mjx_balance.config import DQNConfig

BETA_1, BETA_2, TINY = 0.9, 0.999, 1e-8
RECENCY = 4.0
Layers = dict[str, dict[str, np.ndarray]]


def exact(params: Mapping[str, Any]) -> Layers:
    """A flax network's layers in double precision."""
    layers = params["params"]
    return {
        layer: {name: np.asarray(x, np.float64) for name, x in value.items()}
        for layer, value in layers.items()
    }


@dataclasses.dataclass
class Reference:
    """Follows a learner's rows; `params` and `target` are what it should have."""

    config: DQNConfig
    params: Layers
    total_steps: int

    def __post_init__(self) -> None:
        size = len(self.params["hidden_0"]["kernel"])
        self.first = {layer: zeros(value) for layer, value in self.params.items()}
        self.second = copied(self.first)
        self.steps = 0
        self.mean, self.covariance, self.batches = np.zeros(size), np.eye(size), 0
        self.synchronise()

    def observe(self, obs: np.ndarray, env_steps: int) -> None:
        """Takes observations (n, obs_size) into the statistics, as long as it should."""
        if env_steps >= self.config.whiten_steps:
            return
        weight = RECENCY / (self.batches + RECENCY)
        away = obs.mean(axis=0) - self.mean
        spread = np.atleast_2d(np.cov(obs.T, bias=True))
        self.covariance = (
            (1 - weight) * self.covariance
            + weight * spread
            + weight * (1 - weight) * np.outer(away, away)
        )
        self.mean = self.mean + weight * away
        self.batches += 1

    def synchronise(self) -> None:
        """The target is a copy of the network as it is now, its whitening included."""
        self.target, self.target_moments = copied(self.params), (self.mean, self.covariance)

    def white(self, obs: np.ndarray, moments: Any = None) -> np.ndarray:
        """Observations as the network takes them."""
        if not self.config.whiten_steps:
            return obs
        mean, covariance = moments or (self.mean, self.covariance)
        values, vectors = np.linalg.eigh(covariance)
        scale = np.diag((values + self.config.whiten_floor) ** -0.5)
        return (obs - mean) @ vectors @ scale @ vectors.T

    def choose(self, obs: np.ndarray) -> np.ndarray:
        """Greedy actions (n,) for observations (n, obs_size)."""
        return values(self.params, self.white(obs)).argmax(axis=1)

    def learn(self, rows: Any) -> float:
        """One gradient step on rows (n, ...) of which each counts the same; returns the loss."""
        config, count = self.config, len(rows.action)
        each = np.arange(count)
        q_t = values(self.target, self.white(rows.next_obs, self.target_moments))
        chooser = values(self.params, self.white(rows.next_obs)) if config.double else q_t
        best = q_t[each, chooser.argmax(axis=1)]
        wanted = rows.reward + config.gamma * np.where(rows.terminated, 0.0, best)
        obs = self.white(rows.obs)
        error = values(self.params, obs)[each, rows.action] - wanted
        by_output = np.zeros((count, 2))
        by_output[each, rows.action] = 2 * error / count
        self.descend(gradient(self.params, obs, by_output))
        self.steps += 1
        if self.steps % config.target_update_period == 0:
            self.synchronise()
        return float(np.mean(error**2))

    def descend(self, grads: Layers) -> None:
        """Adam (Kingma & Ba 2015, algorithm 1) on the clipped gradient."""
        config = self.config
        norm = np.sqrt(sum(float((x**2).sum()) for g in grads.values() for x in g.values()))
        scale = min(1.0, config.max_grad_norm / norm)
        done = min(self.steps / self.total_steps, 1.0)
        start, end = config.learning_rate, config.learning_rate * config.learning_rate_end_share
        rate = end + (start - end) * (1 + np.cos(np.pi * done)) / 2
        for layer, value in self.params.items():
            for name in value:
                g = scale * grads[layer][name]
                m = self.first[layer][name] = BETA_1 * self.first[layer][name] + (1 - BETA_1) * g
                v = self.second[layer][name] = (
                    BETA_2 * self.second[layer][name] + (1 - BETA_2) * g**2
                )
                m_hat = m / (1 - BETA_1 ** (self.steps + 1))
                v_hat = v / (1 - BETA_2 ** (self.steps + 1))
                value[name] = value[name] - rate * m_hat / (np.sqrt(v_hat) + TINY)


def values(layers: Layers, obs: np.ndarray) -> np.ndarray:
    """Of a network with one hidden layer, (n, num_actions)."""
    hidden = np.maximum(obs @ layers["hidden_0"]["kernel"] + layers["hidden_0"]["bias"], 0)
    return hidden @ layers["head"]["kernel"] + layers["head"]["bias"]


def gradient(layers: Layers, obs: np.ndarray, by_output: np.ndarray) -> Layers:
    """Backpropagates (n, num_actions) through it."""
    before = obs @ layers["hidden_0"]["kernel"] + layers["hidden_0"]["bias"]
    by_hidden = by_output @ layers["head"]["kernel"].T * (before > 0)
    return {
        "hidden_0": {"kernel": obs.T @ by_hidden, "bias": by_hidden.sum(axis=0)},
        "head": {"kernel": np.maximum(before, 0).T @ by_output, "bias": by_output.sum(axis=0)},
    }


def zeros(layer: dict[str, np.ndarray]) -> dict[str, np.ndarray]:
    return {name: np.zeros_like(x) for name, x in layer.items()}


def copied(layers: Layers) -> Layers:
    return {layer: {name: x.copy() for name, x in value.items()} for layer, value in layers.items()}
