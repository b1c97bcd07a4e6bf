"""One gradient step: reflections, loss, clipped Adam, target network.

A step whose loss or gradient is not a finite number is not made.
"""

from collections.abc import Callable
from typing import Any, NamedTuple, Protocol, TypeAlias

import jax
import jax.numpy as jnp
import optax

from mjx_balance.config import DQNConfig
from mjx_balance.dqn.devices import mean_over_devices
from mjx_balance.dqn.means import Mean
from mjx_balance.dqn.replay import Transition
from mjx_balance.policy.heads import Head

Params: TypeAlias = Any
"""A network's variables, a flax pytree."""
QValues: TypeAlias = Callable[[Params, jax.Array], Head]
"""Variables and observations (..., obs_size) -> the values of their actions."""


class LearnerState(NamedTuple):
    """The part of the training state that an update changes."""

    params: Params
    """Of a network that takes whitened observations."""
    target_params: Params
    """Of one that takes raw ones: a copy keeps the whitening of its time."""
    opt_state: optax.OptState
    gradient_steps: jax.Array


class Symmetries(Protocol):
    """Reflections of the env, g of them."""

    @property
    def obs_index(self) -> Any:
        """(g, obs_size) entry of the observation that takes each place."""

    @property
    def obs_sign(self) -> Any:
        """(g, obs_size) its sign there."""

    @property
    def action_index(self) -> Any:
        """(g, num_actions) index that each action becomes."""


def make_optimizer(config: DQNConfig, gradient_steps: int) -> optax.GradientTransformation:
    """Adam with clipped gradients and a cosine from learning_rate to its end share."""
    schedule = optax.cosine_decay_schedule(
        config.learning_rate,
        max(gradient_steps, 1),
        config.learning_rate_end_share,
    )
    return optax.chain(optax.clip_by_global_norm(config.max_grad_norm), optax.adam(schedule))


def mirrored(symmetries: Symmetries, batch: Transition, key: jax.Array) -> Transition:
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


def loss(
    params: Params, target_params: Params, batch: Transition, q_values: QValues, config: DQNConfig
) -> jax.Array:
    """Mean squared TD error () of a batch; of errors beyond `huber_delta`, its tangent there.

    The error is r + discount * max_a q'(s', a) - q(s, a), where q' is the target network and
    the discount is 0 after a termination (paper Eq. 1). With `double` the online network
    chooses the a that q' values (Double DQN, van Hasselt et al. 2015,
    https://arxiv.org/abs/1509.06461, Eq. 4).
    """
    q_tm1 = q_values(params, batch.obs).q_value(batch.action)
    target = q_values(target_params, batch.next_obs)
    selector = q_values(params, batch.next_obs) if config.double else target
    q_t = target.q_value(selector.argmax())
    discount_t = config.gamma * (1 - batch.terminated)
    error = batch.reward + discount_t * q_t - q_tm1
    if config.huber_delta is None:
        return jnp.mean(error**2)
    return 2 * jnp.mean(optax.losses.huber_loss(error, delta=config.huber_delta))


def update(
    state: LearnerState,
    batch: Transition,
    q_values: QValues,
    fold: Callable[[Params], Params],
    optimizer: optax.GradientTransformation,
    config: DQNConfig,
) -> tuple[LearnerState, Mean]:
    """One gradient step on a batch of which each device has its share.

    Args:
      state: the same on every device, before and after.
      batch: (share, ...) per field.
      q_values: what the network makes of parameters and observations.
      fold: puts the whitening of inputs, as it is now, into parameters.
      optimizer: from `make_optimizer`.
      config: the algorithm.

    Returns:
      The state, and the loss over all devices: a mean of one, of none if the step was not made.
    """

    def whitened_loss(params: Params) -> jax.Array:
        return loss(fold(params), state.target_params, batch, q_values, config)

    value: jax.Array
    value, grads = mean_over_devices(jax.value_and_grad(whitened_loss)(state.params))
    updates, opt_state = optimizer.update(grads, state.opt_state, state.params)
    params = optax.apply_updates(state.params, updates)
    gradient_steps = state.gradient_steps + 1
    target_params = jax.lax.cond(
        gradient_steps % config.target_update_period == 0,
        lambda: fold(params),
        lambda: state.target_params,
    )
    sound = jnp.isfinite(value) & jnp.isfinite(optax.global_norm(grads))
    made = LearnerState(params, target_params, opt_state, gradient_steps)
    kept = jax.tree.map(lambda new, old: jnp.where(sound, new, old), made, state)
    return kept, Mean(jnp.where(sound, value, 0.0), sound.astype(jnp.float32))
