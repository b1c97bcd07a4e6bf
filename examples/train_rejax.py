"""Trains rejax's DQN, PQN, SAC or PPO on `BalanceEnv`, and tries what it learnt.

pip install rejax==0.1.3    # in an environment of its own: gymnax wants an older Gymnasium
python examples/train_rejax.py [--algorithm sac] [--decisions 60000] [--seed 0] [--engine mjx]
"""

import argparse
import dataclasses
import time
from collections.abc import Callable
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import optax
from brax.envs.base import State

from mjx_balance import BalanceEnv
from mjx_balance.config import preset
from mjx_balance.evaluation import rollout as evaluation
from mjx_balance.evaluation.controllers import Controller
from mjx_balance.evaluation.suites import HEADLINE, SEEDS

SETTINGS: dict[str, dict[str, Any]] = {
    "dqn": {
        "num_envs": 64,
        "num_epochs": 8,
        "buffer_size": 16_384,  # a sample costs a sort of the whole buffer
        "fill_buffer": 1_024,
        "batch_size": 256,
        "target_update_freq": 12_800,
        "polyak": 0.0,
        "normalize_observations": True,
    },
    "pqn": {
        "num_envs": 64,
        "num_steps": 4,
        "num_minibatches": 1,
        "num_epochs": 8,
        "td_lambda": 0.0,
    },
    "sac": {
        "num_envs": 64,
        "num_epochs": 8,
        "buffer_size": 16_384,
        "fill_buffer": 1_024,
        "batch_size": 256,
        "polyak": 0.95,
        "normalize_observations": True,
        "reward_scale": 30.0,  # against an entropy whose weight begins at 1
    },
    "ppo": {
        "num_envs": 64,
        "num_steps": 32,
        "num_minibatches": 8,
        "num_epochs": 8,
        "gae_lambda": 0.5,
        "ent_coef": 0.0,
        "agent_kwargs": {"activation": "tanh"},
        "normalize_observations": True,
    },
}
BOTH = {"learning_rate": 1e-3, "gamma": 0.1}
WIDTHS = {"dqn": (256, 256), "pqn": (256, 256)}  # rejax takes no flag for these
CHUNK = 1_024  #: decisions per call of the compiled program


class GymnaxEnv:
    """`BalanceEnv` as gymnax' learners want it: a step starts the next episode by itself.

    gymnax has one word for a fall and for the time limit, `done`, after which rejax takes the
    state for worthless. So `done` is a fall alone; after the time limit the next value is that of
    the next episode's start, a level robot's as well.
    """

    default_params = None

    def __init__(self, env: BalanceEnv, reward_scale: float = 1.0):
        """Takes an env of either action; rewards are multiplied by `reward_scale`."""
        self.env, self.reward_scale = env, reward_scale

    def reset(self, key: jax.Array, params: Any = None) -> tuple[Any, State]:
        """Observation and state of an episode; the first ones do not all end at once."""
        state = self.env.reset_staggered(key)
        return state.obs, state

    def step(
        self, key: jax.Array, state: State, action: jax.Array, params: Any = None
    ) -> tuple[Any, State, jax.Array, jax.Array, dict[str, Any]]:
        """Observation, state, reward, whether the robot fell, and nothing."""
        after, start = self.env.step(state, action), self.env.reset(key)
        over = after.done > 0
        state = jax.tree.map(lambda new, old: jnp.where(over, new, old), start, after)
        fell = over & (after.info["truncation"] == 0)
        return state.obs, state, self.reward_scale * after.reward, fell, {}

    def action_space(self, params: Any = None) -> Any:
        """441 actions, or two shares."""
        from gymnax.environments import spaces  # pyright: ignore[reportMissingImports]

        if self.env.continuous:
            return spaces.Box(-1.0, 1.0, (self.env.action_size,))
        return spaces.Discrete(self.env.action_size)

    def observation_space(self, params: Any = None) -> Any:
        """Any numbers."""
        from gymnax.environments import spaces  # pyright: ignore[reportMissingImports]

        return spaces.Box(-jnp.inf, jnp.inf, (self.env.observation_size,))


def make_env(algorithm: str, engine: str) -> BalanceEnv:
    """The task of preset `default` over an engine, with the actions that the algorithm takes."""
    action = "discrete" if algorithm in WIDTHS else "continuous"
    return BalanceEnv(dataclasses.replace(preset("default"), engine=engine), action)


