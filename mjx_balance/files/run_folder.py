"""The run folder: file names, atomic writes, the lock, and the checks before a resume. No JAX."""

import contextlib
import errno
import json
import os
import secrets
import shutil
import stat
import sys
from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import Any, BinaryIO

from mjx_balance.errors import PATH, InputError, shell, shorten

if sys.platform == "win32":
    import msvcrt
else:
    import fcntl

READ_AT_MOST = 2**20  #: greatest size of a JSON file of a run, bytes; usual ones have some kB
LONGEST_LINE = 2**22  #: of metrics.jsonl, bytes; thousands of seeds fit
PLACE = 150  #: greatest length of a path in the middle of a message, characters
PART = ".mjx_balance-{}.part"  #: name of a file or folder that is not complete yet


class RunFolderError(InputError):
    """Unusable run folder; the message says why and names a remedy."""


class RunFolderExistsError(RunFolderError):
    """The folder of a new run exists."""

    limit = PATH  # it ends in a command with the user's own path, to be copied


class RunFolder:
    """The paths in a run folder."""

    def __init__(self, path: Path):
        self.path = path
        self.config = path / "config.json"
        self.provenance = path / "provenance.json"  #: scene, engine, versions at the start
        self.lock = path / ".lock"
        self.metrics = path / "metrics.jsonl"
        self.tensorboard = path / "tensorboard"
        self.checkpoints = path / "checkpoints"
        self.validated = path / "validated"  #: policies, in folders named by env steps
        self.seeds_summary = path / "seeds.json"  #: all seeds' results, and the choice
        self.seeds = path / "seeds"  #: with several seeds: the policy and evaluation of each
        self.sweep = path / "sweep.json"  #: results of the combinations of a sweep, the best first
        self.policy = path / "policy.safetensors"
        self.evaluation = path / "evaluation.json"
        self.figures = path / "figures"
        self.drawing = path / ".drawing"  #: there from the evaluation until the figures are drawn
        self.profile = path / "profile"  #: trace of one call of the training program, on request
        self.report = path / "report.json"  #: cached measurements of the report
        self.page = path / "report.html"

    def validated_policy(self, seed: int, env_steps: int) -> Path:
        return self.validated / str(env_steps) / f"seed-{seed}.safetensors"

    def seed_policy(self, seed: int) -> Path:
        return self.seeds / f"seed-{seed}.safetensors"


@contextlib.contextmanager
def replacing(path: Path) -> Iterator[BinaryIO]:
    """Opens a new file, which replaces `path` at the end of the context; follows links.

    Raises:
      OSError: if it cannot be written; the old content then stays.
    """
    part = None
    try:
        target = path.resolve()
        # A name of its own, so that no other process writes to it and no link waits there.
        part = target.parent / PART.format(secrets.token_hex(8))
        with part.open("xb") as file:
            yield file
            file.flush()
            os.fsync(file.fileno())
        part.replace(target)
    except OSError as error:
        error.filename = str(path)  # the user knows no other name
        raise
    finally:
        if part is not None:
            with contextlib.suppress(OSError):
                part.unlink(missing_ok=True)


def write_atomically(path: Path, content: str | bytes) -> None:
    """Writes a file atomically, even if the process or the machine dies.

    Follows links, and writes to pipes and devices directly.

    Raises:
      OSError: if it cannot be written; the old content then stays.
    """
    data = content.encode() if isinstance(content, str) else content
    if path.exists() and not path.is_file() and not path.is_dir():
        path.write_bytes(data)
        return
    with replacing(path) as file:
        file.write(data)


def write_json(path: Path, values: Any) -> None:
    """Writes a JSON file atomically."""
    write_atomically(path, json.dumps(values, indent=2) + "\n")


def create_run_folder(
    path: Path, config: Mapping[str, Any], provenance: Mapping[str, Any]
) -> RunFolder:
    """Creates a run folder with config and provenance (`check_same_provenance`), atomically.

    Raises:
      RunFolderError: if the folder exists or cannot be written; nothing changes then.
    """
    part = path.parent / PART.format(secrets.token_hex(8))
    try:
        if path.exists():
            raise FileExistsError(errno.EEXIST, os.strerror(errno.EEXIST))
        part.mkdir(parents=True)
        write_json(RunFolder(part).config, config)
        write_json(RunFolder(part).provenance, provenance)
        part.rename(path)
    except OSError as error:
        shutil.rmtree(part, ignore_errors=True)
        if os.path.lexists(path) and error.errno in (errno.EEXIST, errno.ENOTEMPTY):
            raise RunFolderExistsError(
                f"run folder {path} exists; choose another with --run-dir, or continue it with "
                f"--resume {shell(path)}"
            ) from error
        reason = error.strerror
        if error.errno == errno.EEXIST:
            reason = f"{shorten(error.filename, PLACE)} is a link to what does not exist"
        raise RunFolderError(
            f"run folder {path} cannot be written: {reason}; choose another with --run-dir"
        ) from error
    return RunFolder(path)


