"""Events: what changes once, in the middle of an episode, and stays changed.

A load is laid on the trunk or slides, a foot gets onto a slippery patch, a servo weakens.
"""

from collections.abc import Callable
from typing import NamedTuple

import numpy as np
from jaxtyping import Float, Int

from mjx_balance.config import RandomizationConfig
from mjx_balance.robots.catalogue import Robot
from mjx_balance.task import Array
from mjx_balance.task.randomization import DomainParams, load_place

DRAWS = 8  #: uniform random numbers that the event of one env takes
BETWEEN = 0.2, 0.6  #: shares of an episode between which it happens (chosen)


class Event(NamedTuple):
    """The event of one env, or of a batch of them."""

    due: Int[Array, "*batch"]  #: number of the decision from which the rest holds
    payload: Float[Array, "*batch"]  #: mass carried on the trunk, kg
    payload_at: Float[Array, "*batch 3"]  #: where, in the trunk's frame, m
    grip: Float[Array, "*batch legs"]  #: factor on the sliding friction of every foot
    strength: Float[Array, "*batch legs 3"]  #: factor on the position gain of every leg servo


def sample_event(
    ranges: RandomizationConfig,
    robot: Robot,
    params: DomainParams | None,
    decisions: int,
    uniform: Callable[[int], Array],
) -> Event | None:
    """`draw_event`, or None if nothing happens or no parameters are random.

    `uniform` returns so many random numbers in [0, 1) for every env; only an event calls it.
    """
    if params is None or not ranges.happens:
        return None
    return draw_event(ranges, robot, params, decisions, uniform(DRAWS))


def draw_event(
    ranges: RandomizationConfig,
    robot: Robot,
    params: DomainParams,
    decisions: int,
    uniform: Float[Array, "*batch draws"],
) -> Event:
    """Turns `DRAWS` random numbers in [0, 1) into an event within so many `decisions`.

    `params` hold before it; what is not among the ranges stays.
    """
    xp, legs = uniform.__array_namespace__(), len(robot.legs)
    u = xp.moveaxis(uniform, -1, 0)

    def one_of(count: int, draw: Array, least: float, size: Array) -> Array:
        """A factor of 1 for all, but for one of them from `least` to 1."""
        hit = np.arange(count) == xp.floor(count * draw)[..., None]
        return xp.where(hit, (least + (1 - least) * size)[..., None], 1.0).astype(uniform.dtype)

    first, last = BETWEEN
    loaded = ranges.event_payload > 0
    strength = one_of(3 * legs, u[6], ranges.event_strength, u[7])
    return Event(
        due=xp.ceil(decisions * (first + (last - first) * u[0])).astype(int),
        payload=ranges.event_payload * u[1] if loaded else params.payload,
        payload_at=load_place(ranges, u[2], u[3]) if loaded else params.payload_at,
        grip=one_of(legs, u[4], ranges.event_grip, u[5]),
        strength=xp.reshape(strength, (*strength.shape[:-1], legs, 3)),
    )


def params_now(event: Event, params: DomainParams, env_steps: Int[Array, "*batch"]) -> DomainParams:
    """The domain parameters of decision `env_steps`."""
    xp, now = params.payload.__array_namespace__(), env_steps >= event.due
    return params._replace(
        payload=xp.where(now, event.payload, params.payload),
        payload_at=xp.where(now[..., None], event.payload_at, params.payload_at),
        friction=params.friction * xp.where(now[..., None], event.grip, 1.0),
        gain=params.gain * xp.where(now[..., None, None], event.strength, 1.0),
    )
