"""Trains brax's PPO or SAC on `BalanceEnv` with continuous actions, and tries what it learnt.

python examples/train_brax.py [--algorithm sac] [--decisions 60000] [--seed 0] [--engine mjx]
"""

import argparse
import dataclasses
import functools
import time
from typing import Any

import flax.linen as nn
import jax
import jax.numpy as jnp
import numpy as np
from brax.training.agents.ppo import networks as ppo_networks
from brax.training.agents.ppo import train as ppo
from brax.training.agents.sac import networks as sac_networks
from brax.training.agents.sac import train as sac

from mjx_balance import BalanceEnv
from mjx_balance.config import preset
from mjx_balance.envs.brax import wrap
from mjx_balance.evaluation import rollout as evaluation
from mjx_balance.evaluation.controllers import Controller
from mjx_balance.evaluation.suites import HEADLINE, SEEDS

NARROW = (64, 64)
PPO = {
    "network_factory": functools.partial(
        ppo_networks.make_ppo_networks,
        policy_hidden_layer_sizes=NARROW,
        value_hidden_layer_sizes=NARROW,
        activation=nn.tanh,  # with brax's own, SiLU, it ends at three times the tilt
    ),
    "learning_rate_schedule": "ADAPTIVE_KL",  # a constant 1e-3 falls again after 20,000 decisions
    "learning_rate_schedule_max_lr": 1e-3,
    "num_envs": 128,
    "unroll_length": 8,
    "batch_size": 32,  # unrolls: 256 decisions
    "num_minibatches": 8,
    "num_updates_per_batch": 8,
    "gae_lambda": 0.5,
    "run_evals": False,
}
SAC = {
    "network_factory": functools.partial(sac_networks.make_sac_networks, hidden_layer_sizes=NARROW),
    "num_envs": 64,
    "grad_updates_per_step": 8,
    "min_replay_size": 2_048,
    "max_replay_size": 131_072,
    "reward_scaling": 30.0,  # against an entropy whose weight begins at 1
    "num_eval_envs": 1,
}
BOTH = {"learning_rate": 1e-3, "discounting": 0.1, "normalize_observations": True}  # the paper's
EPOCH = 2_048  #: decisions that a call of PPO's compiled program takes at least
TRAINERS = {"ppo": (ppo.train, PPO), "sac": (sac.train, SAC)}


def make_env(engine: str) -> BalanceEnv:
    """The task of preset `default`, continuous, over an engine."""
    return BalanceEnv(dataclasses.replace(preset("default"), engine=engine), "continuous")


def train(algorithm: str, env: BalanceEnv, decisions: int, seed: int, **more: Any) -> Any:
    """The policy (observations, key) -> (actions, ...) of "ppo" or "sac", trained."""
    trainer, own = TRAINERS[algorithm]
    length = env.config.task.episode_length
    options = {"episode_length": length, "wrap_env_fn": wrap, "seed": seed} | BOTH | own | more
    make_policy, params, _ = trainer(env, decisions, **options)
    return make_policy(params, deterministic=True)


def controller(env: BalanceEnv, policy: Any) -> Controller:
    """What an evaluation in plain MuJoCo asks for height changes, m."""
    key = jax.random.PRNGKey(0)  # a deterministic policy takes one too
    most = env.config.task.action_max
    return lambda view: most * np.asarray(policy(jnp.asarray(view.obs, jnp.float32), key)[0])


def main() -> None:
    """Trains as the command line says."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])  # pyright: ignore
    parser.add_argument("--algorithm", choices=TRAINERS, default="ppo")
    parser.add_argument("--decisions", type=int, default=60_000)
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--engine", choices=("mujoco", "mjx"), default="mujoco")
    args = parser.parse_args()
    env, began = make_env(args.engine), time.perf_counter()
    policy = train(args.algorithm, env, args.decisions, args.seed)
    print(f"{args.algorithm}, {time.perf_counter() - began:.0f} s, compiling included:")
    for suite in HEADLINE:
        acting = controller(env, policy)
        rollout = evaluation.run_suite(env.scene, acting, suite, 16, 60.0, SEEDS.held_out)
        fell = rollout.fell.sum()
        print(f"suite {suite}: {rollout.tilt.mean():.3f} deg mean tilt, {fell} of 16 fall")


if __name__ == "__main__":
    main()
