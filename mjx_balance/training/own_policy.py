"""The greedy policy of a user's own network, which no policy file describes."""

from typing import Any

import jax
import numpy as np

from mjx_balance.config import Config, from_dict
from mjx_balance.dqn import DQN
from mjx_balance.dqn.dqn import Params
from mjx_balance.policy.manifest import PolicyError
from mjx_balance.robots.catalogue import Robot
from mjx_balance.task.actions import action_table


class OwnPolicy:
    """A greedy policy of any network, run by JAX in the process that has trained it.

    It has what evaluation needs of a `Policy`: `config`, `robot`, `scene_hash`, `manifest`,
    `actions`, the call, `q_values` and `command`; and `params`, the network's variables for raw
    observations (`dqn.networks.Whitened` if the config whitens them).
    """

    def __init__(self, learner: DQN, params: Params, manifest: dict[str, Any]):
        """Takes the exported parameters of one seed, and a manifest without a `network`.

        Raises:
          PolicyError: if a parameter is not finite.
        """
        if not all(np.isfinite(x).all() for x in jax.tree.leaves(params)):
            raise PolicyError("its parameters hold values that are not finite numbers")
        self.manifest = {name: x for name, x in manifest.items() if name != "network"}
        self.config = from_dict(Config, manifest["config"])
        self.robot = from_dict(Robot, manifest["robot"])
        self.scene_hash: str = manifest["scene_hash"]
        self.actions = action_table(self.config.task)
        self.params = params
        self.network = learner.network
        self.observation_size = len(manifest["inputs"])
        self._greedy = jax.jit(lambda params, obs: learner.head(params, obs).argmax())
        self._values = jax.jit(lambda params, obs: learner.head(params, obs).q_values())

    def __repr__(self) -> str:
        """What it is, in one line."""
        steps = self.manifest["training"]["env_steps"]
        return (
            f"OwnPolicy(network {type(self.network).__name__}, preset '{self.config.preset}' after "
            f"{steps:,} decisions, robot '{self.robot.name}', {self.observation_size} inputs)"
        )

    def q_values(self, obs: np.ndarray) -> np.ndarray:
        """Action values (num_actions,) of obs (obs_size,), or (batch, ...) of (batch, ...)."""
        return self._run(self._values, obs)

    def __call__(self, obs: np.ndarray) -> np.ndarray:
        """Best actions: indices, or with `config.task.action` "continuous" points in [-1, 1]^2."""
        return self._run(self._greedy, obs)

    def command(self, obs: np.ndarray) -> np.ndarray:
        """The height changes a_x and a_y that it commands, (2,) or (batch, 2), m."""
        action = self(obs)
        if self.config.task.action == "continuous":
            return action * self.actions.max(axis=0)
        return self.actions[action]

    def _run(self, function: Any, obs: np.ndarray) -> np.ndarray:
        """Runs on a batch that is padded to a power of two, so that few shapes are compiled."""
        obs = np.asarray(obs, np.float32)
        rows = np.atleast_2d(obs)
        size = 1 << (len(rows) - 1).bit_length()
        padded = np.pad(rows, ((0, size - len(rows)), (0, 0)))
        with jax.enable_x64(False):
            out = np.asarray(function(self.params, padded))[: len(rows)]
        return out if obs.ndim > 1 else out[0]
