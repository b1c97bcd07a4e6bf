"""stable-baselines3's DQN on one env of the same task, in MuJoCo's C engine: a peer.

A process of `time_to_balance.py`. After every few thousand decisions it writes the greedy policy
so far as a policy file of ours, prints the number of decisions, and waits for a line on its
standard input before it goes on; the end of the input ends it.

    python benchmarks/sb3_dqn.py FOLDER [--decisions 200000] [--every 5000] [--seed 0]
"""

import argparse
import dataclasses
import sys
from collections.abc import Mapping
from pathlib import Path

import numpy as np

from mjx_balance.config import Config, preset
from mjx_balance.envs.gym import BalanceGymEnv
from mjx_balance.policy.file import save_policy
from mjx_balance.policy.manifest import make_manifest
from mjx_balance.policy.network import Policy

HIDDEN = (256, 256)
EXPLORE = 20_000
"""Decisions in which epsilon falls to its end, however long the run may be."""


def peer_config(seed: int) -> Config:
    """The task of preset `default`, and the network as the policy file has to know it."""
    default = preset("default")
    dqn = dataclasses.replace(default.dqn, head="joint", hidden_sizes=HIDDEN)
    return dataclasses.replace(default, seed=seed, engine="mujoco", dqn=dqn)


def to_policy(
    path: Path, layers: Mapping[str, np.ndarray], config: Config, scene_hash: str, decisions: int
) -> Policy:
    """Writes the network as a policy file.

    Args:
      path: where to.
      layers: weights (out, in) and biases by torch's names, `q_net.0.weight` and so on: a
        linear layer, a ReLU, a linear layer, ...
      config: from `peer_config`.
      scene_hash: of the scene trained in.
      decisions: made so far.
    """
    names = [f"hidden_{k}" for k in range(len(HIDDEN))] + ["head"]
    params = {
        name: {
            "kernel": layers[f"q_net.{2 * k}.weight"].T,
            "bias": layers[f"q_net.{2 * k}.bias"],
        }
        for k, name in enumerate(names)
    }
    training = {"env_steps": decisions, "learner": "stable-baselines3 DQN"}
    return save_policy(path, {"params": params}, make_manifest(config, scene_hash, training))


def train(folder: Path, decisions: int, every: int, seed: int) -> None:
    """Trains, with a policy `DECISIONS.safetensors` after each `every` decisions."""
    import torch  # pyright: ignore[reportMissingImports]
    from stable_baselines3 import DQN  # pyright: ignore[reportMissingImports]
    from stable_baselines3.common.callbacks import BaseCallback  # pyright: ignore[reportMissingImports]

    config = peer_config(seed)
    env = BalanceGymEnv(config=config)
    scene_hash = env.boards.scene.hash

    class Checkpoints(BaseCallback):
        def _on_step(self) -> bool:
            if self.num_timesteps % every:
                return True
            state = self.model.policy.q_net.state_dict()
            layers = {name: value.detach().numpy() for name, value in state.items()}
            path = folder / f"{self.num_timesteps}.safetensors"
            to_policy(path, layers, config, scene_hash, self.num_timesteps)
            print(self.num_timesteps, flush=True)
            return bool(sys.stdin.readline())

    torch.set_num_threads(1)  # faster than two with layers of this size
    model = DQN(
        "MlpPolicy",
        env,
        learning_rate=1e-3,
        buffer_size=config.dqn.replay_capacity,
        learning_starts=1_000,
        batch_size=256,
        gamma=0.1,
        train_freq=4,
        gradient_steps=1,
        target_update_interval=1_000,
        exploration_fraction=min(1.0, EXPLORE / decisions),
        exploration_final_eps=0.05,
        policy_kwargs={"net_arch": list(HIDDEN)},
        seed=seed,
        device="cpu",
    )
    model.learn(decisions, callback=Checkpoints())


def main() -> None:
    """Trains as the command line says."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])  # pyright: ignore
    parser.add_argument("folder", type=Path, help="for the policies")
    parser.add_argument("--decisions", type=int, default=200_000)
    parser.add_argument("--every", type=int, default=5_000, help="decisions between two policies")
    parser.add_argument("--seed", type=int, default=0)
    args = parser.parse_args()
    train(args.folder, args.decisions, args.every, args.seed)


if __name__ == "__main__":
    main()
