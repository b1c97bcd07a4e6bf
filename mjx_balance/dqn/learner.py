"""The DQN as one program: act, step, store, sample, update, over all envs and devices.

Envs and replay are sharded over a one-axis device mesh, parameters replicated:
each device steps its own envs, fills its own part of the replay and samples its
own share of every batch; gradients are averaged. On a laptop the devices are CPU
cores, elsewhere accelerators; the program is the same.

Several seeds are several runs in one program: every array of the state gets a leading
seed axis and the iteration is vmapped over it.
"""

from collections.abc import Callable, Sequence
from functools import partial
from typing import Any, NamedTuple, TypeAlias

import flax.linen as nn
import jax
import jax.numpy as jnp
import numpy as np
import optax
from brax.envs.base import Env, Observation, State
from jax.sharding import AxisType, Mesh, PartitionSpec

from mjx_balance.config import DQNConfig
from mjx_balance.dqn import replay, whitening
from mjx_balance.dqn.losses import td_error
from mjx_balance.dqn.networks import fold_inputs
from mjx_balance.dqn.replay import ReplayState, Transition
from mjx_balance.dqn.whitening import InputStatistics

AXIS = "devices"
REPLICATED = PartitionSpec()

Metrics: TypeAlias = dict[str, jax.Array]
Params: TypeAlias = Any
"""The network's variables, a flax pytree."""


class TrainState(NamedTuple):
    """Everything a run is made of: saving it saves the run.

    With several seeds, every leaf has a leading axis of that size.
    """

    params: Params
    """Of a network that takes whitened observations, where `whiten_steps` asks for that."""
    target_params: Params
    opt_state: optax.OptState
    inputs: InputStatistics
    """Mean and covariance of the observations."""
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


class Knowledge(NamedTuple):
    """The part of the state that an update changes."""

    params: Params
    target_params: Params
    opt_state: optax.OptState
    gradient_steps: jax.Array


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


def dither(key: jax.Array, action: jax.Array, factors: Sequence[int], levels: int) -> jax.Array:
    """Moves an action by up to `levels` on each factor of its index, uniformly.

    A greedy action alone shows a reward near its peak, which says how far off it was but
    not to which side; its neighbours do.

    Args:
      key: PRNG key.
      action: () index, a mixed-radix number.
      factors: sizes of its digits.
      levels: greatest move; digits stop at their ends.
    """
    move = jax.random.randint(key, (len(factors),), -levels, levels + 1)
    digits = jnp.stack(jnp.unravel_index(action, tuple(factors))) + move
    digits = jnp.clip(digits, 0, jnp.asarray(factors) - 1)
    return jnp.ravel_multi_index(tuple(digits), tuple(factors), mode="clip").astype(action.dtype)


def make_optimizer(config: DQNConfig, gradient_steps: int) -> optax.GradientTransformation:
    """Adam with clipped gradients and a cosine from learning_rate to learning_rate_end."""
    schedule = optax.cosine_decay_schedule(
        config.learning_rate,
        max(gradient_steps, 1),
        config.learning_rate_end / config.learning_rate,
    )
    return optax.chain(optax.clip_by_global_norm(config.max_grad_norm), optax.adam(schedule))


