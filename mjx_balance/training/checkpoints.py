"""Saves and restores the whole training state with orbax, whole or not at all.

A checkpoint is a folder named by the decisions so far, with orbax's files in `state/` and a
checksum of them in `sum`, which is compared before anything is read.
"""

import contextlib
import errno
import hashlib
import logging
import os
import shutil
import sys
import time
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any, TypeVar, cast

import orbax.checkpoint as ocp

from mjx_balance.errors import MESSAGE, PATH, InputError, shorten
from mjx_balance.training.processes import ALONE, Processes

T = TypeVar("T")

REMOVAL_S = 5.0  #: longest time to remove an incomplete checkpoint, s
NEWEST = 2  #: checkpoints that stay: one, and one to fall back on


class CheckpointError(InputError):
    """Checkpoints of which none is whole; the message says where."""


class SaveError(CheckpointError):
    """A checkpoint, or another file of a run, that cannot be written; the message says why."""

    limit = PATH  # it ends in a command with the user's own path, to be copied


def save(directory: Path, env_steps: int, state: object, processes: Processes = ALONE) -> None:
    """Writes a checkpoint of a pytree of arrays, unless one with these `env_steps` exists.

    Every process writes its own part of the state; the first one does the rest. Raises
    `SaveError` if it cannot be written; those before it stay.
    """
    path = directory / str(env_steps)
    part = path.with_suffix(".part")

    def begin() -> bool:
        if _is_ours(path):
            return False
        if _is_ours(part):  # of a process that was killed
            shutil.rmtree(part)
        part.mkdir(parents=True)
        return True

    def end() -> None:
        (part / "sum").write_text(_sum(part / "state"))
        part.rename(path)
        for stale in saved_steps(directory)[:-NEWEST]:
            shutil.rmtree(directory / str(stale))

    try:
        if processes.broadcast(begin, OSError):
            with _no_echoes(), _checkpointer() as checkpointer:
                checkpointer.save((part / "state").resolve(), state)
            processes.broadcast(end, OSError)
    except Exception as error:  # whatever orbax raises on a full disk, say
        if processes.first:
            _remove(part)
        raise SaveError(f"the checkpoint {path} cannot be written: {_reason(error)}") from error


@contextlib.contextmanager
def _no_echoes() -> Iterator[None]:
    """Hides the errors of writes that fail after the first, for which orbax does not wait.

    TensorStore prints them, also a moment later.
    """
    hook = sys.unraisablehook

    def others(raised: Any) -> None:
        if str(raised.exc_value) != "Event loop is closed":
            hook(raised)

    sys.unraisablehook = others
    yield
    sys.unraisablehook = hook  # not after a failure


def _remove(part: Path) -> None:
    """Removes what a failed save leaves, into which threads may still write for a moment."""
    until = time.monotonic() + REMOVAL_S
    while _is_ours(part) and time.monotonic() < until:
        shutil.rmtree(part, ignore_errors=True)
        time.sleep(0.1)


def _reason(error: Exception) -> str:
    """The system's words, which orbax's libraries quote among many others; else the error's."""
    text = str(error)
    words = (os.strerror(number) for number in errno.errorcode)
    return next((word for word in words if word in text), shorten(text, MESSAGE))


def restore(
    directory: Path, like: T, log_fn: Callable[[str], None], processes: Processes = ALONE
) -> T | None:
    """Reads the newest checkpoint that is whole; None if none was ever saved.

    Damaged ones are logged, and removed if an older one is whole: the run will come by there again.

    Args:
      directory: of all checkpoints of a run.
      like: a state of the same structure, shapes, dtypes and shardings.
      log_fn: takes a line for the user.
      processes: that share the state, as many as they now are.

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
        cause = "holds the state of another version of mjx_balance" if whole else "is damaged"
        log_fn(f"the checkpoint {path} {cause}" + ("; trying the one before" if k else ""))
    if steps:
        raise CheckpointError(
            f"no checkpoint in {directory} is whole and of this version; start a new run with "
            "--run-dir"
        )
    return None


def saved_steps(directory: Path) -> list[int]:
    """Decisions after which there is a checkpoint, whole or not, ascending."""
    names = [path.name for path in directory.glob("*") if _is_ours(path)]
    return sorted(int(name) for name in names if name.isascii() and name.isdigit())


def _is_ours(path: Path) -> bool:
    """Whether this is the folder of a checkpoint, whole or not: only such are deleted."""
    if path.is_symlink() or not path.is_dir():
        return False
    names = os.listdir(path)  # orbax renames state.orbax-checkpoint-tmp
    return not names or any(name.partition(".")[0] in ("state", "sum") for name in names)


def _is_whole(path: Path) -> bool:
    try:
        return (path / "sum").read_bytes() == _sum(path / "state").encode()
    except OSError:
        return False


def _read(path: Path, like: T) -> T | None:
    """One checkpoint, or None if it has another structure."""
    try:
        with _checkpointer() as checkpointer:
            return cast(T, checkpointer.restore((path / "state").resolve(), like))
    except Exception:  # whatever orbax and its file formats raise
        return None


def _sum(folder: Path) -> str:
    """Digest of all files of a folder, their names included."""
    digest = hashlib.sha256()
    for path in sorted(path for path in folder.rglob("*") if path.is_file()):
        digest.update(str(path.relative_to(folder)).encode() + b"\0")
        with path.open("rb") as file:
            digest.update(hashlib.file_digest(file, "sha256").digest())
    return digest.hexdigest()


def _checkpointer() -> ocp.Checkpointer:
    for name in ("absl", "asyncio", "concurrent.futures"):  # what fails is raised too
        logging.getLogger(name).setLevel(logging.CRITICAL)
    return ocp.Checkpointer(ocp.StandardCheckpointHandler())
