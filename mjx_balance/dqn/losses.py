"""Temporal-difference errors for one transition; the caller vmaps."""

import jax
import jax.numpy as jnp


def td_error(
    q_tm1: jax.Array,
    a_tm1: jax.Array,
    r_t: jax.Array,
    discount_t: jax.Array,
    q_t: jax.Array,
    q_t_selector: jax.Array | None = None,
) -> jax.Array:
    """Q-learning error of paper Eq. 1: r + discount * max_a q'(s', a) - q(s, a).

    Args:
      q_tm1: (num_actions,) online values of the first state.
      a_tm1: () index of the action taken there.
      r_t: () reward.
      discount_t: () gamma, or 0 after a termination.
      q_t: (num_actions,) target network's values of the next state.
      q_t_selector: (num_actions,) online values of the next state: given, they
        choose the action that `q_t` values (Double DQN, van Hasselt et al. 2015,
        https://arxiv.org/abs/1509.06461, Eq. 4).

    Returns:
      () the error, whose gradient reaches `q_tm1` alone.

    Raises:
      ValueError: if given a batch.
    """
    ranks = [x.ndim for x in (q_tm1, a_tm1, r_t, discount_t, q_t)]
    if ranks != [1, 0, 0, 0, 1] or (q_t_selector is not None and q_t_selector.ndim != 1):
        raise ValueError(f"td_error takes one transition, ranks [1, 0, 0, 0, 1]; got {ranks}")
    best = q_t.max() if q_t_selector is None else q_t[jnp.argmax(q_t_selector)]
    return jax.lax.stop_gradient(r_t + discount_t * best) - q_tm1[a_tm1]
