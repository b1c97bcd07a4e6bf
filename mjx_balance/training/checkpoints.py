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

T = TypeVar("T")

KEPT = 2
"""Newest checkpoints that are kept: one, and one to fall back on."""


class CheckpointError(ValueError):
    """Checkpoints that cannot be written, or of which none is whole; the message says where."""


def save(directory: Path, env_steps: int, state: object) -> None:
    """Writes a checkpoint; does nothing if it is already there.

    Args:
      directory: of all checkpoints of a run.
      env_steps: decisions so far.
      state: a pytree of arrays.

    Raises:
      CheckpointError: if it cannot be written; those before it stay.
    """
    path = directory / str(env_steps)
    if path.exists():
        return
    part = path.with_suffix(".part")
    shutil.rmtree(part, ignore_errors=True)
    try:
        part.mkdir(parents=True)
        with _checkpointer() as checkpointer:
            checkpointer.save((part / "state").resolve(), state)
        (part / "sum").write_text(_sum(part / "state"))
        part.rename(path)
    except Exception as error:  # whatever orbax raises on a full disk, say
        said = " ".join(str(error).split())[:300]
        raise CheckpointError(f"the checkpoint {path} cannot be written: {said}") from error
    for stale in saved_steps(directory)[:-KEPT]:
        shutil.rmtree(directory / str(stale))


def restore(directory: Path, like: T, say: Callable[[str], None]) -> T | None:
    """Reads the newest checkpoint that is whole.

    Args:
      directory: of all checkpoints of a run.
      like: a state with the structure, shapes, dtypes and shardings wanted.
      say: told of every damaged one; once a whole one is found, they are removed, as the
        run will come by there again.

    Returns:
      The state, or none if none was ever saved.

    Raises:
      CheckpointError: if there are checkpoints, but none is whole.
    """
    steps = saved_steps(directory)
    for k, step in reversed(list(enumerate(steps))):
        path = directory / str(step)
        state = _read(path, like)
        if state is not None:
            for damaged in steps[k + 1 :]:
                shutil.rmtree(directory / str(damaged))
            return state
        say(f"the checkpoint {path} is damaged" + ("; trying the one before" if k else ""))
    if steps:
        raise CheckpointError(
            f"no checkpoint in {directory} is whole; start a new run with --run-dir"
        )
    return None


def saved_steps(directory: Path) -> list[int]:
    """Decisions after which there is a checkpoint, whole or not, ascending."""
    names = [path.name for path in directory.glob("*")]
    return sorted(int(name) for name in names if name.isascii() and name.isdigit())


def _read(path: Path, like: T) -> T | None:
    """One checkpoint, or none if it is damaged or of another structure."""
    try:
        if (path / "sum").read_bytes() != _sum(path / "state").encode():
            return None
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
