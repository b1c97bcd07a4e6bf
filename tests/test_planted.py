"""The list of planted bugs is true to today's code."""

import importlib.util
from pathlib import Path

import pytest

REPO = Path(__file__).parent.parent
SPEC = importlib.util.spec_from_file_location("planted", REPO / "tests/planted/run.py")
assert SPEC is not None
assert SPEC.loader is not None
planted = importlib.util.module_from_spec(SPEC)
SPEC.loader.exec_module(planted)


@pytest.mark.parametrize("area", sorted({bug.area for bug in planted.listed()}))
def test_every_planted_bug_has_its_line(area: str) -> None:
    """A line that moved on would leave its bug unplanted, and the tool without a finding."""
    for bug in planted.listed([area]):
        count = (REPO / bug.file).read_text().count(bug.old)
        assert count == 1, f"{bug.file}: {bug.old!r} occurs {count} times"
        assert bug.new != bug.old
        for test in bug.tests.split():
            if test.startswith("tests/"):
                assert (REPO / test.split("::")[0]).is_file(), test
