"""The DQN as one program: act, step, store, sample, update, over all envs and devices.

Envs and replay are sharded over a one-axis device mesh, parameters replicated:
each device steps its own envs, fills its own part of the replay and samples its
own share of every batch; gradients are averaged. On a laptop the devices are CPU
cores, elsewhere accelerators; the program is the same.
"""

from collections.abc import Sequence
from typing import Any, NamedTuple, TypeAlias

import flax.linen as nn
import jax
import jax.numpy as jnp
import numpy as np
import optax
from brax.envs.base import Env, Observation, State
from jax.sharding import AxisType, Mesh, PartitionSpec

from mjx_balance.config import DQNConfig
from mjx_balance.dqn import replay
from mjx_balance.dqn.losses import td_error
from mjx_balance.dqn.replay import ReplayState, Transition

AXIS = "devices"
REPLICATED, SHARDED = PartitionSpec(), PartitionSpec(AXIS)

Metrics: TypeAlias = dict[str, jax.Array]
Params: TypeAlias = Any
"""The network's variables, a flax pytree."""


class TrainState(NamedTuple):
    """Everything a run is made of: saving it saves the run."""

    params: Params
    target_params: Params
    opt_state: optax.OptState
    env_state: State
    """(num_envs, ...) per leaf, sharded."""
    replay: ReplayState
    """data sharded; position and size count one device's rows."""
    env_steps: jax.Array
    """() decisions taken, over all envs."""
    gradient_steps: jax.Array
    """() updates made."""
    key: jax.Array
    """PRNG key, the same on every device."""


def epsilon(config: DQNConfig, env_steps: jax.Array) -> jax.Array:
    """Share of random actions: linear from epsilon_start to epsilon_end, then flat.

    epsilon = start + (end - start) * min(env_steps / epsilon_decay_steps, 1)
    """
    share = jnp.minimum(env_steps / config.epsilon_decay_steps, 1.0)
    return config.epsilon_start + (config.epsilon_end - config.epsilon_start) * share


def epsilon_greedy(key: jax.Array, q_values: jax.Array, rate: jax.Array) -> jax.Array:
    """Action indices () for values (num_actions,): uniform with probability `rate`."""
    key_which, key_random = jax.random.split(key)
    random = jax.random.randint(key_random, (), 0, q_values.shape[-1])
    greedy = jnp.argmax(q_values, axis=-1).astype(random.dtype)
    return jnp.where(jax.random.bernoulli(key_which, rate), random, greedy)


def make_optimizer(config: DQNConfig, gradient_steps: int) -> optax.GradientTransformation:
    """Adam with clipped gradients and a cosine from learning_rate to learning_rate_end."""
    schedule = optax.cosine_decay_schedule(
        config.learning_rate,
        max(gradient_steps, 1),
        config.learning_rate_end / config.learning_rate,
    )
    return optax.chain(optax.clip_by_global_norm(config.max_grad_norm), optax.adam(schedule))


