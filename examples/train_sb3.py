"""Trains stable-baselines3's DQN, or its PPO with continuous actions, and tries what it learnt.

pip install -e ".[gym]" stable-baselines3
python examples/train_sb3.py [--algorithm ppo] [--decisions 100000] [--seed 0]
"""

import argparse
import time
from typing import Any

import gymnasium
import numpy as np
import torch  # pyright: ignore[reportMissingImports]
from stable_baselines3 import DQN, PPO  # pyright: ignore[reportMissingImports]
from stable_baselines3.common.vec_env import VecEnv  # pyright: ignore[reportMissingImports]

import mjx_balance

ENV = "mjx_balance/Balance-v0"
ACTION = {"dqn": "discrete", "ppo": "continuous"}
DECISIONS = {"dqn": 25_000, "ppo": 100_000}
HELD_OUT = 7_000_000
"""Seed of episodes that training, whose seeds are small, does not see."""
DQN_SETTINGS: dict[str, Any] = {
    "num_envs": 8,
    "learning_rate": 1e-3,
    "learning_starts": 1_000,
    "batch_size": 256,
    "train_freq": 1,
    "gradient_steps": 2,
    "target_update_interval": 1_000,
    "explore": 20_000,  # decisions until epsilon is down
    "policy_kwargs": {"net_arch": [256, 256]},
}
PPO_SETTINGS: dict[str, Any] = {
    "num_envs": 8,
    "learning_rate": 1e-3,
    "n_steps": 256,
    "batch_size": 256,
    "gae_lambda": 0.5,
    "policy_kwargs": {"log_std_init": -1.0},
}


class Envs(VecEnv):
    """Our vector env as stable-baselines3 wants one: one call steps all, on all cores.

    Its own `make_vec_env` calls one env after the other.
    """

    def __init__(self, num_envs: int, action: str):
        """Makes the envs; `action` is "discrete" or "continuous"."""
        self.envs: Any = gymnasium.make_vec(ENV, num_envs=num_envs, action=action).unwrapped
        own = self.envs
        super().__init__(num_envs, own.single_observation_space, own.single_action_space)

    def reset(self) -> np.ndarray:
        """The first observations."""
        return self.envs.reset(seed=self._seeds)[0]

    def step_async(self, actions: np.ndarray) -> None:
        """Takes the actions of the next step."""
        self._actions = actions

    def step_wait(self) -> Any:
        """Steps all; of an episode that is over, `infos` has the last observation."""
        obs, rewards, fell, late, more = self.envs.step(self._actions)
        infos: list[dict[str, Any]] = [{} for _ in range(self.num_envs)]
        for k in np.flatnonzero(fell | late):
            last = more["final_obs"][k]
            infos[k] = {"terminal_observation": last, "TimeLimit.truncated": bool(late[k])}
        return obs, rewards.astype(np.float32), fell | late, infos

    def close(self) -> None:
        """Ends the envs."""
        self.envs.close()

    def get_attr(self, attr_name: str, indices: Any = None) -> list[Any]:
        """An attribute, the same for all envs."""
        return [getattr(self.envs, attr_name)] * len(list(self._get_indices(indices)))

    def set_attr(self, attr_name: str, value: Any, indices: Any = None) -> None:
        """Sets an attribute of all envs."""
        setattr(self.envs, attr_name, value)

    def env_method(self, method_name: str, *args: Any, **kwargs: Any) -> list[Any]:
        """No method is of a single env.

        Raises:
          NotImplementedError: always.
        """
        raise NotImplementedError(method_name)

    def env_is_wrapped(self, wrapper_class: Any, indices: Any = None) -> list[bool]:
        """None is."""
        return [False] * len(list(self._get_indices(indices)))


def make(algorithm: str, decisions: int, seed: int, **more: Any) -> Any:
    """A model of "dqn" or "ppo" for a run of so many decisions."""
    torch.set_num_threads(1)  # faster than two with layers of this size
    own = (DQN_SETTINGS if algorithm == "dqn" else PPO_SETTINGS) | more
    envs = Envs(own.pop("num_envs"), ACTION[algorithm])
    if algorithm == "dqn":
        own["exploration_fraction"] = min(1.0, own.pop("explore") / decisions)
    learning_rate = own.pop("learning_rate")
    return (DQN if algorithm == "dqn" else PPO)(
        "MlpPolicy",
        envs,
        learning_rate=lambda left: learning_rate * left,
        gamma=0.1,  # the paper's
        seed=seed,
        device="cpu",
        **own,
    )


def train(algorithm: str, decisions: int, seed: int) -> Any:
    """A model of "dqn" or "ppo", trained."""
    return make(algorithm, decisions, seed).learn(decisions)


def held_out(model: Any, algorithm: str, episodes: int = 16) -> tuple[float, int]:
    """Mean tilt over episodes, deg, the time after a fall left out, and how many fall."""
    envs = gymnasium.make_vec(ENV, num_envs=episodes, action=ACTION[algorithm])
    obs, _ = envs.reset(seed=HELD_OUT)
    under_way = np.full(episodes, True)
    tilts, falls = [], 0
    while under_way.any():
        action, _ = model.predict(obs, deterministic=True)
        obs, _, fell, late, info = envs.step(action)
        # Of an episode that has just ended, final_info tells: a new one has begun.
        last = info["final_info"]["tilt_deg"] if "final_info" in info else 0.0
        tilts.append((info["tilt_deg"] + last)[under_way])
        falls += int((fell & under_way).sum())
        under_way &= ~(fell | late)
    envs.close()
    return float(np.concatenate(tilts).mean()), falls


def main() -> None:
    """Trains as the command line says."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])  # pyright: ignore
    parser.add_argument("--algorithm", choices=ACTION, default="dqn")
    parser.add_argument("--decisions", type=int)
    parser.add_argument("--seed", type=int, default=0)
    args = parser.parse_args()
    gymnasium.register_envs(mjx_balance)
    began = time.perf_counter()
    model = train(args.algorithm, args.decisions or DECISIONS[args.algorithm], args.seed)
    seconds = time.perf_counter() - began
    tilt, falls = held_out(model, args.algorithm)
    print(f"{args.algorithm}, {seconds:.0f} s: {tilt:.3f} deg mean tilt, {falls} of 16 fall")


if __name__ == "__main__":
    main()
