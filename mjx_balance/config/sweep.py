"""Sweeps: several runs in one program that differ in seed and in numbers of the learner."""

import dataclasses
import itertools
import math
from collections.abc import Mapping

from mjx_balance.config.schema import Config, ConfigError, DQNConfig
from mjx_balance.errors import quote

SWEEPABLE = (
    *("learning_rate", "learning_rate_end_share", "gamma", "huber_delta", "max_grad_norm"),
    *("epsilon_start", "epsilon_end", "epsilon_decay_steps"),
)
"""Fields of `DQNConfig` that may be arrays: they change no shape and no control flow."""
WHOLE = ("epsilon_decay_steps",)  #: integer fields among them
MOST_RUNS = 100_000  #: greatest number of combinations


def sweep_grid(config: Config) -> list[dict[str, float]]:
    """Returns all combinations of the sweep's values as {field: value}, the last field fastest.

    Without a sweep, that is one empty combination.

    Raises:
      ConfigError: if an entry names no field of `SWEEPABLE`, or lists no numbers.
    """
    fields: dict[str, list[float]] = {}
    for entry in config.sweep:
        name, _, listed = entry.partition("=")
        if name not in SWEEPABLE or name in fields:
            raise ConfigError(
                f"sweep is {quote(entry)}; it must name one of {', '.join(SWEEPABLE)}, each at "
                "most once, and its values, as gamma=0.1,0.4"
            )
        try:
            fields[name] = [float(value) for value in listed.split(",")]
        except ValueError as error:
            raise ConfigError(
                f"sweep is {quote(entry)}; after {name}= it must list numbers, as 0.1,0.4"
            ) from error
    if math.prod(map(len, fields.values())) > MOST_RUNS:
        raise ConfigError(
            f"sweep is {quote(config.sweep)}; its values make more than {MOST_RUNS:,} combinations"
        )
    grid = itertools.product(*fields.values())
    return [dict(zip(fields, values, strict=True)) for values in grid]


def with_values(dqn: DQNConfig, values: Mapping[str, float]) -> DQNConfig:
    """Returns `dqn` with the values of one combination of `sweep_grid`."""
    whole = {name: int(x) for name, x in values.items() if name in WHOLE and x.is_integer()}
    return dataclasses.replace(dqn, **{**values, **whole})


def expand_runs(config: Config) -> list[Config]:
    """Returns a config per run: each combination with `num_seeds` seeds; run k has `seed + k`."""
    repeated = [x for x in sweep_grid(config) for _ in range(config.num_seeds)]
    return [
        dataclasses.replace(
            config,
            seed=config.seed + k,
            num_seeds=1,
            sweep=(),
            dqn=with_values(config.dqn, values),
        )
        for k, values in enumerate(repeated)
    ]
