"""Experiment trackers as a callback of a run: Weights & Biases, and Trackio with the same calls."""

import hashlib
import importlib
import socket
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any

from mjx_balance.config import Config, ConfigError, to_dict
from mjx_balance.errors import MESSAGE, how_to_install, shorten
from mjx_balance.files.run_folder import RunFolder
from mjx_balance.training.callbacks import Callback
from mjx_balance.training.validation import scalars

PROJECT = "mjx_balance"


class Tracker(Callback):
    """Sends a run's metrics to a tracker, under the names of metrics.jsonl.

    A run has the name of its folder and some digits that tell apart folders of one name; a resumed
    run goes on. The evaluation after training is logged as `final/...`. If the tracker fails in
    the middle of a run, the run says so and goes on without it.
    """

    def __init__(self, name: str, log_fn: Callable[[str], object]):
        """Imports the tracker `name`, `wandb` or `trackio`; says by `log_fn` when it fails.

        Raises:
          ConfigError: if it is not installed.
        """
        self._name, self._log_fn, self._steps, self._begun = name, log_fn, 0, False
        try:
            self._module: Any = importlib.import_module(name)
        except ImportError as error:
            raise ConfigError(
                f"track is {name}, which cannot be imported ({shorten(error)}); "
                f"{how_to_install(name)}"
            ) from error

    def on_start(self, config: Config, folder: Path) -> None:
        """Begins or continues the tracker's run.

        Raises:
          ConfigError: if the tracker refuses, for a missing login, say.
        """
        begun = RunFolder(folder).config.stat().st_mtime_ns
        digits = hashlib.sha256(f"{socket.gethostname()}:{folder}:{begun}".encode()).hexdigest()
        name = f"{folder.name}-{digits[:6]}"
        own = {"id": name, "dir": str(folder)} if self._name == "wandb" else {}
        try:
            self._module.init(
                project=PROJECT, name=name, config=to_dict(config), resume="allow", **own
            )
        except Exception as error:
            raise ConfigError(
                f"track is {self._name}, which does not start: {shorten(error, MESSAGE // 2)}"
            ) from error
        self._begun = True

    def on_log(self, metrics: Mapping[str, float]) -> None:
        """Logs a line of metrics at its decisions."""
        self._steps = int(metrics["env_steps"])
        self._log({name: value for name, value in metrics.items() if name != "env_steps"})

    def on_end(self, evaluation: Mapping[str, Mapping[str, Any]]) -> None:
        """Logs the evaluation."""
        values = scalars({suite: dict(result) for suite, result in evaluation.items()})
        self._log({name.replace("eval/", "final/", 1): value for name, value in values.items()})

    def close(self) -> None:
        """Sends what is left."""
        if self._begun:
            self._try(self._module.finish)
        self._begun = False

    def _log(self, values: dict[str, float]) -> None:
        if self._begun:
            self._try(self._module.log, values, step=self._steps)

    def _try(self, call: Callable[..., object], *arguments: Any, **named: Any) -> None:
        try:
            call(*arguments, **named)
        except Exception as error:  # of a server, a network or a full disk elsewhere
            self._begun = False
            reason = shorten(error, MESSAGE // 2) or type(error).__name__
            self._log_fn(f"{self._name} failed, and the run goes on without it: {reason}")
