"""The files of a run's folder: their names, and whether they make a run. No JAX.

Whatever is written here is written whole or not at all, so that a run can be killed at any
moment and go on.
"""

import contextlib
import dataclasses
import json
import os
import shutil
import sys
from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import Any

from mjx_balance.errors import InputError
from mjx_balance.files.text import MESSAGE, shorten

if sys.platform == "win32":
    import msvcrt
else:
    import fcntl

READ_AT_MOST = 2**20
"""Bytes of a JSON file of a run; those of ours take some kilobytes."""


class RunFolderError(InputError):
    """A run folder that cannot be used; the message says why and what would do."""


@dataclasses.dataclass(frozen=True)
class RunFolder:
    """Where everything of a run lies."""

    path: Path

    @property
    def config(self) -> Path:
        return self.path / "config.json"

    @property
    def provenance(self) -> Path:
        """What the run was started with besides its config: scene, engine, versions."""
        return self.path / "provenance.json"

    @property
    def lock(self) -> Path:
        """Held by the process that works on the run."""
        return self.path / ".lock"

    @property
    def metrics(self) -> Path:
        return self.path / "metrics.jsonl"

    @property
    def tensorboard(self) -> Path:
        return self.path / "tensorboard"

    @property
    def checkpoints(self) -> Path:
        return self.path / "checkpoints"

    @property
    def validated(self) -> Path:
        """The policies validated during training, in folders named by the decisions made."""
        return self.path / "validated"

    def validated_policy(self, seed: int, env_steps: int) -> Path:
        """The policy of a seed after so many decisions."""
        return self.validated / str(env_steps) / f"seed-{seed}.safetensors"

    @property
    def seeds_summary(self) -> Path:
        """Evaluation, validation and choice among several seeds."""
        return self.path / "seeds.json"

    @property
    def sweep(self) -> Path:
        """What each combination of a sweep's values has come to, the best first."""
        return self.path / "sweep.json"

    @property
    def seeds(self) -> Path:
        """Policy and evaluation of every seed, where there are several."""
        return self.path / "seeds"

    def seed_policy(self, seed: int) -> Path:
        """The policy of one of several seeds."""
        return self.seeds / f"seed-{seed}.safetensors"

    @property
    def policy(self) -> Path:
        return self.path / "policy.safetensors"

    @property
    def evaluation(self) -> Path:
        return self.path / "evaluation.json"

    @property
    def figures(self) -> Path:
        return self.path / "figures"

    @property
    def profile(self) -> Path:
        """A trace of one call of the training program, where one was asked for."""
        return self.path / "profile"

    @property
    def report(self) -> Path:
        """What the report measured, so that it need not be measured again."""
        return self.path / "report.json"


def write_atomically(path: Path, content: str | bytes) -> None:
    """Writes a file whole or not at all, whenever the process or the machine dies.

    Links are followed. A pipe or a device is written to, not replaced.

    Raises:
      OSError: if it cannot be written; what was there before is then still there, and no more.
    """
    data, part = content.encode() if isinstance(content, str) else content, None
    try:
        if path.exists() and not path.is_file() and not path.is_dir():
            path.write_bytes(data)
            return
        target = path.resolve()
        part = target.with_name(f"{target.name}.part")
        with part.open("wb") as file:
            file.write(data)
            file.flush()
            os.fsync(file.fileno())
        part.replace(target)
    except OSError as error:
        if part is not None:
            with contextlib.suppress(OSError):
                part.unlink()
        error.filename = str(path)  # what the user knows of
        raise


def write_json(path: Path, values: Any) -> None:
    """Writes values as a JSON file, as `write_atomically`."""
    write_atomically(path, json.dumps(values, indent=2) + "\n")


def create_run_folder(
    path: Path, config: Mapping[str, Any], provenance: Mapping[str, Any]
) -> RunFolder:
    """Makes a new run folder: it has all it takes to resume from the moment it exists.

    Args:
      path: of the folder.
      config: of the run, in JSON values.
      provenance: what else decides it, in JSON values; see `check_same_provenance`.

    Raises:
      RunFolderError: if it exists or cannot be written; nothing is touched then.
    """
    if path.exists():
        raise RunFolderError(
            f"run folder {path} exists; choose another with --run-dir, or continue it with "
            f"--resume {path}"
        )
    part = path.with_name(f".{path.name}.{os.getpid()}.part")
    shutil.rmtree(part, ignore_errors=True)  # of a dead process of that number
    try:
        part.mkdir(parents=True)
        write_json(RunFolder(part).config, config)
        write_json(RunFolder(part).provenance, provenance)
        part.rename(path)
    except OSError as error:
        shutil.rmtree(part, ignore_errors=True)
        raise RunFolderError(
            f"run folder {path} cannot be written: {error.strerror}; choose another with --run-dir"
        ) from error
    return RunFolder(path)


