"""The DQN as one program: act, step, store, sample, update, over all envs and devices.

Envs and replay are sharded over a one-axis device mesh, parameters replicated:
each device steps its own envs, fills its own part of the replay and samples its
own share of every batch; gradients are averaged. On a laptop the devices are CPU
cores, elsewhere accelerators; the program is the same.

Several seeds are several runs in one program: every array of the state gets a leading
seed axis and the iteration is vmapped over it.
"""

import dataclasses
from collections.abc import Callable, Mapping, Sequence
from functools import cached_property, partial
from typing import Any, NamedTuple, TypeAlias

import jax
import jax.numpy as jnp
import numpy as np
import optax
from brax.envs.base import Env, State
from jax.sharding import AxisType, Mesh, PartitionSpec

from mjx_balance.config import DQNConfig
from mjx_balance.dqn import replay, whitening
from mjx_balance.dqn.acting import epsilon, explore
from mjx_balance.dqn.collecting import Collected, Reset, array, collect, finite, fresh
from mjx_balance.dqn.devices import AXIS, device_key, on_each_device
from mjx_balance.dqn.means import Mean
from mjx_balance.dqn.networks import QNetwork
from mjx_balance.dqn.replay import ReplayState, Transition
from mjx_balance.dqn.updating import (
    LearnerState,
    Params,
    Symmetries,
    make_optimizer,
    mirrored,
    update,
)
from mjx_balance.dqn.whitening import InputStatistics
from mjx_balance.policy.heads import Head

REPLICATED = PartitionSpec()
Metrics: TypeAlias = dict[str, jax.Array]


class TrainState(NamedTuple):
    """Everything a run is made of: saving it saves the run.

    With several seeds, every leaf has a leading axis of that size.
    """

    params: Params
    """Of a network that takes whitened observations, where `whiten_steps` asks for that."""
    target_params: Params
    """Of one that takes raw observations, as `params` were when it was last copied."""
    opt_state: optax.OptState
    inputs: InputStatistics
    """What is known of the observations."""
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
    swept: dict[str, jax.Array]
    """() of each field of the config that has another value in every run."""


