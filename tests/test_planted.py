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
        words = bug.tests.split()
        files = [REPO / word.split("::")[0] for word in words if word.startswith("tests/")]
        assert all(file.exists() for file in files), bug.tests
        if "-k" in words:
            said = "".join(file.read_text() for file in files if file.is_file())
            assert words[words.index("-k") + 1] in said, bug.tests
