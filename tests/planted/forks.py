"""Runs tests on a changed copy of the tree, each time in a fork that has imported the libraries."""

import contextlib
import functools
import importlib
import multiprocessing
import os
import shutil
import signal
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable, Iterator, Sequence
from pathlib import Path
from typing import TypeVar

import pytest
from planted.selection import REPO

HANG_S = 240.0
"""Seconds after which a single test counts as hung."""
Work = TypeVar("Work")
Result = TypeVar("Result")


def copy_tree(where: Path) -> None:
    """Copies what git knows of the working tree, and what it does not ignore."""
    command = ["git", "ls-files", "--cached", "--others", "--exclude-standard"]
    names = subprocess.run(command, cwd=REPO, capture_output=True, text=True, check=True).stdout
    for name in names.splitlines():
        if (REPO / name).is_file():
            (where / name).parent.mkdir(parents=True, exist_ok=True)
            shutil.copy2(REPO / name, where / name)


@functools.cache
def own_copy() -> Path:
    """This process' copy of the tree."""
    where = Path(tempfile.mkdtemp(prefix="planted-"))
    copy_tree(where)
    return where


class Witness:
    """A pytest plugin that writes down which test runs, and which one failed."""

    def __init__(self, folder: Path):
        self.running, self.failed = folder / "running.txt", folder / "failed.txt"
        for file in (self.running, self.failed):
            file.unlink(missing_ok=True)

    def pytest_runtest_logstart(self, nodeid: str) -> None:
        self.running.write_text(nodeid)

    def pytest_runtest_logreport(self, report: pytest.TestReport) -> None:
        if report.failed:
            self.failed.write_text(report.nodeid)


def noticed(groups: list[list[str]], seconds: float) -> str | None:
    """Runs groups of test files until the first failure, the nearest with their slow tests."""
    until = time.monotonic() + seconds
    runs: list[tuple[list[str], str | None]] = [(group, None) for group in groups]
    runs[2:2] = [(group, "slow and not sb3 and not long") for group in groups[:1]]
    for files, marker in runs:
        left = until - time.monotonic()
        if left > 0 and (failed := failing(files, left, marker)):
            return failed
    return None


def failing(files: Sequence[str], seconds: float, marker: str | None = None) -> str | None:
    """Runs test files in this process' copy, in a fork, until the first failure.

    Args:
      files: paths from the repository's root, run in this order.
      seconds: for how long to run.
      marker: their tests, as pytest's `-m`; None: those that run by default.

    Returns:
      What failed, or None if nothing did in the time.
    """
    where = own_copy()
    witness = Witness(where)
    child = os.fork()
    if not child:
        _become_pytest(where, [*(["-m", marker] if marker else []), *files], witness)
    begin = time.monotonic()
    while (now := time.monotonic()) - begin < seconds + HANG_S:
        done, status = os.waitpid(child, os.WNOHANG)
        if done:
            code = os.waitstatus_to_exitcode(status)
            if code in (0, pytest.ExitCode.NO_TESTS_COLLECTED):
                return None
            # With the files there, it is a conftest that cannot be imported.
            there = all((where / file).is_file() for file in files)
            if code == pytest.ExitCode.USAGE_ERROR and not there:
                raise RuntimeError(f"pytest {' '.join(files)} cannot run")
            return witness.failed.read_text() if witness.failed.is_file() else "the import"
        with contextlib.suppress(FileNotFoundError):
            if now - begin > seconds and time.time() - witness.running.stat().st_mtime < seconds:
                break
        time.sleep(0.05)
    hung = now - begin >= seconds + HANG_S
    os.killpg(child, signal.SIGKILL)
    os.waitpid(child, 0)
    return "the time limit" if hung else None


def _become_pytest(where: Path, arguments: list[str], witness: Witness) -> None:
    """The child: becomes a pytest in `where`; does not return."""
    code = 1
    try:
        os.setsid()
        os.chdir(where)
        silence = os.open(os.devnull, os.O_WRONLY)
        for stream in (1, 2):
            os.dup2(silence, stream)
        sys.path.insert(0, str(where))
        os.environ |= {"PYTHONPATH": str(where), "PYTHONDONTWRITEBYTECODE": "1"}
        sys.dont_write_bytecode = True
        # Of the pool's worker that this is a fork of: it would forbid tests to start processes.
        multiprocessing.current_process()._config.pop("daemon", None)  # pyright: ignore
        code = pytest.main(["-x", "-q", "-p", "no:cacheprovider", *arguments], [witness])
    finally:
        os._exit(code)


@contextlib.contextmanager
def changed(file: Path, content: str) -> Iterator[None]:
    """Another content for a file of this process' copy, for a while."""
    path = own_copy() / file
    before = path.read_text()
    path.write_text(content)
    try:
        yield
    finally:
        path.write_text(before)


def run_all(
    function: Callable[[Work], Result], work: list[Work], jobs: int
) -> Iterator[tuple[Work, Result]]:
    """Calls a function for all work, in several processes; yields in the order of the work."""
    for name in ("jax.numpy", "flax.linen", "optax", "orbax.checkpoint", "mujoco", "scipy.stats"):
        with contextlib.suppress(ImportError):  # none of them starts a thread or a device yet
            importlib.import_module(name)
    with (
        tempfile.TemporaryDirectory(prefix="planted-") as folder,
        multiprocessing.get_context("fork").Pool(jobs, _set_folder, (folder,)) as pool,
    ):
        yield from zip(work, pool.imap(function, work), strict=True)


def _set_folder(folder: str) -> None:
    """Where this process, and what it starts, puts its files."""
    tempfile.tempdir = os.environ["TMPDIR"] = folder
