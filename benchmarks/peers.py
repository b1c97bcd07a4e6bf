"""Other learners on the same task over MuJoCo's C engine: the peers of `time_to_balance.py`.

  sb3        stable-baselines3's DQN on one Gymnasium env, the same 441 actions;
  ppo, sac   brax's, two continuous actions, with the settings of `examples/train_brax.py`.
At every checkpoint the process prints its decisions so far, then the evaluations of its greedy
policy as a line of JSON, and waits for a line on its input; the end of the input ends it.

    python benchmarks/peers.py sb3 [--decisions 200000] [--every 5000]
"""

import argparse
import contextlib
import dataclasses
import functools
import json
import runpy
import sys
import tempfile
from collections.abc import Callable
from pathlib import Path
from typing import Any

import common
from common import REPO

from mjx_balance.config import preset
from mjx_balance.evaluation.controllers import Controller
from mjx_balance.evaluation.suites import HEADLINE
from mjx_balance.sim.scene import Scene, load_scene

EXPLORE = 20_000  # decisions of sb3 in which epsilon falls to its end, however long the run


def checkpoint(scenarios: int, decisions: int, scene: Scene, controller: Controller) -> None:
    """Reports a policy and waits; the clock of `time_to_balance.py` stands still meanwhile."""
    print(decisions, file=sys.__stdout__, flush=True)
    results = {
        suite: common.pooled([common.evaluated(scene, controller, suite, scenarios)])
        for suite in HEADLINE
    }
    print(json.dumps(results), file=sys.__stdout__, flush=True)
    if not sys.stdin.readline():
        raise SystemExit


def train_sb3(report: Callable[..., None], decisions: int, every: int) -> None:
    """Trains stable-baselines3's DQN; `report` takes decisions, scene and controller."""
    import torch  # pyright: ignore[reportMissingImports]
    from stable_baselines3 import DQN  # pyright: ignore[reportMissingImports]
    from stable_baselines3.common.callbacks import BaseCallback  # pyright: ignore[reportMissingImports]

    from mjx_balance.envs.gym import BalanceGymEnv

    config = dataclasses.replace(preset("default"), engine="mujoco")
    scene = load_scene(config)

    class Checkpoints(BaseCallback):
        def _on_step(self) -> bool:
            if self.num_timesteps % every == 0:
                greedy = functools.partial(self.model.predict, deterministic=True)
                report(self.num_timesteps, scene, lambda view: greedy(view.obs)[0])
            return True

    torch.set_num_threads(1)  # faster than two with layers of this size
    model = DQN(
        "MlpPolicy",
        BalanceGymEnv(config=config, action="discrete"),
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
        policy_kwargs={"net_arch": [256, 256]},
        seed=0,
        device="cpu",
    )
    model.learn(decisions, callback=Checkpoints())


def train_brax(name: str, report: Callable[..., None], decisions: int, every: int) -> None:
    """Trains brax's "ppo" or "sac"; as `train_sb3`."""
    import jax
    from brax.training.agents.sac import checkpoint as sac_checkpoint

    example = runpy.run_path(str(REPO / "examples" / "train_brax.py"))
    env = example["make_env"]("mujoco")

    def on_policy(made: int, policy: Any) -> None:
        if made:
            report(made, env.scene, example["controller"](env, policy))

    def on_params(made: int, make_policy: Any, params: Any) -> None:
        on_policy(made, make_policy(jax.device_get(params), deterministic=True))

    with tempfile.TemporaryDirectory() as folder:
        # SAC shows its parameters in files alone; those of PPO, brax 0.14 cannot read back.
        def on_progress(made: int, metrics: Any) -> None:
            path = Path(folder) / f"{made:012d}"
            if made:
                on_policy(made, sac_checkpoint.load_policy(str(path)))

        callbacks = {
            "ppo": {"policy_params_fn": on_params},
            "sac": {"checkpoint_logdir": folder, "progress_fn": on_progress},
        }
        num_evals = 1 + max(1, decisions // every)
        example["train"](name, env, decisions, 0, num_evals=num_evals, **callbacks[name])


PEERS = {
    "sb3": train_sb3,
    "ppo": functools.partial(train_brax, "ppo"),
    "sac": functools.partial(train_brax, "sac"),
}


def main() -> None:
    """Trains one peer."""
    parser = argparse.ArgumentParser(description=(__doc__ or "").splitlines()[0])
    parser.add_argument("peer", choices=PEERS)
    parser.add_argument("--decisions", type=int, default=200_000)
    parser.add_argument("--every", type=int, default=5_000, help="decisions between checkpoints")
    parser.add_argument("--scenarios", type=int, default=64, help="of each evaluation")
    args = parser.parse_args()
    with contextlib.redirect_stdout(sys.stderr):
        PEERS[args.peer](functools.partial(checkpoint, args.scenarios), args.decisions, args.every)


if __name__ == "__main__":
    main()