def mirrored(symmetries: Any, batch: Transition, key: jax.Array) -> Transition:
    """Replaces each transition (batch, ...) by one of its reflections, chosen at random."""
    which = jax.random.randint(key, batch.action.shape, 0, len(symmetries.obs_index))

    def reflect(obs: jax.Array) -> jax.Array:
        index = jnp.asarray(symmetries.obs_index)[which]
        return jnp.take_along_axis(obs, index, axis=-1) * jnp.asarray(symmetries.obs_sign)[which]

    return batch._replace(
        obs=reflect(batch.obs),
        next_obs=reflect(batch.next_obs),
        action=jnp.asarray(symmetries.action_index)[which, batch.action],
    )


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
        num_seeds: int = 1,
    ):
        """Sets the programs up; nothing is compiled yet.

        Args:
          env: unbatched env; `info["truncation"]`, where it has one, marks time-outs. With
            `config.mirror`, its `symmetries` (obs_index, obs_sign and action_index, one row
            per reflection) say how it looks in a mirror.
          network: maps (..., obs_size) to (..., action_size).
          config: the algorithm.
          num_envs: envs over all devices.
          num_env_steps: length of the run, for the schedules.
          devices: the mesh; all local devices if none.
          num_seeds: independent runs trained at once.

        Raises:
          AttributeError: if the env has no symmetries to mirror with.
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
        self.num_seeds = num_seeds
        self.symmetries = env.symmetries if config.mirror else None  # pyright: ignore
        sharded = PartitionSpec(None, AXIS) if num_seeds > 1 else PartitionSpec(AXIS)
        specs: dict[str, Any] = dict.fromkeys(TrainState._fields, REPLICATED)
        replay_specs: list[Any] = [sharded, REPLICATED, REPLICATED]
        specs |= {"env_state": sharded, "replay": ReplayState(*replay_specs)}
        self.specs = TrainState(**specs)

    def init(self, seed: int) -> TrainState:
        """Builds the state of a new run, or of runs `seed`, `seed + 1`, ..., on its devices."""
        program = jax.shard_map(
            self._each_seed(self.initial),
            mesh=self.mesh,
            in_specs=REPLICATED,
            out_specs=self.specs,
            check_vma=False,
        )
        keys = jax.vmap(jax.random.PRNGKey)(seed + jnp.arange(self.num_seeds))
        return jax.jit(program)(keys if self.num_seeds > 1 else keys[0])

    def _each_seed(self, function: Callable[..., Any]) -> Callable[..., Any]:
        return jax.vmap(function) if self.num_seeds > 1 else function

    def train_program(self, iterations: int):
        """The jitted training program: state -> (state, metrics), the state donated.

        Args:
          iterations: decisions of every env per call. Metrics are means over them, with a
            leading seed axis if there are several seeds.
        """

        def program(state: TrainState) -> tuple[TrainState, Metrics]:
            self.trace_count += 1
            step = self._each_seed(self.iteration)
            state, metrics = jax.lax.scan(lambda s, _: step(s), state, length=iterations)
            return state, jax.tree.map(lambda x: x.mean(axis=0), metrics)

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

    def initial(self, key: jax.Array) -> TrainState:
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
            inputs=whitening.init(obs.shape[-1]),
            env_state=env_state,
            replay=replay.init(
                example, self.config.replay_capacity // self.num_devices, local_envs
            ),
            env_steps=jnp.int32(0),
            gradient_steps=jnp.int32(0),
            key=key,
        )

    def iteration(self, state: TrainState) -> tuple[TrainState, Metrics]:
        """One decision of every env, then `updates_per_step` updates; runs on each device."""
        key, key_act, key_reset, key_learn = jax.random.split(state.key, 4)
        rate = epsilon(self.config, state.env_steps)
        if self.config.whiten_steps:
            state = state._replace(inputs=self._watch(state))
        whiten = self._whitener(state.inputs)
        env_state, transition, metrics = self._collect(state, whiten, rate, key_act, key_reset)
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
        before = Knowledge(*(getattr(state, name) for name in Knowledge._fields))
        learnt, losses = jax.lax.cond(
            ready,
            lambda known: jax.lax.scan(partial(self._update, state.replay, whiten), known, keys),
            lambda known: (known, jnp.zeros(self.config.updates_per_step)),
            before,
        )
        state = state._replace(**learnt._asdict())
        return state, metrics | {"loss": losses.mean(), "epsilon": rate}

    def _watch(self, state: TrainState) -> InputStatistics:
        """Takes the present observations of all devices into account, as long as it should."""
        obs = _array(state.env_state.obs)
        mean = jax.lax.pmean(obs.mean(axis=0), AXIS)
        away = obs - mean
        covariance = jax.lax.pmean(away.T @ away / len(obs), AXIS)
        seen = whitening.update(state.inputs, mean, covariance)
        going_on = state.env_steps < self.config.whiten_steps
        return jax.tree.map(lambda new, old: jnp.where(going_on, new, old), seen, state.inputs)

    def _whitener(self, inputs: InputStatistics) -> tuple[jax.Array, jax.Array] | None:
        if not self.config.whiten_steps:
            return None
        return inputs.mean, whitening.matrix(inputs, self.config.whiten_floor)

    def exported(self, state: TrainState) -> Params:
        """The parameters of one run (no seed axis) for a network that takes raw observations."""
        whiten = self._whitener(state.inputs)
        if whiten is None:
            return state.params
        return fold_inputs(state.params, *whiten)

    def _collect(
        self,
        state: TrainState,
        whiten: Any,
        rate: jax.Array,
        key_act: jax.Array,
        key_reset: jax.Array,
    ) -> tuple[State, Transition, Metrics]:
        """Steps this device's envs once and resets those that are done."""
        before = state.env_state
        count = before.reward.shape[0]
        q_values = self._q_values(state.params, whiten, _array(before.obs))
        keys = jax.random.split(self._device_key(key_act), count)
        action = jax.vmap(epsilon_greedy, (0, 0, None))(keys, q_values, rate)
        if self.config.dither:
            keys = jax.vmap(jax.random.fold_in, (0, None))(keys, 1)
            factors = getattr(self.env, "action_factors", (self.env.action_size,))
            move = partial(dither, factors=factors, levels=self.config.dither)
            action = jax.vmap(move)(keys, action)
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

    def _update(
        self, buffer: ReplayState, whiten: Any, known: Knowledge, key: jax.Array
    ) -> tuple[Knowledge, jax.Array]:
        """One gradient step on a batch of which each device samples its share."""
        key, key_mirror = jax.random.split(key)
        batch = replay.sample(buffer, key, self.config.batch_size // self.num_devices)
        if self.symmetries is not None:
            batch = mirrored(self.symmetries, batch, key_mirror)
        loss_and_grads = jax.value_and_grad(self._loss)
        loss, grads = loss_and_grads(known.params, known.target_params, whiten, batch)
        loss, grads = jax.lax.pmean((loss, grads), AXIS)
        updates, opt_state = self.optimizer.update(grads, known.opt_state, known.params)
        params = optax.apply_updates(known.params, updates)
        gradient_steps = known.gradient_steps + 1
        target_params = optax.periodic_update(
            params, known.target_params, gradient_steps, self.config.target_update_period
        )
        return Knowledge(params, target_params, opt_state, gradient_steps), loss

    def _loss(
        self, params: Params, target_params: Params, whiten: Any, batch: Transition
    ) -> jax.Array:
        """Mean squared TD error (paper Eq. 1)."""
        q_tm1 = self._q_values(params, whiten, batch.obs)
        q_t = self._q_values(target_params, whiten, batch.next_obs)
        discount_t = self.config.gamma * (1 - batch.terminated)
        selector = self._q_values(params, whiten, batch.next_obs) if self.config.double else None
        error = jax.vmap(td_error, (0, 0, 0, 0, 0, None if selector is None else 0))(
            q_tm1, batch.action, batch.reward, discount_t, q_t, selector
        )
        return jnp.mean(error**2)

    def _q_values(self, params: Params, whiten: Any, obs: jax.Array) -> jax.Array:
        if whiten is not None:  # the small kernel instead of every observation
            params = fold_inputs(params, *whiten)
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