@contextlib.contextmanager
def locked(folder: RunFolder) -> Iterator[None]:
    """Keeps other processes out of a run; the lock goes when the process does, however it ends.

    Raises:
      RunFolderError: if another process works on the run.
    """
    with folder.lock.open("a+b") as file:
        try:
            if sys.platform == "win32":
                msvcrt.locking(file.fileno(), msvcrt.LK_NBLCK, 1)
            else:
                fcntl.flock(file, fcntl.LOCK_EX | fcntl.LOCK_NB)
        except (BlockingIOError, PermissionError) as error:
            raise RunFolderError(
                f"another process works on the run in {folder.path}; wait for its end, or start "
                "a new run with --run-dir"
            ) from error
        except OSError:
            pass  # a file system that knows no locks
        yield


def unfinished_run(path: Path) -> RunFolder:
    """Finds a run to continue.

    Raises:
      RunFolderError: if `path` is no run folder, or its run is finished.
    """
    folder = RunFolder(path)
    if not folder.config.is_file():
        raise RunFolderError(f"{path} is no run folder: it has no config.json")
    if folder.evaluation.is_file():
        raise RunFolderError(f"the run in {path} is finished; start a new one with --run-dir")
    return folder


def read_json(file: Path) -> Any:
    """Reads a small JSON file of a run; raises ValueError for whatever is wrong with it."""
    try:
        with file.open("rb") as opened:
            content = opened.read(READ_AT_MOST + 1)
        if len(content) > READ_AT_MOST:
            raise ValueError(
                f"it is {file.stat().st_size / 2**20:.1f} MiB long; at most "
                f"{READ_AT_MOST / 2**20:.0f} MiB are read"
            )
        return parse_json(content)
    except OSError as error:
        raise ValueError(str(error.strerror)) from error


def parse_json(content: bytes) -> Any:
    """Parses what a file holds; raises ValueError if it is no JSON, or nested too deep."""
    try:
        return json.loads(content)
    except RecursionError as error:
        raise ValueError("it is nested too deep") from error
    except ValueError as error:  # also text that is not UTF-8, and numbers of 5,000 digits
        raise ValueError(f"it is no JSON: {error}") from error


def check_same_provenance(path: Path, today: Mapping[str, Any]) -> str | None:
    """Compares what a run was started with, besides its config, with what there is today.

    Args:
      path: of the run's folder.
      today: `versions` (library -> version), and whatever else decides the run, by name.

    Returns:
      A sentence if only versions differ: the run may go on, though not to the same bits.

    Raises:
      RunFolderError: naming the first other thing that differs.
    """
    file = RunFolder(path).provenance
    try:
        saved = read_json(file)
        versions = dict(saved["versions"])
    except (LookupError, TypeError, ValueError) as error:
        raise RunFolderError(
            f"{file} cannot be used: {shorten(error, MESSAGE)}; start a new run with --run-dir"
        ) from error
    for name, value in today.items():
        if name != "versions" and saved.get(name) != value:
            raise RunFolderError(
                f"{path} was started with {name} {saved.get(name)}, but it is {value} today; go "
                "back to that, or start a new run"
            )
    changed = [
        f"{library} {versions.get(library)} (now {version})"
        for library, version in today["versions"].items()
        if versions.get(library) != version
    ]
    if not changed:
        return None
    return f"{path} was started with {', '.join(changed)}; it goes on, but not to the same bits"


def keep_metrics_until(path: Path, env_steps: int) -> None:
    """Drops lines that a resumed run will write again, and what a crash left half-written."""
    if not path.is_file():
        return
    lines = []
    for text in path.read_text(errors="replace").splitlines():
        with contextlib.suppress(ValueError, KeyError, TypeError, RecursionError):
            if json.loads(text)["env_steps"] <= env_steps:
                lines.append(f"{text}\n")
    write_atomically(path, "".join(lines))


def keep_validated_until(directory: Path, env_steps: int) -> None:
    """Drops the policies that a resumed run will validate again, as `keep_metrics_until`."""
    for path in directory.glob("*"):
        if path.name.isdecimal() and int(path.name) > env_steps:
            shutil.rmtree(path)
