"""A Deep Q-Network as one jitted program: act, step, store, sample, update, copy.

Mnih et al. 2015, https://www.nature.com/articles/nature14236, for thousands of envs at once: one
iteration steps every env once and makes as many updates as the replay ratio demands. Read
`DQN.iteration` first.

Envs and replay are sharded over a one-axis device mesh of CPU cores or accelerators; parameters are
replicated. Each device steps its own envs, fills its own part of the replay and samples its own
share of every batch; gradients are averaged.

With several seeds, every array of the state has a leading seed axis, and the iteration is vmapped
over it.
"""

import dataclasses
import math
from collections.abc import Callable, Mapping, Sequence
from functools import cached_property, partial
from typing import Any, NamedTuple, TypeAlias

import jax
import jax.numpy as jnp
import numpy as np
import optax
from brax.envs.base import Env, State
from jax.sharding import AxisType, Mesh, PartitionSpec
from jaxtyping import Array, Bool, Float, Int, PRNGKeyArray

from mjx_balance.config import DQNConfig
from mjx_balance.dqn import normalization, replay
from mjx_balance.dqn.mesh import (
    AXIS,
    REPLICATED,
    Mean,
    all_finite,
    device_key,
    mean_over_devices,
    mean_where,
    on_each_device,
)
from mjx_balance.dqn.networks import Network, Whitened
from mjx_balance.dqn.normalization import RunningStatistics
from mjx_balance.dqn.replay import ReplayState, Symmetries, Transition
from mjx_balance.policy.heads import Additive, Head

Params: TypeAlias = Any  #: a network's variables, a pytree
Loss: TypeAlias = Callable[[Head, Any, jax.Array, jax.Array, Head, Head], jax.Array]
"""A loss of one transition: the arguments of `td_error` -> ()."""
Means: TypeAlias = dict[str, Mean]


