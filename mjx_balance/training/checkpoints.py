"""Saves and restores the whole training state with orbax."""

import logging
from pathlib import Path
from typing import TypeVar, cast

import orbax.checkpoint as ocp

T = TypeVar("T")

KEPT = 2


class CheckpointError(ValueError):
    """No checkpoint to restore; the message names the folder."""


class Checkpoints:
    """The checkpoints of one run folder, the newest `KEPT` of them."""

    def __init__(self, directory: Path):
        """Opens `directory`, creating it if need be."""
        logging.getLogger("absl").setLevel(logging.ERROR)
        options = ocp.CheckpointManagerOptions(
            max_to_keep=KEPT, create=True, enable_async_checkpointing=False
        )
        self.directory = directory
        self._manager = ocp.CheckpointManager(directory.resolve(), options=options)

    @property
    def latest(self) -> int | None:
        """Env steps of the newest checkpoint, if there is one."""
        return self._manager.latest_step()

    def save(self, env_steps: int, state: object) -> None:
        """Writes `state` whole or not at all; does nothing if it is already there."""
        if env_steps != self.latest:
            self._manager.save(env_steps, args=ocp.args.StandardSave(state))

    def restore(self, like: T) -> T:
        """Reads the newest checkpoint.

        Args:
          like: a state with the structure, shapes, dtypes and shardings wanted.

        Raises:
          CheckpointError: if there is none.
        """
        if self.latest is None:
            raise CheckpointError(f"no checkpoint in {self.directory}; nothing to resume")
        args = ocp.args.StandardRestore(like)
        return cast(T, self._manager.restore(self.latest, args=args))

    def close(self) -> None:
        """Finishes pending work."""
        self._manager.close()
