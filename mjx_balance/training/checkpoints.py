"""Saves and restores the whole training state with orbax, whole or not at all.

A checkpoint is a folder named by the decisions made, `state/` in it as orbax writes it, and
a sum over those files: a damaged one is found out before anything is read from it.
"""

import hashlib
import logging
import shutil
from collections.abc import Callable
from pathlib import Path
from typing import TypeVar, cast

import orbax.checkpoint as ocp

from mjx_balance.errors import InputError
from mjx_balance.files.text import MESSAGE, shorten
from mjx_balance.training.processes import ALONE, Processes

T = TypeVar("T")

KEPT = 2
"""Newest checkpoints that are kept: one, and one to fall back on."""


class CheckpointError(InputError):
    """Checkpoints that cannot be written, or of which none is whole; the message says where."""


def save(directory: Path, env_steps: int, state: object, processes: Processes = ALONE) -> None:
    """Writes a checkpoint; does nothing if it is already there.

    Every process writes its own part of the state; the first one does the rest.

    Args:
      directory: of all checkpoints of a run.
      env_steps: decisions so far.
      state: a pytree of arrays.
      processes: that share the state.

    Raises:
      CheckpointError: if it cannot be written; those before it stay.
    """
    path = directory / str(env_steps)
    part = path.with_suffix(".part")

    def begin() -> bool:
        if path.exists():
            return False
        shutil.rmtree(part, ignore_errors=True)
        part.mkdir(parents=True)
        return True

    def end() -> None:
        (part / "sum").write_text(_sum(part / "state"))
        part.rename(path)
        for stale in saved_steps(directory)[:-KEPT]:
            shutil.rmtree(directory / str(stale))

    try:
        if not processes.broadcast(begin, OSError):
            return
        with _checkpointer() as checkpointer:
            checkpointer.save((part / "state").resolve(), state)
        processes.broadcast(end, OSError)
    except Exception as error:  # whatever orbax raises on a full disk, say
        reason = shorten(error, MESSAGE)
        raise CheckpointError(f"the checkpoint {path} cannot be written: {reason}") from error


def restore(
    directory: Path, like: T, log_fn: Callable[[str], None], processes: Processes = ALONE
) -> T | None:
    """Reads the newest checkpoint that is whole.

    Args:
      directory: of all checkpoints of a run.
      like: a state with the structure, shapes, dtypes and shardings wanted.
      log_fn: told of every damaged one; once a whole one is found, they are removed, as the
        run will come by there again.
      processes: that share the state, as many as they now are.

    Returns:
      The state, or none if none was ever saved.

    Raises:
      CheckpointError: if there are checkpoints, but none is whole.
    """
    steps = processes.broadcast(lambda: saved_steps(directory))
    for k, step in reversed(list(enumerate(steps))):
        path = directory / str(step)
        whole = processes.broadcast(lambda path=path: _is_whole(path))
        state = _read(path, like) if whole else None
        if all(processes.gather(state is not None)):
            for damaged in steps[k + 1 :] if processes.first else ():
                shutil.rmtree(directory / str(damaged))
            return state
        log_fn(f"the checkpoint {path} is damaged" + ("; trying the one before" if k else ""))
    if steps:
        raise CheckpointError(
            f"no checkpoint in {directory} is whole; start a new run with --run-dir"
        )
    return None


def saved_steps(directory: Path) -> list[int]:
    """Decisions after which there is a checkpoint, whole or not, ascending."""
    names = [path.name for path in directory.glob("*")]
    return sorted(int(name) for name in names if name.isascii() and name.isdigit())


def _is_whole(path: Path) -> bool:
    """Whether a checkpoint's files have the sum that they were written with."""
    try:
        return (path / "sum").read_bytes() == _sum(path / "state").encode()
    except OSError:
        return False


def _read(path: Path, like: T) -> T | None:
    """One checkpoint, or none if it is of another structure."""
    try:
        with _checkpointer() as checkpointer:
            return cast(T, checkpointer.restore((path / "state").resolve(), like))
    except Exception:  # whatever orbax and its file formats raise
        return None


def _sum(folder: Path) -> str:
    """Digest of all files of a folder, their names included."""
    digest = hashlib.sha256()
    for path in sorted(folder.rglob("*")):
        if path.is_file():
            digest.update(str(path.relative_to(folder)).encode() + b"\0")
            with path.open("rb") as file:
                digest.update(hashlib.file_digest(file, "sha256").digest())
    return digest.hexdigest()


def _checkpointer() -> ocp.Checkpointer:
    logging.getLogger("absl").setLevel(logging.ERROR)
    return ocp.Checkpointer(ocp.StandardCheckpointHandler())
