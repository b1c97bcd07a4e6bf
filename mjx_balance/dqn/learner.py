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
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
import optax
from brax.envs.base import Env, State
from jax.sharding import AxisType, Mesh, PartitionSpec

from mjx_balance.config import DQNConfig
from mjx_balance.dqn import replay, whitening
from mjx_balance.dqn.acting import epsilon, explore
from mjx_balance.dqn.collecting import Metrics, Reset, array, collect, fresh
from mjx_balance.dqn.devices import AXIS, device_key
from mjx_balance.dqn.networks import QNetwork
from mjx_balance.dqn.replay import ReplayState, Transition
from mjx_balance.dqn.updating import (
    LearnerState,
    Params,
    QValues,
    Symmetries,
    make_optimizer,
    mirrored,
    update,
)
from mjx_balance.dqn.whitening import InputStatistics

REPLICATED = PartitionSpec()


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

        Raises:
          ValueError: if num_envs or batch_size cannot be split over the devices, or there
            is nothing to mirror with.
        """
        devices = list(devices or jax.devices())
        for name, value in (("num_envs", num_envs), ("batch_size", config.batch_size)):
            if value % len(devices):
                raise ValueError(
                    f"{name} is {value}; it must be a multiple of the {len(devices)} devices"
                )
        if config.mirror and symmetries is None:
            raise ValueError("mirror is True, but no symmetries are given to mirror with")
        self.env, self.network, self.config = env, network, config
        self.num_envs, self.num_devices, self.num_seeds = num_envs, len(devices), num_seeds
        self.symmetries = symmetries if config.mirror else None
        self.action_factors = tuple(action_factors or (env.action_size,))
        self.first_reset = first_reset or env.reset
        self.updates = config.updates_per_step(num_envs)
        iterations = -(-num_env_steps // num_envs)
        self.optimizer = make_optimizer(config, iterations * self.updates)
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
        program = jax.shard_map(
            self._each_seed(self.initial),
            mesh=self.mesh,
            in_specs=REPLICATED,
            out_specs=self.specs,
            check_vma=False,
        )
        keys = jax.vmap(jax.random.PRNGKey)(seed + jnp.arange(self.num_seeds))
        return jax.jit(program)(keys if self.num_seeds > 1 else keys[0])

    def train_program(self, iterations: int) -> Callable[[TrainState], tuple[TrainState, Metrics]]:
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

    def exported(self, state: TrainState) -> Params:
        """The parameters of one run (no seed axis) for a network that takes raw observations."""
        whiten = self._whitener(state.inputs)
        return state.params if whiten is None else self.network.folded(state.params, *whiten)

    def _each_seed(self, function: Callable[..., Any]) -> Callable[..., Any]:
        return jax.vmap(function) if self.num_seeds > 1 else function

    def initial(self, key: jax.Array) -> TrainState:
        """The state of one new run; runs on each device."""
        key, key_params, key_env = jax.random.split(key, 3)
        local_envs = self.num_envs // self.num_devices
        env_state = fresh(self.first_reset, device_key(key_env), local_envs)
        obs = array(env_state.obs)[0]
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
        """One decision of every env of one run, then its updates; runs on each device."""
        key, key_act, key_reset, key_learn = jax.random.split(state.key, 4)
        rate = epsilon(self.config, state.env_steps)
        if self.config.whiten_steps:
            state = state._replace(inputs=self._watch(state))
        q_values = self._q_values(self._whitener(state.inputs))
        env_state, transition, metrics = self._collect(state, q_values, rate, key_act, key_reset)
        state = state._replace(
            env_state=env_state,
            replay=replay.add(state.replay, transition),
            env_steps=state.env_steps + self.num_envs,
            key=key,
        )
        state, loss = self._learn(state, q_values, device_key(key_learn))
        return state, metrics | {"loss": loss, "epsilon": rate}

    def _collect(
        self,
        state: TrainState,
        q_values: QValues,
        rate: jax.Array,
        key_act: jax.Array,
        key_reset: jax.Array,
    ) -> tuple[State, Transition, Metrics]:
        """Takes one decision of each of this device's envs."""
        obs = array(state.env_state.obs)
        values = q_values(state.params, obs)
        keys = jax.random.split(device_key(key_act), len(obs))
        act = partial(explore, factors=self.action_factors, levels=self.config.exploration_noise)
        action = jax.vmap(act, (0, 0, None))(keys, values, rate)
        return collect(self.env, state.env_state, action, device_key(key_reset))

    def _learn(
        self, state: TrainState, q_values: QValues, key: jax.Array
    ) -> tuple[TrainState, jax.Array]:
        """Makes one iteration's updates, once the replay is warm; returns the mean loss."""
        # The cosine runs over the updates of a whole run; none is made before the warm-up.
        capacity = state.replay.data.action.shape[0]
        wanted = min(self.config.min_replay_size // self.num_devices, capacity)
        keys = jax.random.split(key, self.updates)

        def step(learner: LearnerState, key: jax.Array) -> tuple[LearnerState, jax.Array]:
            return update(
                learner, self._batch(state.replay, key), q_values, self.optimizer, self.config
            )

        before = LearnerState(*(getattr(state, name) for name in LearnerState._fields))
        after, losses = jax.lax.cond(
            state.replay.size >= wanted,
            lambda learner: jax.lax.scan(step, learner, keys),
            lambda learner: (learner, jnp.zeros(self.updates)),
            before,
        )
        return state._replace(**after._asdict()), losses.mean()

    def _batch(self, buffer: ReplayState, key: jax.Array) -> Transition:
        """This device's share of a batch, reflected if asked for."""
        key, key_mirror = jax.random.split(key)
        batch = replay.sample(buffer, key, self.config.batch_size // self.num_devices)
        return batch if self.symmetries is None else mirrored(self.symmetries, batch, key_mirror)

    def _watch(self, state: TrainState) -> InputStatistics:
        """Takes the present observations of all devices into account, as long as it should."""
        obs = array(state.env_state.obs)
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

    def _q_values(self, whiten: tuple[jax.Array, jax.Array] | None) -> QValues:
        def q_values(params: Params, obs: jax.Array) -> jax.Array:
            if whiten is not None:  # the small kernel instead of every observation
                params = self.network.folded(params, *whiten)
            values = self.network.apply(params, obs)
            assert isinstance(values, jax.Array)
            return values

        return q_values