@dataclasses.dataclass(frozen=True)
class DQNSpec:
    """The numbers of a run.

    Raises:
      ValueError: if num_envs or batch_size cannot be split over the devices, if there are no
        symmetries to mirror with, or if a swept field has another number of values than runs.
    """

    config: DQNConfig
    num_envs: int  #: envs over all devices
    num_env_steps: int  #: decisions of the run over all envs, for the learning rate's schedule
    devices: Sequence[Any] = dataclasses.field(default_factory=jax.devices)  #: the mesh
    num_seeds: int = 1  #: independent runs in one program
    symmetries: Symmetries | None = None  #: reflections of the env, for `config.mirror`
    action_factors: tuple[int, ...] | None = None
    """Levels of each digit of an action index, for the exploration noise; None: one digit."""
    continuous: bool = False
    """Whether an action is a point of the radial head, a number per factor, instead of an index."""
    first_reset: Callable[[jax.Array], State] | None = None
    """PRNG key -> an env at the start of a run; None: `Env.reset`."""
    sweep: Mapping[str, Sequence[float]] = dataclasses.field(default_factory=dict)
    """Field of `config` -> its value in every run."""

    def __post_init__(self) -> None:
        for name, value in (("num_envs", self.num_envs), ("batch_size", self.config.batch_size)):
            if value % len(self.devices):
                raise ValueError(
                    f"{name} is {value}; it must be a multiple of the {len(self.devices)} devices"
                )
        if self.config.mirror and self.symmetries is None:
            raise ValueError("mirror is True, but no symmetries are given to mirror with")
        if self.continuous and (self.config.head != "radial" or self.action_factors is None):
            raise ValueError("continuous is True; it needs the head 'radial' and action_factors")
        for name, values in self.sweep.items():
            if len(values) != self.num_seeds or self.num_seeds == 1:
                raise ValueError(f"{name} has {len(values)} values for {self.num_seeds} runs")

    @property
    def updates_per_iteration(self) -> int:
        """Gradient steps after each decision of all envs."""
        return self.config.updates_per_step(self.num_envs)

    @property
    def total_updates(self) -> int:
        """Gradient steps of a run that learned from its first decision, its iterations rounded up.

        The learning rate's decay is as long. A run makes none before `min_replay_size`, so that
        it ends somewhat above `learning_rate_end_share`.
        """
        return -(-self.num_env_steps // self.num_envs) * self.updates_per_iteration

    def per_device(self, count: int) -> int:
        """One device's share of a count over all devices."""
        return count // len(self.devices)


class TrainState(NamedTuple):
    """The complete state of a run, for checkpoints; several seeds are a leading axis."""

    params: Params  #: for whitened observations, if `whiten_steps` is positive
    target_params: Params  #: for raw observations: each copy includes the whitening at its time
    opt_state: optax.OptState
    statistics: RunningStatistics
    env_state: State  #: (num_envs, ...) per leaf, sharded
    replay: ReplayState  #: data sharded; position and size count one device's rows
    env_steps: Int[Array, ""]  #: decisions over all envs
    gradient_steps: Int[Array, ""]
    key: PRNGKeyArray  #: the same on every device
    sweep: dict[str, Float[Array, ""]]  #: value of each swept field of the config


class UpdateState(NamedTuple):
    """The part of the training state that an update changes."""

    params: Params
    target_params: Params
    opt_state: optax.OptState
    gradient_steps: Int[Array, ""]


@dataclasses.dataclass(frozen=True)
class DQN:
    """Trains a Q-network on a brax env.

    Args:
      env: unbatched, with `action_size` discrete actions; with `spec.continuous`, an action is
        `action_size` numbers from -1 to 1; `info["truncation"]`, if there, marks time-outs.
      network: maps (..., obs_size) to (..., action_size): a `QNetwork` or another `Network`.
      spec: the numbers of the run.
      own_loss: loss of a transition, averaged over a batch; None: that of `DQN.loss`.
    """

    env: Env
    network: Network
    spec: DQNSpec
    own_loss: Loss | None = None

    @cached_property
    def mesh(self) -> Mesh:
        """The device mesh of the program."""
        return Mesh(np.asarray(self.spec.devices), (AXIS,), axis_types=(AxisType.Auto,))

    @property
    def state_specs(self) -> TrainState:
        """Which arrays of the state are sharded over the devices."""
        sharded = PartitionSpec(None, AXIS) if self.spec.num_seeds > 1 else PartitionSpec(AXIS)
        specs: dict[str, Any] = dict.fromkeys(TrainState._fields, REPLICATED)
        replay_specs: list[Any] = [sharded, REPLICATED, REPLICATED]
        return TrainState(**specs | {"env_state": sharded, "replay": ReplayState(*replay_specs)})

    def init(self, seed: int) -> TrainState:
        """The state of a new run, or of runs `seed`, `seed + 1`, ..., on its devices."""
        seeds = np.arange(seed, seed + self.spec.num_seeds, dtype=np.int32)
        sweep = {name: np.asarray(x, np.float32) for name, x in self.spec.sweep.items()}
        return self._init_program(seeds if self.spec.num_seeds > 1 else seeds[0], sweep)

    @cached_property
    def _init_program(self) -> Callable[..., TrainState]:
        init = self._each_seed(lambda seed, x: self.initial_state(jax.random.PRNGKey(seed), x))
        return jax.jit(on_each_device(init, self.mesh, REPLICATED, self.state_specs))

    def train_program(
        self, iterations: int
    ) -> Callable[[TrainState], tuple[TrainState, dict[str, jax.Array]]]:
        """Returns the jitted training program: state -> (state, metrics), with the state donated.

        Metrics are means over the call, with a leading seed axis if there are several seeds. A
        metric without values is NaN, e.g. the loss of a call without updates.

        Wait for a result every few calls: XLA runs at most 32 launches of CPU devices at once, and
        launches that wait for one that has not started deadlock.

        Args:
          iterations: decisions of every env per call.
        """
        iteration = self._each_seed(self.iteration, in_axes=(0, None))

        def step(state: TrainState, _: None) -> tuple[TrainState, Means]:
            # The same for all seeds. Inside the vmap, `cond` would run both branches.
            observing = state.env_steps.max() < self.spec.config.whiten_steps
            return iteration(state, observing)

        def program(state: TrainState) -> tuple[TrainState, dict[str, jax.Array]]:
            state, metrics = jax.lax.scan(step, state, length=iterations)
            totals = jax.tree.map(lambda x: x.sum(axis=0), metrics)
            return state, {name: mean.value() for name, mean in totals.items()}

        specs = self.state_specs
        sharded = on_each_device(program, self.mesh, (specs,), (specs, REPLICATED))
        return jax.jit(sharded, donate_argnums=0)

    def export_params(self, state: TrainState) -> Params:
        """Returns the parameters of one run (no seed axis) for raw observations."""
        return jax.jit(self.fold)(state.params, state.statistics)

    def _each_seed(self, function: Callable[..., Any], in_axes: Any = 0) -> Callable[..., Any]:
        return jax.vmap(function, in_axes) if self.spec.num_seeds > 1 else function

    # The methods below handle one run, on each device.

    def initial_state(self, key: PRNGKeyArray, sweep: dict[str, jax.Array]) -> TrainState:
        """The state of a new run.

        Raises:
          TypeError: if the env observes a dictionary, as brax allows.
        """
        spec, config = self.spec, self.spec.config
        key, key_params, key_env = jax.random.split(key, 3)
        local_envs = spec.per_device(spec.num_envs)
        reset = spec.first_reset or self.env.reset
        env_state = reset_all(reset, device_key(key_env), local_envs)
        if not isinstance(env_state.obs, jax.Array):
            kind = type(env_state.obs).__name__
            raise TypeError(f"the env observes {kind}; this DQN takes arrays")
        obs = env_state.obs[0]
        params = self.network.init(key_params, obs)
        statistics = normalization.init(len(obs), config.whiten_floor)
        scalar = jnp.float32(0.0)
        action = jnp.zeros(len(spec.action_factors or ())) if spec.continuous else jnp.int32(0)
        example = Transition(obs, action, scalar, scalar, obs)
        return TrainState(
            params=params,
            target_params=jax.tree.map(jnp.copy, self.fold(params, statistics)),
            opt_state=make_optimizer(config, spec.total_updates).init(params),
            statistics=statistics,
            env_state=env_state,
            replay=replay.init(example, spec.per_device(config.replay_capacity), local_envs),
            env_steps=jnp.int32(0),
            gradient_steps=jnp.int32(0),
            key=key,
            sweep=sweep,
        )

    def iteration(self, state: TrainState, observing: Bool[Array, ""]) -> tuple[TrainState, Means]:
        """One decision of every env, then the updates.

        Args:
          state: this device's part of the state of one run.
          observing: whether to add the observations to the statistics.
        """
        key, key_act, key_reset, key_update = jax.random.split(state.key, 4)
        swept: Any = state.sweep
        config = dataclasses.replace(self.spec.config, **swept)  # swept fields are arrays
        obs: Any = state.env_state.obs
        statistics = jax.lax.cond(
            observing,
            lambda: normalization.observe(state.statistics, obs, config.whiten_floor),
            lambda: state.statistics,
        )
        epsilon = linear_epsilon(config, state.env_steps)
        with jax.named_scope("acting"):
            params = self.fold(state.params, statistics)
            keys = jax.random.split(device_key(key_act), len(obs))
            action = jax.vmap(self.act, (None, 0, 0, None))(params, obs, keys, epsilon)
        with jax.named_scope("env"):
            env_state, transition, valid, metrics = step(
                self.env, state.env_state, action, device_key(key_reset)
            )
        with jax.named_scope("replay"):
            buffer = replay.add(state.replay, transition, valid)
        state = state._replace(
            statistics=statistics,
            env_state=env_state,
            replay=buffer,
            env_steps=state.env_steps + self.spec.num_envs,
            key=key,
        )
        with jax.named_scope("updates"):
            state, losses = self.learn(state, config, device_key(key_update))
        return state, metrics | losses | {"epsilon": Mean(epsilon, jnp.ones(()))}

    def act(
        self, params: Params, obs: Float[Array, " obs"], key: PRNGKeyArray, epsilon: jax.Array
    ) -> Int[Array, ""] | Float[Array, " axes"]:
        """The action of one env: epsilon-greedy, then exploration noise."""
        factors = self.spec.action_factors or (self.env.action_size,)
        levels = self.spec.config.exploration_noise
        greedy = self.head(params, obs).argmax()
        key, key_noise = jax.random.split(key)
        if self.spec.continuous:
            action = epsilon_greedy_point(key, greedy, epsilon)
            return gaussian_noise(key_noise, action, factors, levels) if levels else action
        action = epsilon_greedy(key, greedy, epsilon, math.prod(factors))
        return exploration_noise(key_noise, action, factors, levels) if levels else action

    def learn(
        self, state: TrainState, config: DQNConfig, key: PRNGKeyArray
    ) -> tuple[TrainState, Means]:
        """The updates of one iteration, once the replay holds `min_replay_size`.

        Returns:
          The state; `loss`, a mean over the updates made, and `skipped_updates`, the share of
          updates whose loss or gradient was not finite.
        """
        count, capacity = self.spec.updates_per_iteration, len(state.replay.data.action)
        ready = state.replay.size >= min(self.spec.per_device(config.min_replay_size), capacity)

        def sample_and_update(learned: UpdateState, key: jax.Array) -> tuple[UpdateState, Mean]:
            batch = self.sample(state.replay, key)
            return self.update(learned, batch, state.statistics, config)

        def all_updates(learned: UpdateState) -> tuple[UpdateState, Mean]:
            keys = jax.random.split(key, count)
            learned, losses = jax.lax.scan(sample_and_update, learned, keys)
            return learned, jax.tree.map(jnp.sum, losses)

        none = Mean(jnp.float32(0.0), jnp.float32(0.0))
        learned = UpdateState(*(getattr(state, name) for name in UpdateState._fields))
        learned, loss = jax.lax.cond(ready, all_updates, lambda same: (same, none), learned)
        skipped = Mean(ready * (count - loss.number), jnp.float32(count))
        return state._replace(**learned._asdict()), {"loss": loss, "skipped_updates": skipped}

    def sample(self, buffer: ReplayState, key: PRNGKeyArray) -> Transition:
        """This device's share of a batch, reflected with `mirror`."""
        config = self.spec.config
        key, key_mirror = jax.random.split(key)
        with jax.named_scope("replay"):
            batch = replay.sample(buffer, key, self.spec.per_device(config.batch_size))
        if config.mirror and self.spec.symmetries is not None:
            return replay.reflect(batch, self.spec.symmetries, key_mirror)
        return batch

    def update(
        self,
        state: UpdateState,
        batch: Transition,
        statistics: RunningStatistics,
        config: DQNConfig,
    ) -> tuple[UpdateState, Mean]:
        """One gradient step, and the target network's copy if it is due.

        Args:
          state: the same on every device, before and after.
          batch: this device's share, (share, ...) per field.
          statistics: for the whitening.
          config: with the swept fields of this run.

        Returns:
          The state, unchanged if loss or gradient are not finite; the loss over all devices, as a
          mean with count 1, or 0 if the step was skipped.
        """

        def loss_of(params: Params) -> jax.Array:
            return self.loss(self.fold(params, statistics), state.target_params, batch, config)

        loss: jax.Array
        loss, grads = mean_over_devices(jax.value_and_grad(loss_of)(state.params))
        # The schedule counts the iterations of the warm-up too, though they make no updates.
        optimizer = make_optimizer(config, self.spec.total_updates)
        updates, opt_state = optimizer.update(grads, state.opt_state, state.params)
        params = optax.apply_updates(state.params, updates)
        gradient_steps = state.gradient_steps + 1
        target_params = jax.lax.cond(
            gradient_steps % config.target_update_period == 0,
            lambda: self.fold(params, statistics),
            lambda: state.target_params,
        )
        new = UpdateState(params, target_params, opt_state, gradient_steps)
        finite = jnp.isfinite(loss) & jnp.isfinite(optax.global_norm(grads))
        state = jax.tree.map(lambda new, old: jnp.where(finite, new, old), new, state)
        return state, Mean(jnp.where(finite, loss, 0.0), finite.astype(jnp.float32))

    def loss(
        self, params: Params, target_params: Params, batch: Transition, config: DQNConfig
    ) -> Float[Array, ""]:
        """Mean squared TD error of a batch, or twice the Huber loss with `huber_delta`.

        With `double`, the online network selects the action that the target network evaluates.
        With `own_loss`, its mean over the batch.
        """

        def of(loss: Loss, t: Transition) -> jax.Array:
            q_tm1, q_t = self.head(params, t.obs), self.head(target_params, t.next_obs)
            q_t_selector = self.head(params, t.next_obs) if config.double else q_t
            discount_t = config.gamma * (1 - t.terminated)
            return loss(q_tm1, t.action, t.reward, discount_t, q_t, q_t_selector)

        if self.own_loss is not None:
            return jnp.mean(jax.vmap(partial(of, self.own_loss))(batch))
        errors = jax.vmap(partial(of, td_error))(batch)
        if config.huber_delta is None:
            return jnp.mean(errors**2)
        return 2 * jnp.mean(optax.losses.huber_loss(errors, delta=config.huber_delta))

    def head(self, params: Params, obs: Float[Array, "*batch obs"]) -> Head:
        """The network's head for raw observations."""
        if isinstance(params, Whitened):
            with jax.default_matmul_precision("highest"):
                params, obs = params.params, (obs - params.mean) @ params.matrix
        if hasattr(self.network, "head"):
            head: Any = self.network.apply(params, obs, method="head")
        else:
            values = self.network.apply(params, obs)
            head = Additive(values, (values.shape[-1],))
        return head.off_grid() if self.spec.continuous else head

    def fold(self, params: Params, statistics: RunningStatistics) -> Params:
        """Folds the whitening into the parameters, which is cheaper than whitening every input.

        If the network has no `fold_whitening`, its parameters become `Whitened`. With
        `zero_at_rest`, the head's best point for an observation of zeros then becomes 0.
        """
        network: Any = self.network
        if self.spec.config.whiten_steps:
            fold = getattr(network, "fold_whitening", Whitened)
            params = fold(params, statistics.mean, statistics.matrix)
        return network.fold_rest(params) if self.spec.config.zero_at_rest else params


def td_error(
    q_tm1: Head,
    a_tm1: Int[Array, ""] | Float[Array, " axes"],
    r_t: Float[Array, ""],
    discount_t: Float[Array, ""],
    q_t: Head,
    q_t_selector: Head,
) -> Float[Array, ""]:
    """TD error of one transition, r_t + discount_t * q_t[argmax q_t_selector] - q_tm1[a_tm1].

    Q-learning if `q_t_selector` is `q_t` (paper Eq. 1); else Double Q-learning (van Hasselt et
    al. 2015, https://arxiv.org/abs/1509.06461, Eq. 4).

    Args:
      q_tm1: action values of the online network at t - 1.
      a_tm1: action at t - 1, an index or a point.
      r_t: reward at t.
      discount_t: gamma, or 0 after a termination.
      q_t: action values of the target network at t.
      q_t_selector: action values that select the action at t.
    """
    a_t = jax.lax.stop_gradient(q_t_selector.argmax())  # a point has a gradient
    return r_t + discount_t * q_t.q_value(a_t) - q_tm1.q_value(a_tm1)


def make_optimizer(config: DQNConfig, gradient_steps: int) -> optax.GradientTransformation:
    """Adam with clipped gradients and a cosine decay of the learning rate to its end share."""
    schedule = optax.cosine_decay_schedule(
        config.learning_rate, max(gradient_steps, 1), config.learning_rate_end_share
    )
    return optax.chain(optax.clip_by_global_norm(config.max_grad_norm), optax.adam(schedule))


def linear_epsilon(config: DQNConfig, env_steps: Int[Array, ""]) -> Float[Array, ""]:
    """Share of random actions: linear from epsilon_start to epsilon_end, then flat.

    epsilon = start + (end - start) * min(env_steps / epsilon_decay_steps, 1)
    """
    # optax.linear_schedule branches on the number of steps, which is an array in a sweep.
    share = jnp.minimum(env_steps / config.epsilon_decay_steps, 1.0)
    return config.epsilon_start + (config.epsilon_end - config.epsilon_start) * share


def epsilon_greedy(
    key: PRNGKeyArray, greedy: jax.Array, epsilon: jax.Array, num_actions: int
) -> Int[Array, ""]:
    """Returns the action index `greedy`, or with probability `epsilon` a uniformly random one."""
    key_which, key_random = jax.random.split(key)
    random = jax.random.randint(key_random, (), 0, num_actions)
    return jnp.where(jax.random.bernoulli(key_which, epsilon), random, greedy.astype(random.dtype))


def exploration_noise(
    key: PRNGKeyArray, action: jax.Array, factors: Sequence[int], levels: int
) -> Int[Array, ""]:
    """Moves each digit of an action index by up to `levels`, uniformly.

    The reward of a greedy action shows its distance from the best action, but not the direction;
    the rewards of its neighbours show the direction.

    Args:
      key: PRNG key.
      action: index, a mixed-radix number.
      factors: number of levels of each digit.
      levels: greatest move; digits are clipped.
    """
    move = jax.random.randint(key, (len(factors),), -levels, levels + 1)
    digits = jnp.stack(jnp.unravel_index(action, tuple(factors))) + move
    digits = jnp.clip(digits, 0, jnp.asarray(factors) - 1)
    return jnp.ravel_multi_index(tuple(digits), tuple(factors), mode="clip").astype(action.dtype)


def epsilon_greedy_point(
    key: PRNGKeyArray, greedy: Float[Array, " axes"], epsilon: jax.Array
) -> Float[Array, " axes"]:
    """Returns the point `greedy`, or with probability `epsilon` a uniformly random one, -1 to 1."""
    key_which, key_random = jax.random.split(key)
    random = jax.random.uniform(key_random, greedy.shape, greedy.dtype, -1.0, 1.0)
    return jnp.where(jax.random.bernoulli(key_which, epsilon), random, greedy)


def gaussian_noise(
    key: PRNGKeyArray, point: Float[Array, " axes"], factors: Sequence[int], levels: int
) -> Float[Array, " axes"]:
    """Moves a point by Gaussian noise, and clips it to -1 to 1.

    The standard deviation is that of `exploration_noise`, sqrt(levels * (levels + 1) / 3) levels.

    Args:
      key: PRNG key.
      point: -1 to 1 on each axis.
      factors: number of levels of each axis.
      levels: as of `exploration_noise`.
    """
    level = 2 / (jnp.asarray(factors, point.dtype) - 1)
    scale = math.sqrt(levels * (levels + 1) / 3) * level
    move = scale * jax.random.normal(key, point.shape, point.dtype)
    return jnp.clip(point + move, -1.0, 1.0)


def step(
    env: Env, state: State, action: jax.Array, key: PRNGKeyArray
) -> tuple[State, Transition, Bool[Array, ""], Means]:
    """Steps this device's envs once and resets those that are done.

    An env has diverged if its transition is not finite; it is done, and its row repeats another
    env's.

    Returns:
      The state, done envs reset; the transitions, (envs, ...) per field, before any reset; whether
      every device has an env that did not diverge; means over all devices of the env's metrics,
      `reward`, and `diverged`, the share of diverged envs.
    """
    after = jax.vmap(env.step)(state, action)
    obs: Any = state.obs
    next_obs: Any = after.obs
    terminated = after.done * (1 - after.info.get("truncation", jnp.zeros_like(after.done)))
    transition = Transition(obs, action, after.reward, terminated, next_obs)
    finite: jax.Array = jax.vmap(all_finite)(transition)
    row = jnp.where(finite, jnp.arange(len(finite)), jnp.argmax(finite))
    valid = jax.lax.pmin(finite.any().astype(jnp.int32), AXIS) > 0
    metrics: dict[str, Any] = after.metrics | {"reward": after.reward}
    diverged: Any = jnp.where(finite, metrics.pop("diverged", jnp.zeros_like(after.done)), 1.0)
    means = {name: mean_where(x, finite) for name, x in metrics.items()}
    means["diverged"] = mean_where(diverged, jnp.ones_like(finite))
    after = after.replace(done=jnp.where(finite, after.done, 1.0))  # pyright: ignore
    after = reset_done(env.reset, after, key)
    return after, jax.tree.map(lambda x: x[row], transition), valid, means


def reset_all(reset: Callable[..., State], key: PRNGKeyArray, count: int) -> State:
    """`count` fresh envs, (count, ...) per leaf."""
    return jax.vmap(reset)(jax.random.split(key, count))


def reset_done(reset: Callable[..., State], state: State, key: PRNGKeyArray) -> State:
    """Replaces the done envs of a batch by fresh ones."""
    new = reset_all(reset, key, len(state.done))
    done = state.done.astype(bool)

    def choose(new: jax.Array, old: jax.Array) -> jax.Array:
        return jnp.where(done.reshape(-1, *[1] * (old.ndim - 1)), new, old)

    return jax.tree.map(choose, new, state)
