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
from stable_baselines3.common.env_util import make_vec_env  # pyright: ignore[reportMissingImports]

import mjx_balance

ENV = "mjx_balance/Balance-v0"
ACTION = {"dqn": "discrete", "ppo": "continuous"}
DECISIONS = {"dqn": 25_000, "ppo": 100_000}
HELD_OUT = 7_000_000
"""Seed of episodes that training, whose seeds are small, does not see."""


def train(algorithm: str, decisions: int, seed: int) -> Any:
    """A model of "dqn" or "ppo", trained."""
    torch.set_num_threads(1)  # faster than two with layers of this size
    keywords = {"action": ACTION[algorithm]}
    if algorithm == "dqn":
        model = DQN(
            "MlpPolicy",
            make_vec_env(ENV, env_kwargs=keywords),
            learning_rate=1e-3,
            learning_starts=1_000,
            batch_size=256,
            gamma=0.1,  # the paper's
            target_update_interval=1_000,
            exploration_fraction=min(1.0, 20_000 / decisions),
            policy_kwargs={"net_arch": [256, 256]},
            seed=seed,
            device="cpu",
        )
    else:
        model = PPO(
            "MlpPolicy",
            make_vec_env(ENV, n_envs=8, env_kwargs=keywords),
            learning_rate=lambda left: 1e-3 * left,
            n_steps=256,
            batch_size=256,
            gamma=0.1,
            gae_lambda=0.5,
            policy_kwargs={"log_std_init": -1.0},
            seed=seed,
            device="cpu",
        )
    return model.learn(decisions)


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
