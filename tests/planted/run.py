"""Plants bugs, one at a time, and tells which of them the tests do not notice.

Every `*.toml` beside this file lists one-line bugs of one area:

    [[bug]]
    file = "mjx_balance/task/tilt.py"
    old = "since = clock - period * task.target_period"  # occurs once in the file
    new = "since = clock"
    tests = "tests/task/test_tilt.py"  # what should notice: pytest's arguments
    equivalent = "..."  # only for a bug that changes nothing anyone could see: why

Each is planted in a copy of the working tree, and the tests are run there until the first
fails. A bug is caught if a test fails or the run hangs; `make bugs` prints the survivors.
The libraries are imported once, and every run is a fork.

    python tests/planted/run.py [--only AREA ...] [--jobs 2] [--write benchmarks/README.md]
"""

import argparse
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
import tomllib
from pathlib import Path
from typing import NamedTuple

import pytest

REPO = Path(__file__).resolve().parents[2]
TIMEOUT = 600.0
"""Seconds after which a run counts as hung."""
MARKERS = ("<!-- planted: written by tests/planted/run.py -->", "<!-- end of planted -->")


class Bug(NamedTuple):
    """One line that is replaced by a wrong one."""

    area: str
    file: str
    old: str
    new: str
    tests: str
    equivalent: str | None = None


def listed(only: list[str] | None = None) -> list[Bug]:
    """All bugs, or those of some areas."""
    found = []
    for path in sorted(Path(__file__).parent.glob("*.toml")):
        if not only or path.stem in only:
            entries = tomllib.loads(path.read_text())["bug"]
            found += [Bug(path.stem, **entry) for entry in entries]
    return found


def copy_tree(where: Path) -> None:
    """Copies what git knows of the working tree, and what it does not ignore."""
    command = ["git", "ls-files", "--cached", "--others", "--exclude-standard"]
    names = subprocess.run(command, cwd=REPO, capture_output=True, text=True, check=True).stdout
    for name in names.splitlines():
        if (REPO / name).is_file():
            (where / name).parent.mkdir(parents=True, exist_ok=True)
            shutil.copy2(REPO / name, where / name)


def set_folder(folder: str) -> None:
    """Where this process, and what it starts, puts its files."""
    tempfile.tempdir = os.environ["TMPDIR"] = folder


@functools.cache
def own_copy() -> Path:
    """This process' copy of the tree."""
    where = Path(tempfile.mkdtemp(prefix="planted-"))
    copy_tree(where)
    return where


class Witness:
    """A plugin of pytest that writes down which test failed."""

    def __init__(self, file: Path):
        """Writes to `file`."""
        self.file = file

    def pytest_runtest_logreport(self, report: pytest.TestReport) -> None:
        """Called by pytest after every phase of a test."""
        if report.failed:
            self.file.write_text(report.nodeid)


def failing(tests: str) -> str | None:
    """Runs tests in this process' copy, in a fork, until the first fails.

    Returns:
      What failed, or none if all passed.
    """
    where = own_copy()
    witness = where / "failed.txt"
    witness.unlink(missing_ok=True)
    child = os.fork()
    if not child:
        run_pytest(where, tests, witness)
    deadline = time.monotonic() + TIMEOUT
    while time.monotonic() < deadline:
        done, status = os.waitpid(child, os.WNOHANG)
        if done:
            code = os.waitstatus_to_exitcode(status)
            if code in (pytest.ExitCode.USAGE_ERROR, pytest.ExitCode.NO_TESTS_COLLECTED):
                raise RuntimeError(f"pytest {tests} cannot run: exit code {code}")
            if code == 0:
                return None
            return witness.read_text() if witness.is_file() else "the import"
        time.sleep(0.05)
    os.killpg(child, signal.SIGKILL)
    os.waitpid(child, 0)
    return "the time limit"


