"""Tiny brax environments whose action values are known."""

import jax
import jax.numpy as jnp
import numpy as np
from brax.envs.base import Env, State

from mjx_balance.config import DQNConfig
from mjx_balance.task.symmetry import Symmetries

CONFIG = DQNConfig(
    gamma=0.5,
    learning_rate=3e-3,
    learning_rate_end_share=0.1,
    batch_size=32,
    replay_ratio=8,
    replay_capacity=512,
    min_replay_size=16,
    target_update_period=20,
    epsilon_decay_steps=1_000,
    epsilon_end=0.3,
    hidden_sizes=(16,),
)
"""Learns the values of these environments in some hundred iterations."""


class Probe(Env):
    """Base: observation (1,), two actions."""

    @property
    def observation_size(self) -> int:
        return 1

    @property
    def action_size(self) -> int:
        return 2

    @property
    def backend(self) -> str:
        return "probe"

    def reset(self, rng: jax.Array) -> State:
        zero = jnp.float32(0.0)
        info = {"truncation": zero}
        return State(None, jnp.ones(1), zero, zero, {}, info)

    def _next(self, state: State, obs, reward, terminated, truncation=0.0) -> State:
        terminated, truncation = jnp.float32(terminated), jnp.float32(truncation)
        return state.replace(
            obs=jnp.full(1, obs, jnp.float32),
            reward=jnp.float32(reward),
            done=jnp.maximum(terminated, truncation),
            info=state.info | {"truncation": truncation},
        )


class OneStep(Probe):
    """Every step earns 1 and ends the episode: q = 1."""

    def step(self, state: State, action: jax.Array) -> State:
        return self._next(state, 1.0, 1.0, terminated=1.0)


class TwoSteps(Probe):
    """Observes 1, then 2; earns nothing, then 1: q(1) = gamma, q(2) = 1."""

    def step(self, state: State, action: jax.Array) -> State:
        second = jnp.asarray(state.obs)[0] - 1
        return self._next(state, 2 - second, second, terminated=second)


class ChooseRight(Probe):
    """Action 1 earns 1, action 0 loses 1: q = (-1, 1)."""

    def step(self, state: State, action: jax.Array) -> State:
        return self._next(state, 1.0, 2.0 * action - 1, terminated=1.0)


class TimeOut(Probe):
    """Earns 1 for ever, cut off after every step: q = 1 / (1 - gamma)."""

    def step(self, state: State, action: jax.Array) -> State:
        return self._next(state, 1.0, 1.0, terminated=0.0, truncation=1.0)


class NoisyState(Probe):
    """A random observation each step, reward its product with +-1 by action."""

    def reset(self, rng: jax.Array) -> State:
        state = super().reset(rng)
        return state.replace(obs=jax.random.uniform(rng, (1,), minval=-1.0))

    def step(self, state: State, action: jax.Array) -> State:
        return self._next(
            state, 0.0, jnp.asarray(state.obs)[0] * (2.0 * action - 1), terminated=1.0
        )


class PositiveState(NoisyState):
    """The same with observations above 0 alone; it says how it looks in a mirror."""

    symmetries = Symmetries(
        obs_index=np.zeros((2, 1), np.int32),
        obs_sign=np.asarray(((1.0,), (-1.0,)), np.float32),
        action_index=np.asarray(((0, 1), (1, 0)), np.int32),
    )

    def reset(self, rng: jax.Array) -> State:
        state = super().reset(rng)
        return state.replace(obs=jnp.abs(jnp.asarray(state.obs)))


class Walk(Probe):
    """Three steps of a walk that has a number: every observation says where it belongs.

    Observes (walk, steps taken); `walk` is drawn by the reset. Action a earns
    10 walk + steps + a / 2. The third step ends the walk, in a termination after action 1,
    by time after any other: the last observation, (walk, 3), is none of a reset.
    """

    @property
    def observation_size(self) -> int:
        return 2

    def reset(self, rng: jax.Array) -> State:
        state = super().reset(rng)
        return state.replace(
            obs=jnp.stack((jax.random.uniform(rng), 0.0)), metrics={"steps": jnp.float32(0.0)}
        )

    def step(self, state: State, action: jax.Array) -> State:
        walk, steps = jnp.asarray(state.obs)
        last = steps == 2
        ends, late = last & (action == 1), last & (action != 1)
        after = self._next(state, 0.0, 10 * walk + steps + action / 2, ends, late)
        obs = jnp.stack((walk, steps + 1))
        return after.replace(obs=obs, metrics={"steps": steps + 1})


class Turn(Probe):
    """Two numbers turn, every third state or so ends: for comparison with a second learner."""

    @property
    def observation_size(self) -> int:
        return 2

    def reset(self, rng: jax.Array) -> State:
        state = super().reset(rng)
        return state.replace(obs=jax.random.uniform(rng, (2,), minval=-1.0))

    def step(self, state: State, action: jax.Array) -> State:
        x, y = jnp.asarray(state.obs)
        after = self._next(state, 0.0, x * (2.0 * action - 1) + 0.3, terminated=y > 0.3)
        return after.replace(obs=jnp.stack((0.8 * y + 0.4, 0.5 - x)))


class Fork(TwoSteps):
    """As TwoSteps, but the second step earns 1 by action 1 and loses 1 by action 0.

    What the first step is worth depends on how the values of the second are bootstrapped:
    while the target network is still the initial one, on that network alone.
    """

    def step(self, state: State, action: jax.Array) -> State:
        second = jnp.asarray(state.obs)[0] - 1
        return self._next(state, 2 - second, second * (2.0 * action - 1), terminated=second)


class NoTimeLimit(NoisyState):
    """An env of other people's: no truncation, nothing but what brax asks for."""

    def reset(self, rng: jax.Array) -> State:
        return super().reset(rng).replace(info={})

    def step(self, state: State, action: jax.Array) -> State:
        return super().step(state, action).replace(info={})


class Faulty(NoisyState):
    """As NoisyState, but some steps show something that is not a finite number.

    Observations carry a second number, 1 in envs that can fail; resets make those alone.

    Args:
      faults: what is shown by an observation, a reward, by done or by the observation of a
        reset, each at its own random steps.
      rate: share of the steps in which each happens.
    """

    def __init__(self, faults: dict[str, float], rate: float):
        self.faults, self.rate = faults, rate

    @property
    def observation_size(self) -> int:
        return 2

    def reset(self, rng: jax.Array) -> State:
        key_obs, key_fault, key = jax.random.split(rng, 3)
        obs = jnp.stack((jnp.asarray(super().reset(key_obs).obs)[0], 1.0))
        obs = self._spoilt("reset", key_fault, obs, obs[1])
        state = super().reset(rng)
        metrics = {"mine": jnp.float32(1.0)}
        return state.replace(obs=obs, info=state.info | {"key": key}, metrics=metrics)

    def step(self, state: State, action: jax.Array) -> State:
        keys = jax.random.split(state.info["key"], 4)
        x, able = jnp.asarray(state.obs)
        after = self._next(state, 0.0, x * (2.0 * action - 1), terminated=1.0)
        return after.replace(
            obs=self._spoilt("obs", keys[0], jnp.stack((0 * x, able)), able),
            reward=self._spoilt("reward", keys[1], after.reward, able),
            done=self._spoilt("done", keys[2], after.done, able),
            info=after.info | {"key": keys[3]},
        )

    def _spoilt(self, where: str, key: jax.Array, value: jax.Array, able: jax.Array) -> jax.Array:
        if where not in self.faults:
            return value
        return jnp.where(able * jax.random.bernoulli(key, self.rate), self.faults[where], value)