def check_contained(path: Path) -> RunFolder:
    """Returns a run folder if all that we read, write or delete in it lies in it.

    Raises:
      RunFolderError: for a link that leads out of the folder, and for what is neither file nor
        folder, such as a pipe.
    """
    folder, root = RunFolder(path), os.path.realpath(path)
    entries = [str(entry) for entry in vars(folder).values() if entry != path]
    known: set[str] = set()
    while entries:
        entry = entries.pop()
        try:
            mode = os.lstat(entry).st_mode
            if stat.S_ISLNK(mode):
                real = os.path.realpath(entry)
                if os.path.commonpath((root, real)) != root:
                    raise RunFolderError(
                        f"{shorten(entry, PLACE)} is a link that leads out of the run folder; "
                        "put a copy of its target in its place"
                    )
                mode = os.stat(entry).st_mode
                if real in known:
                    continue
                known.add(real)
            if stat.S_ISDIR(mode):
                entries += (each.path for each in os.scandir(entry))
            elif not stat.S_ISREG(mode):
                raise RunFolderError(
                    f"{shorten(entry, PLACE)} is neither a file nor a folder; remove it"
                )
        except OSError as error:
            gone = isinstance(error, FileNotFoundError | NotADirectoryError)
            if gone and not os.path.lexists(entry):
                continue  # never there, or renamed by a run that goes on
            raise RunFolderError(
                f"{shorten(entry, PLACE)} cannot be read: {error.strerror}"
            ) from error
    return folder


@contextlib.contextmanager
def locked(folder: RunFolder) -> Iterator[None]:
    """Locks a run while this process lives; raises `RunFolderError` if another one has the lock."""
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
            pass  # the file system has no locks
        yield


def unfinished_run(path: Path) -> RunFolder:
    """Returns the folder of a run that can be resumed; raises `RunFolderError` for any other."""
    folder = check_contained(path)
    if not folder.config.is_file():
        raise RunFolderError(f"{path} is no run folder: it has no config.json")
    if folder.evaluation.is_file() and not folder.drawing.exists():
        raise RunFolderError(f"the run in {path} is finished; start a new one with --run-dir")
    return folder


def read_json(file: Path) -> Any:
    """Reads a JSON file of a run; raises ValueError if it is unreadable, too large or not JSON."""
    try:
        with file.open("rb") as opened:
            content = opened.read(READ_AT_MOST + 1)
        size = file.stat().st_size / 2**20
    except OSError as error:
        raise ValueError(str(error.strerror)) from error
    if len(content) > READ_AT_MOST:
        raise ValueError(
            f"it is {size:.1f} MiB long; at most {READ_AT_MOST / 2**20:.0f} MiB are read"
        )
    return parse_json(content)


def parse_json(content: bytes) -> Any:
    """Parses JSON; raises ValueError if it is invalid or nested too deep."""
    try:
        return json.loads(content)
    except RecursionError as error:
        raise ValueError("it is nested too deep") from error
    except ValueError as error:  # also text that is not UTF-8, and numbers of 5,000 digits
        raise ValueError(f"it is no JSON: {error}") from error


def check_same_provenance(path: Path, today: Mapping[str, Any]) -> str | None:
    """Compares a run's saved provenance with today's.

    Args:
      path: of the run.
      today: `versions` {library: version}, and by name all else that determines the run.

    Returns:
      A warning if only versions differ, so that the run can go on, but not to the same bits.

    Raises:
      RunFolderError: if the saved file is invalid, or something else differs.
    """
    file = RunFolder(path).provenance
    try:
        saved = read_json(file)
        versions = dict(saved["versions"])
    except (LookupError, TypeError, ValueError) as error:
        raise RunFolderError(
            f"{file} cannot be used: {error}; start a new run with --run-dir"
        ) from error
    for name, value in today.items():
        if name != "versions" and saved.get(name) != value:
            raise RunFolderError(
                f"{path} was started with {name} {shorten(saved.get(name))}, but it is {value} "
                "today; go back to that, or start a new run"
            )
    changed = [
        f"{library} {shorten(versions.get(library), 20)} (now {version})"
        for library, version in today["versions"].items()
        if versions.get(library) != version
    ]
    if not changed:
        return None
    return f"{path} was started with {', '.join(changed)}; it goes on, but not to the same bits"


def keep_metrics_until(path: Path, env_steps: int) -> None:
    """Drops the lines of metrics that a resumed run will write again, and incomplete lines."""
    if not path.is_file():
        return
    with path.open("rb") as old, replacing(path) as new:
        while line := old.readline(LONGEST_LINE):
            with contextlib.suppress(ValueError, KeyError, TypeError, RecursionError):
                if json.loads(line)["env_steps"] <= env_steps:
                    new.write(line.rstrip(b"\n") + b"\n")


def keep_validated_until(directory: Path, env_steps: int) -> None:
    """Drops the policies that a resumed run will validate again, and nothing else."""
    for path in directory.glob("*"):
        if path.name.isdecimal() and int(path.name) > env_steps:
            for pattern in ("seed-*.safetensors", PART.format("*")):
                for file in path.glob(pattern):
                    file.unlink()
            with contextlib.suppress(OSError):  # something else is in it
                path.rmdir()
