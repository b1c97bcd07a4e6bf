"""Calls of the user's code during a run: at its start and end, every log line and validation.

The first process of a run calls them, between two calls of the training program, in the thread that
called `train`.
"""

import contextlib
from collections.abc import Callable, Iterable, Mapping
from pathlib import Path
from typing import Any, TypeAlias

from mjx_balance.config import Config, ConfigError
from mjx_balance.errors import quote

LogFunction: TypeAlias = Callable[[Mapping[str, float]], object]


class Callback:
    """Listens to a run. Override what you need.

    `on_log` and `on_validation` may return True to stop the run: it then saves its state, exports
    its policy and evaluates it. An exception ends the run at once, and `train` raises it.
    """

    def on_start(self, config: Config, folder: Path) -> None:
        """Before the first decision, and again when a run is resumed.

        Args:
          config: of the run, with all sizes filled in.
          folder: its run folder.
        """

    def on_log(self, metrics: Mapping[str, float]) -> bool | None:
        """After every line of metrics.jsonl.

        Args:
          metrics: `env_steps`, `gradient_steps`, `train/...`, `perf/...`, and `eval/...` if the
            policy has just been validated; means over seeds.
        """

    def on_validation(self, metrics: Mapping[str, float]) -> bool | None:
        """After every validation (`Config.eval_every`), before `on_log`; as `on_log`."""

    def on_end(self, evaluation: Mapping[str, Mapping[str, Any]]) -> None:
        """After the evaluation; not if the run fails or is interrupted.

        Args:
          evaluation: suite name -> JSON of `evaluation.rollout.summarize`.
        """

    def close(self) -> None:
        """Called last, also after a failure or an interrupt."""


class Callbacks(Callback):
    """All callbacks of a run as one; a function stands for its `on_log`."""

    def __init__(self, callbacks: Iterable[Callback | LogFunction] = ()):
        """Takes callbacks, and functions of a line's metrics.

        Raises:
          ConfigError: for anything else.
        """
        if not isinstance(callbacks, Iterable):
            raise ConfigError(f"callbacks is {quote(callbacks)}; it must be a list of them")
        self._all = [x if isinstance(x, Callback) else _Logger(x) for x in callbacks]

    def on_start(self, config: Config, folder: Path) -> None:
        """Calls all."""
        for each in self._all:
            each.on_start(config, folder)

    def on_log(self, metrics: Mapping[str, float]) -> bool:
        """Calls all; returns whether one wants to stop."""
        wishes = [each.on_log(metrics) for each in self._all]
        return any(wishes)

    def on_validation(self, metrics: Mapping[str, float]) -> bool:
        """Calls all; returns whether one wants to stop."""
        wishes = [each.on_validation(metrics) for each in self._all]
        return any(wishes)

    def on_end(self, evaluation: Mapping[str, Mapping[str, Any]]) -> None:
        """Calls all."""
        for each in self._all:
            each.on_end(evaluation)

    def close(self) -> None:
        """Calls all, also if one of them fails."""
        with contextlib.ExitStack() as stack:
            for each in reversed(self._all):
                stack.callback(each.close)


class _Logger(Callback):
    """A function as a callback."""

    def __init__(self, function: LogFunction):
        if not callable(function):
            raise ConfigError(
                f"callbacks has {quote(function)}; each must be a Callback, or a function of a "
                "line's metrics"
            )
        self._function = function

    def on_log(self, metrics: Mapping[str, float]) -> bool:
        return bool(self._function(metrics))
