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
from typing import Any

import numpy as np

from mjx_balance.config import Config, TaskConfig, preset
from mjx_balance.engines.mujoco import MujocoEngine
from mjx_balance.policy import Policy, make_manifest, save_policy
from mjx_balance.scene import Scene, load_scene
from mjx_balance.task import decision, tilt
from mjx_balance.task.actions import action_table
from mjx_balance.task.observation import observation_names

HIDDEN = (256, 256)
EXPLORE = 20_000
"""Decisions in which epsilon falls to its end, however long the run may be."""


def peer_config(seed: int) -> Config:
    """The task of preset `default`, and the network as the policy file has to know it."""
    default = preset("default")
    dqn = dataclasses.replace(default.dqn, head="joint", hidden_sizes=HIDDEN)
    return dataclasses.replace(default, seed=seed, engine="mujoco", dqn=dqn)


def draw_scenario(task: TaskConfig, rng: np.random.Generator) -> tilt.Scenario:
    """One scenario (1, ...) of training, drawn as `BalanceEnv` draws its own."""
    count = tilt.num_targets(task, task.episode_length * task.ctrl_dt)
    disc = tilt.disc_targets(np.asarray(task.max_incline), *rng.uniform(size=(2, count)))
    square = task.max_incline * rng.uniform(-1, 1, (count, 2))
    targets = np.where(rng.uniform(size=(count, 1)) < task.square_share, square, disc)
    targets[0] = 0
    phase = rng.uniform(size=1) * task.target_period
    return tilt.Scenario(targets[None], phase, np.full(1, task.board_rate))


class Board:
    """One robot on one board, with the arguments and results of a Gymnasium env."""

    def __init__(self, scene: Scene):
        """Nothing moves before `reset`."""
        self.scene, self.task = scene, scene.config.task
        self.table = action_table(self.task)
        self.engine = MujocoEngine(scene, 1, threads=1)

    def reset(self, scenario: tilt.Scenario) -> np.ndarray:
        """Starts from the settled stance; returns the observation (obs_size,)."""
        scene, stance = self.scene, self.scene.stance
        self.engine.place(stance.qpos, stance.qvel, stance.qacc_warmstart)
        self.scenario, self.decisions = scenario, 0
        self.memory = decision.start(self.task, scene.robot, stance.imu[None])
        angles = stance.qpos[None, scene.leg_qpos]
        obs = decision.observation(self.task, scene.robot, self.memory, angles)
        return obs[0].astype(np.float32)

    def step(self, action: int) -> tuple[np.ndarray, float, bool, bool, dict[str, Any]]:
        """Takes one decision: observation, reward, fallen, out of time, nothing else."""
        task, scene = self.task, self.scene
        now = np.full(1, float(self.decisions))
        memory, targets = decision.controls(
            task, scene.robot, self.memory, self.table[[action]], None, self.scenario, now
        )
        motion = self.engine.advance(np.arange(1), scene.ctrl(targets))
        angles = motion.qpos[:, -1, scene.leg_qpos]
        self.memory, outcome = decision.outcome(
            task, scene.robot, memory, motion.imu, motion.tilt, angles
        )
        self.decisions += 1
        fell = bool(outcome.fell[0] or motion.warned[0])
        late = not fell and self.decisions >= task.episode_length
        reward = float(sum(term[0] for term in outcome.rewards.values()))
        return outcome.obs[0].astype(np.float32), reward, fell, late, {}


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
    import gymnasium  # pyright: ignore[reportMissingImports]
    import torch  # pyright: ignore[reportMissingImports]
    from stable_baselines3 import DQN  # pyright: ignore[reportMissingImports]
    from stable_baselines3.common.callbacks import BaseCallback  # pyright: ignore[reportMissingImports]

    config = peer_config(seed)
    scene = load_scene(config)

    class Env(gymnasium.Env):
        def __init__(self) -> None:
            size = len(observation_names(config.task, scene.robot))
            self.observation_space = gymnasium.spaces.Box(-np.inf, np.inf, (size,))
            self.action_space = gymnasium.spaces.Discrete(config.task.num_actions)
            self.board = Board(scene)

        def reset(self, *, seed: int | None = None, options: dict[str, Any] | None = None):
            super().reset(seed=seed)
            return self.board.reset(draw_scenario(config.task, self.np_random)), {}

        def step(self, action):
            return self.board.step(int(action))

    class Checkpoints(BaseCallback):
        def _on_step(self) -> bool:
            if self.num_timesteps % every:
                return True
            state = self.model.policy.q_net.state_dict()
            layers = {name: value.detach().numpy() for name, value in state.items()}
            path = folder / f"{self.num_timesteps}.safetensors"
            to_policy(path, layers, config, scene.hash, self.num_timesteps)
            print(self.num_timesteps, flush=True)
            return bool(sys.stdin.readline())

    torch.set_num_threads(1)  # faster than two with layers of this size
    model = DQN(
        "MlpPolicy",
        Env(),
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