def make(algorithm: str, env: BalanceEnv, decisions: int, **more: Any) -> Any:
    """A learner, "dqn", "pqn", "sac" or "ppo", for a run of so many decisions."""
    import rejax  # pyright: ignore[reportMissingImports]

    options: dict[str, Any] = BOTH | SETTINGS[algorithm] | {"total_timesteps": decisions} | more
    each = options["num_envs"] * options.get("num_steps", 1)
    updates = decisions // each * options["num_epochs"] * options.get("num_minibatches", 1)
    learning_rate: float = options["learning_rate"]
    options["learning_rate"] = optax.linear_schedule(learning_rate, 0.0, int(updates))
    widths = options.pop("widths", WIDTHS.get(algorithm))
    adapter = GymnaxEnv(env, options.pop("reward_scale", 1.0))
    learner = rejax.get_algo(algorithm).create(env=adapter, **options)
    if widths:
        learner = learner.replace(agent=learner.agent.clone(hidden_layer_sizes=widths))
    return learner


def train(
    learner: Any, seed: int, log_fn: Callable[[int, Any], None] = lambda decisions, state: None
) -> Any:
    """The state after the run; `log_fn` gets the decisions so far and the state."""
    each = learner.num_envs * getattr(learner, "num_steps", 1)

    @jax.jit
    def chunk(state: Any) -> Any:
        def body(_: int, state: Any) -> Any:
            return learner.train_iteration(state)

        return jax.lax.fori_loop(0, max(1, CHUNK // each), body, state)

    state = jax.jit(learner.init_state)(jax.random.PRNGKey(seed))
    # rejax begins with Python's numbers, for whose types the first call would be compiled alone.
    rewards = jax.tree.map(jnp.float32, state.rew_rms_state)
    state = state.replace(rew_rms_state=rewards)
    state = jax.tree.map(lambda x: jax.lax.convert_element_type(x, x.dtype), state)
    while (decisions := int(state.global_step)) < learner.total_timesteps:
        if decisions:
            log_fn(decisions, state)
        state = chunk(state)
    log_fn(decisions, state)
    return state


def policy_state(state: Any) -> dict[str, Any]:
    """What `greedy` reads of a state."""
    names = ("q_ts", "actor_ts")
    params = next(getattr(state, name).params for name in names if hasattr(state, name))
    return {"params": params, "rms": state.obs_rms_state}


def greedy(learner: Any) -> Callable[[Any, jax.Array], jax.Array]:
    """A compiled function of `policy_state` and observations (n, obs_size): actions, no noise."""

    @jax.jit
    def act(policy: dict[str, Any], obs: jax.Array) -> jax.Array:
        params = policy["params"]
        if learner.normalize_observations:
            obs = learner.normalize_obs(policy["rms"], obs)
        if learner.discrete:
            return learner.agent.apply(params, obs).argmax(axis=-1)
        mean = learner.actor.apply(params, obs, method="_action_dist").mean()
        return jnp.tanh(mean) if hasattr(learner.actor, "bij") else jnp.clip(mean, -1.0, 1.0)

    return act


def controller(env: BalanceEnv, act: Callable[[jax.Array], jax.Array]) -> Controller:
    """What an evaluation in plain MuJoCo asks for action indices, or height changes, m."""
    scale = env.config.task.action_max if env.continuous else 1
    return lambda view: scale * np.asarray(act(jnp.asarray(view.obs, jnp.float32)))


def main() -> None:
    """Trains as the command line says."""
    parser = argparse.ArgumentParser(description=(__doc__ or "").splitlines()[0])
    parser.add_argument("--algorithm", choices=SETTINGS, default="sac")
    parser.add_argument("--decisions", type=int, default=60_000)
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--engine", choices=("mujoco", "mjx"), default="mujoco")
    args = parser.parse_args()
    env, began = make_env(args.algorithm, args.engine), time.perf_counter()
    learner = make(args.algorithm, env, args.decisions)
    policy = policy_state(train(learner, args.seed))
    print(f"{args.algorithm}, {time.perf_counter() - began:.0f} s, compiling included:")
    act = greedy(learner)
    for suite in HEADLINE:
        acting = controller(env, lambda obs: act(policy, obs))
        rollout = evaluation.run_suite(env.scene, acting, suite, 16, 60.0, SEEDS.held_out)
        print(f"suite {suite}: {rollout.tilt.mean():.3f} deg mean tilt, {rollout.fell.sum()} fall")


if __name__ == "__main__":
    main()
