"""Trains the DQN of `mjx_balance/dqn`, which knows no robot, on brax's inverted pendulum.

python examples/dqn_on_brax.py [--decisions 60000] [--seed 0]
"""

import argparse
import time

import jax
import jax.numpy as jnp
from brax.envs.base import Env, State, Wrapper
from brax.envs.inverted_pendulum import InvertedPendulum
from brax.envs.wrappers.training import EpisodeWrapper

from mjx_balance.config import DQNConfig
from mjx_balance.dqn import DQN, DQNSpec, QNetwork, TrainState

FORCES = jnp.array([[-0.3], [-0.05], [0.0], [0.05], [0.3]])
"""What each of the discrete actions is to the pendulum, which takes -1 to 1."""
EPISODE = 1_000
"""Decisions of an episode, each of which earns 1 until the pole is 0.2 rad off."""
CONFIG = DQNConfig(
    gamma=0.97,
    learning_rate=1e-3,
    replay_ratio=64,
    batch_size=256,
    replay_capacity=100_000,
    min_replay_size=2_000,
    target_update_period=200,
    epsilon_decay_steps=20_000,
    hidden_sizes=(64, 64),
)
DECISIONS = 60_000


class Discrete(Wrapper):
    """An env whose action is the index of a force."""

    @property
    def action_size(self) -> int:
        return len(FORCES)

    def step(self, state: State, action: jax.Array) -> State:
        return self.env.step(state, FORCES[action])


def pendulum() -> Env:
    """One pendulum; `EpisodeWrapper` sets its time limit, and `info["truncation"]` with it."""
    return EpisodeWrapper(Discrete(InvertedPendulum()), EPISODE, action_repeat=1)


def train(env: Env, decisions: int, seed: int, num_envs: int = 64) -> tuple[DQN, TrainState]:
    """A DQN and the state at the end of its run."""
    network = QNetwork(CONFIG.hidden_sizes, (env.action_size,))
    # One device: another number of devices draws other random numbers.
    spec = DQNSpec(CONFIG, num_envs, num_env_steps=decisions, devices=jax.devices()[:1])
    dqn = DQN(env, network, spec)
    state, _ = dqn.train_program(decisions // num_envs)(dqn.init(seed))
    return dqn, state


def held_out(dqn: DQN, state: TrainState, episodes: int = 64) -> jax.Array:
    """(episodes,) decisions for which the greedy policy keeps the pole up."""
    env, params = dqn.env, dqn.export_params(state)

    def step(carry: tuple[State, jax.Array], _: None) -> tuple[tuple[State, jax.Array], jax.Array]:
        env_state, up = carry
        values = jnp.asarray(dqn.network.apply(params, env_state.obs))
        best = values.argmax(axis=-1)
        env_state = jax.vmap(env.step)(env_state, best)
        up &= ~((env_state.done > 0) & (env_state.info["truncation"] == 0))
        return (env_state, up), up

    start = jax.vmap(env.reset)(jax.random.split(jax.random.PRNGKey(7_000_000), episodes))
    alive = jnp.full(episodes, True)
    return jax.jit(lambda: jax.lax.scan(step, (start, alive), length=EPISODE))()[1].sum(axis=0)


def main() -> None:
    """Trains as the command line says."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])  # pyright: ignore
    parser.add_argument("--decisions", type=int, default=DECISIONS)
    parser.add_argument("--seed", type=int, default=0)
    args = parser.parse_args()
    began = time.perf_counter()
    dqn, state = train(pendulum(), args.decisions, args.seed)
    up = held_out(dqn, state)
    seconds = time.perf_counter() - began
    print(f"{seconds:.0f} s: up for {up.mean():.0f} of {EPISODE} decisions, at least {up.min()}")


if __name__ == "__main__":
    main()