class Learner:
    """Trains a Q-network on a brax env whose `action_size` counts discrete actions."""

    def __init__(
        self,
        env: Env,
        network: QNetwork,
        config: DQNConfig,
        num_envs: int,
        num_env_steps: int,
        devices: Sequence[Any] | None = None,
        num_seeds: int = 1,
        symmetries: Symmetries | None = None,
        action_factors: Sequence[int] | None = None,
        first_reset: Reset | None = None,
        sweep: Mapping[str, Sequence[float]] | None = None,
    ):
        """Sets the programs up; nothing is compiled yet.

        Args:
          env: unbatched env; `info["truncation"]`, where it has one, marks time-outs.
          network: maps (..., obs_size) to (..., action_size).
          config: the algorithm.
          num_envs: envs over all devices.
          num_env_steps: length of the run, for the schedules.
          devices: the mesh; all local devices if none.
          num_seeds: independent runs trained at once.
          symmetries: how the env looks in a mirror, for `config.mirror`.
          action_factors: sizes of the digits of an action index, along which exploration
            noise moves it; one digit if none.
          first_reset: makes the envs that a run begins with; `env.reset` if none.
          sweep: values of fields of `config`, one for each run: they take its value's place.

        Raises:
          ValueError: if num_envs or batch_size cannot be split over the devices, there is
            nothing to mirror with, or a swept field has another number of values.
        """
        devices = list(devices or jax.devices())
        for name, value in (("num_envs", num_envs), ("batch_size", config.batch_size)):
            if value % len(devices):
                raise ValueError(
                    f"{name} is {value}; it must be a multiple of the {len(devices)} devices"
                )
        if config.mirror and symmetries is None:
            raise ValueError("mirror is True, but no symmetries are given to mirror with")
        for name, values in (sweep or {}).items():
            if len(values) != num_seeds or num_seeds == 1:
                raise ValueError(f"{name} has {len(values)} values for {num_seeds} runs")
        self.env, self.network, self.config = env, network, config
        self.sweep = {
            name: np.asarray(values, np.float32) for name, values in (sweep or {}).items()
        }
        self.num_envs, self.num_devices, self.num_seeds = num_envs, len(devices), num_seeds
        self.symmetries = symmetries if config.mirror else None
        self.action_factors = tuple(action_factors or (env.action_size,))
        self.first_reset = first_reset or env.reset
        self.updates = config.updates_per_step(num_envs)
        self.total_updates = -(-num_env_steps // num_envs) * self.updates
        self.mesh = Mesh(np.asarray(devices), (AXIS,), axis_types=(AxisType.Auto,))
        self.trace_count = 0

    @property
    def specs(self) -> TrainState:
        """Which arrays of the state are sharded over the devices."""
        sharded = PartitionSpec(None, AXIS) if self.num_seeds > 1 else PartitionSpec(AXIS)
        specs: dict[str, Any] = dict.fromkeys(TrainState._fields, REPLICATED)
        replay_specs: list[Any] = [sharded, REPLICATED, REPLICATED]
        return TrainState(**specs | {"env_state": sharded, "replay": ReplayState(*replay_specs)})

    def init(self, seed: int) -> TrainState:
        """Builds the state of a new run, or of runs `seed`, `seed + 1`, ..., on its devices."""
        seeds = np.arange(seed, seed + self.num_seeds, dtype=np.int32)
        return self._init_program(seeds if self.num_seeds > 1 else seeds[0], self.sweep)

    @cached_property
    def _init_program(self) -> Callable[[np.ndarray, Mapping[str, np.ndarray]], TrainState]:
        return jax.jit(
            on_each_device(
                self._each_seed(lambda seed, swept: self.initial(jax.random.PRNGKey(seed), swept)),
                self.mesh,
                in_specs=REPLICATED,
                out_specs=self.specs,
            )
        )

    def train_program(self, iterations: int) -> Callable[[TrainState], tuple[TrainState, Metrics]]:
        """The jitted training program: state -> (state, metrics), the state donated.

        Args:
          iterations: decisions of every env per call. Metrics are means over what happened
            in them, with a leading seed axis if there are several seeds; NaN if nothing did,
            as for the loss of a call without an update.

        Wait for a result every few calls: of CPU devices XLA starts no more than 32 launches at
        once, and those started would wait for ever for the one that was not.
        """
        iteration = self._each_seed(self.iteration, in_axes=(0, None))

        def step(state: TrainState, _: None) -> tuple[TrainState, dict[str, Mean]]:
            # The same for all seeds: asked here, the branch not taken costs nothing.
            watching = state.env_steps.max() < self.config.whiten_steps
            return iteration(state, watching)

        def program(state: TrainState) -> tuple[TrainState, Metrics]:
            self.trace_count += 1
            state, metrics = jax.lax.scan(step, state, length=iterations)
            totals = jax.tree.map(lambda x: x.sum(axis=0), metrics)
            return state, {name: mean.value() for name, mean in totals.items()}

        return jax.jit(
            on_each_device(
                program, self.mesh, in_specs=(self.specs,), out_specs=(self.specs, REPLICATED)
            ),
            donate_argnums=0,
        )

    def exported(self, state: TrainState) -> Params:
        """The parameters of one run (no seed axis) for a network that takes raw observations."""
        return jax.jit(self._folded)(state.params, state.inputs)

    def _folded(self, params: Params, inputs: InputStatistics) -> Params:
        """Folds the whitening in: the small kernel instead of every observation."""
        if not self.config.whiten_steps:
            return params
        return self.network.folded(params, inputs.mean, inputs.matrix)

    def _each_seed(self, function: Callable[..., Any], in_axes: Any = 0) -> Callable[..., Any]:
        return jax.vmap(function, in_axes) if self.num_seeds > 1 else function

    def initial(self, key: jax.Array, swept: dict[str, jax.Array]) -> TrainState:
        """The state of one new run; runs on each device."""
        key, key_params, key_env = jax.random.split(key, 3)
        local_envs = self.num_envs // self.num_devices
        env_state = fresh(self.first_reset, device_key(key_env), local_envs)
        obs = array(env_state.obs)[0]
        params = self.network.init(key_params, obs)
        inputs = whitening.init(len(obs), self.config.whiten_floor)
        scalar = jnp.float32(0.0)
        example = Transition(obs, jnp.int32(0), scalar, scalar, obs)
        return TrainState(
            params=params,
            target_params=jax.tree.map(jnp.copy, self._folded(params, inputs)),
            opt_state=make_optimizer(self.config, self.total_updates).init(params),
            inputs=inputs,
            env_state=env_state,
            replay=replay.init(
                example, self.config.replay_capacity // self.num_devices, local_envs
            ),
            env_steps=jnp.int32(0),
            gradient_steps=jnp.int32(0),
            key=key,
            swept=swept,
        )

    def own_config(self, state: TrainState) -> DQNConfig:
        """The config of one run; swept fields hold arrays."""
        return dataclasses.replace(self.config, **state.swept)  # pyright: ignore[reportArgumentType]

    def iteration(
        self, state: TrainState, watching: jax.Array
    ) -> tuple[TrainState, dict[str, Mean]]:
        """One decision of every env of one run, then its updates; runs on each device.

        Args:
          state: of one run, this device's part.
          watching: () whether observations still add to the input statistics.
        """
        key, key_act, key_reset, key_learn = jax.random.split(state.key, 4)
        rate = epsilon(self.own_config(state), state.env_steps)
        inputs = jax.lax.cond(watching, self._watch, lambda state: state.inputs, state)
        state = state._replace(inputs=inputs)
        seen = self._collect(state, rate, key_act, key_reset)
        with jax.named_scope("replay"):
            stored = replay.add(state.replay, seen.transition, seen.storable)
        state = state._replace(
            env_state=seen.env_state,
            replay=stored,
            env_steps=state.env_steps + self.num_envs,
            key=key,
        )
        with jax.named_scope("updates"):
            state, loss = self._learn(state, device_key(key_learn))
        return state, seen.metrics | loss | {"epsilon": Mean(rate, jnp.float32(1.0))}

    def _watch(self, state: TrainState) -> InputStatistics:
        """Takes the present observations of all devices into account."""
        obs = array(state.env_state.obs)
        sound = jax.vmap(finite)(obs)[:, None]
        count = jax.lax.psum(sound.sum(), AXIS)
        mean: jax.Array = jax.lax.psum(jnp.where(sound, obs, 0.0).sum(axis=0), AXIS) / count
        away = jnp.where(sound, obs - mean, 0.0)
        # What neighbouring samples differ in is little, and is what whitening divides by.
        with jax.default_matmul_precision("highest"):
            covariance = jax.lax.psum(away.T @ away, AXIS) / count
            seen = whitening.update(state.inputs, mean, covariance, self.config.whiten_floor)
        usable = finite(seen)  # not if no observation was, or their squares are beyond numbers
        return jax.tree.map(lambda new, old: jnp.where(usable, new, old), seen, state.inputs)

    def _collect(
        self, state: TrainState, rate: jax.Array, key_act: jax.Array, key_reset: jax.Array
    ) -> Collected:
        """Takes one decision of each of this device's envs."""
        obs = array(state.env_state.obs)
        with jax.named_scope("acting"):
            greedy = self._q_values(self._folded(state.params, state.inputs), obs).argmax()
            keys = jax.random.split(device_key(key_act), len(obs))
            levels = self.config.exploration_noise
            act = partial(explore, factors=self.action_factors, levels=levels)
            action = jax.vmap(act, (0, 0, None))(keys, greedy, rate)
        with jax.named_scope("env"):
            return collect(self.env, state.env_state, action, device_key(key_reset))

    def _learn(self, state: TrainState, key: jax.Array) -> tuple[TrainState, dict[str, Mean]]:
        """Makes one iteration's updates, once the replay is warm.

        Returns:
          The state; `loss` over the updates made, and `skipped_updates`, the share of those
          that were not because something was not finite.
        """
        # The cosine runs over the updates of a whole run; none is made before the warm-up.
        capacity = state.replay.data.action.shape[0]
        wanted = min(self.config.min_replay_size // self.num_devices, capacity)
        ready = state.replay.size >= wanted
        keys = jax.random.split(key, self.updates)
        fold = partial(self._folded, inputs=state.inputs)
        nothing = Mean(jnp.float32(0.0), jnp.float32(0.0))
        config = self.own_config(state)
        optimizer = make_optimizer(config, self.total_updates)

        def step(learner: LearnerState, key: jax.Array) -> tuple[LearnerState, Mean]:
            batch = self._batch(state.replay, key)
            return update(learner, batch, self._q_values, fold, optimizer, config)

        def learn(learner: LearnerState) -> tuple[LearnerState, Mean]:
            learner, losses = jax.lax.scan(step, learner, keys)
            return learner, jax.tree.map(jnp.sum, losses)

        before = LearnerState(*(getattr(state, name) for name in LearnerState._fields))
        after, loss = jax.lax.cond(ready, learn, lambda learner: (learner, nothing), before)
        skips = Mean(ready * (self.updates - loss.number), jnp.float32(self.updates))
        return state._replace(**after._asdict()), {"loss": loss, "skipped_updates": skips}

    def _batch(self, buffer: ReplayState, key: jax.Array) -> Transition:
        """This device's share of a batch, reflected if asked for."""
        key, key_mirror = jax.random.split(key)
        with jax.named_scope("replay"):
            batch = replay.sample(buffer, key, self.config.batch_size // self.num_devices)
        return batch if self.symmetries is None else mirrored(self.symmetries, batch, key_mirror)

    def _q_values(self, params: Params, obs: jax.Array) -> Head:
        head = self.network.apply(params, obs, method="head")
        assert isinstance(head, Head)
        return head