class Learner:
    """Trains a Q-network on a brax env whose `action_size` counts discrete actions."""

    def __init__(
        self,
        env: Env,
        network: nn.Module,
        config: DQNConfig,
        num_envs: int,
        num_env_steps: int,
        devices: Sequence[Any] | None = None,
    ):
        """Sets the programs up; nothing is compiled yet.

        Args:
          env: unbatched env; `info["truncation"]`, where it has one, marks time-outs.
          network: maps (..., obs_size) to (..., action_size).
          config: the algorithm.
          num_envs: envs over all devices.
          num_env_steps: length of the run, for the schedules.
          devices: the mesh; all local devices if none.

        Raises:
          ValueError: if num_envs or batch_size cannot be split over the devices.
        """
        devices = list(devices or jax.devices())
        for name, value in (("num_envs", num_envs), ("batch_size", config.batch_size)):
            if value % len(devices):
                raise ValueError(
                    f"{name} is {value}; it must be a multiple of the {len(devices)} devices"
                )
        self.env, self.network, self.config = env, network, config
        self.num_envs, self.num_devices = num_envs, len(devices)
        self.iterations = -(-num_env_steps // num_envs)
        self.optimizer = make_optimizer(config, self.iterations * config.updates_per_step)
        self.mesh = Mesh(np.asarray(devices), (AXIS,), axis_types=(AxisType.Auto,))
        self.trace_count = 0
        specs: dict[str, Any] = dict.fromkeys(TrainState._fields, REPLICATED)
        replay_specs: list[Any] = [SHARDED, REPLICATED, REPLICATED]
        specs |= {"env_state": SHARDED, "replay": ReplayState(*replay_specs)}
        self.specs = TrainState(**specs)

    def init(self, seed: int) -> TrainState:
        """Builds the state of a new run, on its devices."""
        program = jax.shard_map(
            self._init, mesh=self.mesh, in_specs=REPLICATED, out_specs=self.specs, check_vma=False
        )
        return jax.jit(program)(jax.random.PRNGKey(seed))

    def train_program(self, iterations: int):
        """The jitted training program: state -> (state, metrics), the state donated.

        Args:
          iterations: decisions of every env per call.
        """

        def program(state: TrainState) -> tuple[TrainState, Metrics]:
            self.trace_count += 1
            state, metrics = jax.lax.scan(self.iteration, state, length=iterations)
            return state, jax.tree.map(lambda x: x.mean(), metrics)

        return jax.jit(
            jax.shard_map(
                program,
                mesh=self.mesh,
                in_specs=(self.specs,),
                out_specs=(self.specs, REPLICATED),
                check_vma=False,
            ),
            donate_argnums=0,
        )

    def _init(self, key: jax.Array) -> TrainState:
        key, key_params, key_env = jax.random.split(key, 3)
        local_envs = self.num_envs // self.num_devices
        env_state = self._reset(self._device_key(key_env), local_envs)
        obs = _array(env_state.obs)[0]
        params = self.network.init(key_params, obs)
        scalar = jnp.float32(0.0)
        example = Transition(obs, jnp.int32(0), scalar, scalar, obs)
        return TrainState(
            params=params,
            target_params=jax.tree.map(jnp.copy, params),
            opt_state=self.optimizer.init(params),
            env_state=env_state,
            replay=replay.init(
                example, self.config.replay_capacity // self.num_devices, local_envs
            ),
            env_steps=jnp.int32(0),
            gradient_steps=jnp.int32(0),
            key=key,
        )

    def iteration(self, state: TrainState, _=None) -> tuple[TrainState, Metrics]:
        """One decision of every env, then `updates_per_step` updates; runs on each device."""
        key, key_act, key_reset, key_learn = jax.random.split(state.key, 4)
        rate = epsilon(self.config, state.env_steps)
        env_state, transition, metrics = self._collect(state, rate, key_act, key_reset)
        state = state._replace(
            env_state=env_state,
            replay=replay.add(state.replay, transition),
            env_steps=state.env_steps + self.num_envs,
            key=key,
        )
        # The cosine runs over the updates of a whole run; none is made before the warm-up.
        capacity = state.replay.data.action.shape[0]
        wanted = min(self.config.min_replay_size // self.num_devices, capacity)
        ready = state.replay.size >= wanted
        keys = jax.random.split(self._device_key(key_learn), self.config.updates_per_step)
        state, losses = jax.lax.cond(
            ready,
            lambda s: jax.lax.scan(self._update, s, keys),
            lambda s: (s, jnp.zeros(self.config.updates_per_step)),
            state,
        )
        return state, metrics | {"loss": losses.mean(), "epsilon": rate}

    def _collect(
        self, state: TrainState, rate: jax.Array, key_act: jax.Array, key_reset: jax.Array
    ) -> tuple[State, Transition, Metrics]:
        """Steps this device's envs once and resets those that are done."""
        before = state.env_state
        count = before.reward.shape[0]
        q_values = self._q_values(state.params, _array(before.obs))
        keys = jax.random.split(self._device_key(key_act), count)
        action = jax.vmap(epsilon_greedy, (0, 0, None))(keys, q_values, rate)
        after = jax.vmap(self.env.step)(before, action)
        truncation = after.info.get("truncation", jnp.zeros_like(after.done))
        transition = Transition(
            obs=_array(before.obs),
            action=action,
            reward=after.reward,
            terminated=after.done * (1 - truncation),
            next_obs=_array(after.obs),
        )
        metrics = jax.tree.map(jnp.mean, after.metrics | {"reward": after.reward})
        env_state = self.reset_done(after, self._device_key(key_reset))
        return env_state, transition, jax.lax.pmean(metrics, AXIS)

    def reset_done(self, state: State, key: jax.Array) -> State:
        """Replaces those of the batched env states that are done by fresh ones."""
        fresh = self._reset(key, state.reward.shape[0])
        done = state.done.astype(bool)

        def choose(new: jax.Array, old: jax.Array) -> jax.Array:
            return jnp.where(done.reshape(-1, *[1] * (old.ndim - 1)), new, old)

        return jax.tree.map(choose, fresh, state)

    def _update(self, state: TrainState, key: jax.Array) -> tuple[TrainState, jax.Array]:
        """One gradient step on a batch of which each device samples its share."""
        batch = replay.sample(state.replay, key, self.config.batch_size // self.num_devices)
        loss, grads = jax.value_and_grad(self._loss)(state.params, state.target_params, batch)
        loss, grads = jax.lax.pmean((loss, grads), AXIS)
        updates, opt_state = self.optimizer.update(grads, state.opt_state, state.params)
        params = optax.apply_updates(state.params, updates)
        gradient_steps = state.gradient_steps + 1
        target_params = optax.periodic_update(
            params, state.target_params, gradient_steps, self.config.target_update_period
        )
        state = state._replace(
            params=params,
            target_params=target_params,
            opt_state=opt_state,
            gradient_steps=gradient_steps,
        )
        return state, loss

    def _loss(self, params: Params, target_params: Params, batch: Transition) -> jax.Array:
        """Mean squared TD error (paper Eq. 1)."""
        q_tm1 = self._q_values(params, batch.obs)
        q_t = self._q_values(target_params, batch.next_obs)
        discount_t = self.config.gamma * (1 - batch.terminated)
        selector = self._q_values(params, batch.next_obs) if self.config.double else None
        error = jax.vmap(td_error, (0, 0, 0, 0, 0, None if selector is None else 0))(
            q_tm1, batch.action, batch.reward, discount_t, q_t, selector
        )
        return jnp.mean(error**2)

    def _q_values(self, params: Params, obs: jax.Array) -> jax.Array:
        values = self.network.apply(params, obs)
        assert isinstance(values, jax.Array)
        return values

    def _reset(self, key: jax.Array, count: int) -> State:
        return jax.vmap(self.env.reset)(jax.random.split(key, count))

    def _device_key(self, key: jax.Array) -> jax.Array:
        """A different key on every device."""
        return jax.random.fold_in(key, jax.lax.axis_index(AXIS))


def _array(obs: Observation) -> jax.Array:
    """Brax allows dictionaries of observations; this learner takes arrays."""
    if not isinstance(obs, jax.Array):
        raise TypeError(f"the env observes {type(obs).__name__}; this learner takes arrays")
    return obs