def run_pytest(where: Path, tests: str, witness: Path) -> None:
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
        code = pytest.main(
            ["-x", "-q", "-p", "no:cacheprovider", *tests.split()], [Witness(witness)]
        )
    finally:
        os._exit(code)


def caught(bug: Bug) -> str | None:
    """Plants a bug in this process' copy, and takes it out again; returns what noticed it."""
    path = own_copy() / bug.file
    whole = path.read_text()
    if whole.count(bug.old) != 1:
        raise RuntimeError(f"{bug.file}: {bug.old!r} occurs {whole.count(bug.old)} times, not once")
    path.write_text(whole.replace(bug.old, bug.new))
    try:
        return failing(bug.tests)
    finally:
        path.write_text(whole)


def preload() -> None:
    """Imports what most tests import; none of it starts a thread or a device yet."""
    for name in ("jax.numpy", "flax.linen", "optax", "orbax.checkpoint", "mujoco", "scipy.stats"):
        with contextlib.suppress(ImportError):
            importlib.import_module(name)


def rows(bugs: list[Bug], survivors: list[Bug]) -> dict[str, str]:
    """A row of the table for each area."""
    found = {}
    for area in sorted({bug.area for bug in bugs}):
        of = [bug for bug in bugs if bug.area == area]
        left = [bug for bug in survivors if bug.area == area]
        said = [f"`{bug.new}` for `{bug.old}` ({bug.equivalent or 'not excused'})" for bug in left]
        caught = len(of) - len(left)
        found[area] = f"| `{area}` | {caught} of {len(of)} | {'; '.join(said) or '-'} |"
    return found


def write(found: dict[str, str], page: Path) -> None:
    """Puts rows into the table between the markers of a Markdown file; other areas' rows stay."""
    before, rest = page.read_text().split(MARKERS[0])
    table, after = rest.split(MARKERS[1])
    old = {line.split("`")[1]: line for line in table.splitlines() if line.startswith("| `")}
    lines = [
        "| list | caught | survivors |",
        "|---|---|---|",
        *dict(sorted((old | found).items())).values(),
    ]
    page.write_text("\n\n".join((before + MARKERS[0], "\n".join(lines), MARKERS[1] + after)))


def main() -> int:
    """Plants every bug; returns 1 if one survives that has no excuse."""
    parser = argparse.ArgumentParser()
    parser.add_argument("--only", nargs="+", help="areas: names of the lists without .toml")
    parser.add_argument("--match", default="", help="only bugs whose file or lines hold this text")
    parser.add_argument("--write", type=Path, help="Markdown file with markers")
    parser.add_argument("--jobs", type=int, default=os.cpu_count(), help="runs at once")
    args = parser.parse_args()
    bugs = [bug for bug in listed(args.only) if args.match in f"{bug.file} {bug.old} {bug.new}"]
    survivors = []
    began = time.perf_counter()
    preload()
    with (
        tempfile.TemporaryDirectory(prefix="planted-") as folder,
        multiprocessing.get_context("fork").Pool(args.jobs, set_folder, (folder,)) as pool,
    ):
        controls = sorted({bug.tests for bug in bugs})
        for tests, failed in zip(controls, pool.imap(failing, controls), strict=True):
            if failed:
                raise SystemExit(f"{failed} of {tests} fails without a bug; mend that first")
        for bug, by in zip(bugs, pool.imap(caught, bugs), strict=True):
            if by is None:
                survivors.append(bug)
            said = f"caught by {by}" if by else "SURVIVED"
            print(f"{bug.file} | {bug.new.strip()} | {said}", flush=True)
    minutes = (time.perf_counter() - began) / 60
    print(f"{len(bugs) - len(survivors)} of {len(bugs)} caught, in {minutes:.0f} min.")
    found = rows(bugs, survivors)
    print("\n".join(found.values()))
    if args.write:
        write(found, args.write)
    return int(any(bug.equivalent is None for bug in survivors))


if __name__ == "__main__":
    sys.exit(main())
