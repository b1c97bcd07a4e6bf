"""Plants bugs, one at a time, and tells which of them the tests do not notice.

Every `*.toml` beside this file lists one-line bugs of one area:

    [[bug]]
    file = "mjx_balance/task/tilt.py"
    old = "since = clock - period * task.target_period"  # occurs once in the file
    new = "since = clock"
    tests = "tests/test_tilt.py"  # what should notice: pytest's arguments
    equivalent = "..."  # only for a bug that changes nothing anyone could see: why

Each is planted in a copy of the working tree, and the tests are run there until the first
fails. A bug is caught if a test fails or the run hangs; `make bugs` prints the survivors.

    python tests/planted/run.py [--only AREA ...] [--write benchmarks/README.md]
"""

import argparse
import os
import shutil
import subprocess
import sys
import tempfile
import time
import tomllib
from pathlib import Path
from typing import NamedTuple

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


def tests_pass(where: Path, tests: str) -> bool:
    """Runs tests in a copy until the first fails."""
    command = [sys.executable, "-m", "pytest", "-x", "-q", "-p", "no:cacheprovider", *tests.split()]
    environment = os.environ | {"PYTHONPATH": str(where), "PYTHONDONTWRITEBYTECODE": "1"}
    try:
        done = subprocess.run(
            command, cwd=where, env=environment, capture_output=True, text=True, timeout=TIMEOUT
        )
    except subprocess.TimeoutExpired:
        return False
    if done.returncode not in (0, 1, 2):  # 1: a test failed, 2: the bug broke an import
        raise SystemExit(f"pytest {tests} cannot run:\n{done.stdout[-2000:]}{done.stderr[-2000:]}")
    return done.returncode == 0


def caught(where: Path, bug: Bug) -> bool:
    """Plants a bug in a copy, runs its tests, and takes it out again."""
    path = where / bug.file
    whole = path.read_text()
    if whole.count(bug.old) != 1:
        raise SystemExit(f"{bug.file}: {bug.old!r} occurs {whole.count(bug.old)} times, not once")
    path.write_text(whole.replace(bug.old, bug.new))
    try:
        return not tests_pass(where, bug.tests)
    finally:
        path.write_text(whole)


def report(lines: list[str], page: Path | None) -> None:
    """Prints lines, and puts them between the markers of a Markdown file."""
    print("\n".join(lines))
    if page is not None:
        before, rest = page.read_text().split(MARKERS[0])
        after = rest.split(MARKERS[1])[1]
        page.write_text("\n\n".join((before + MARKERS[0], *lines, MARKERS[1] + after)))


def main() -> int:
    """Plants every bug; returns 1 if one survives that has no excuse."""
    parser = argparse.ArgumentParser()
    parser.add_argument("--only", nargs="+", help="areas: names of the lists without .toml")
    parser.add_argument("--match", default="", help="only bugs whose file or lines hold this text")
    parser.add_argument("--write", type=Path, help="Markdown file with markers")
    args = parser.parse_args()
    bugs = [bug for bug in listed(args.only) if args.match in f"{bug.file} {bug.old} {bug.new}"]
    survivors = []
    began = time.perf_counter()
    with tempfile.TemporaryDirectory() as folder:
        where = Path(folder)
        copy_tree(where)
        for tests in sorted({bug.tests for bug in bugs}):
            if not tests_pass(where, tests):
                raise SystemExit(f"{tests} fails without a bug; mend that first")
        for bug in bugs:
            ok = caught(where, bug)
            if not ok:
                survivors.append(bug)
            print("caught  " if ok else "SURVIVED", bug.file, "|", bug.new, flush=True)
    minutes = (time.perf_counter() - began) / 60
    unexcused = [bug for bug in survivors if bug.equivalent is None]
    lines = [f"{len(bugs) - len(survivors)} of {len(bugs)} caught, in {minutes:.0f} min."]
    for bug in survivors:
        why = bug.equivalent or "not excused"
        lines.append(f"Survived: `{bug.file}`, `{bug.new}` instead of `{bug.old}` ({why})")
    report(lines, args.write)
    return 1 if unexcused else 0


if __name__ == "__main__":
    sys.exit(main())
