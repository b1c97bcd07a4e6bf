"""Planted bugs are found by the shape of what they change, and mutants are measured honestly."""

import ast
import textwrap
from pathlib import Path

import pytest
from planted import bugs, mutants, selection

MOST_LOST = 0.05
"""Share of the planted bugs whose place may be gone before somebody mends the list."""
SOURCE = """
def angle(task, time):
    clock = (
        time  # of the board
        * task.rate
    ) - 1
    return min(clock, 2)


class Board:
    def angle(self, x):
        return max(x, 2 * x)
"""


def place_of(bug: bugs.Bug, source: str = SOURCE) -> str | None:
    """A module's text with the bug in it."""
    source = textwrap.dedent(source)
    place = bugs.find(bug, {"board": ast.parse(source)})
    return None if place is None else ast.unparse(ast.parse(bugs.planted(bug, place, source)))


def test_planted_bugs_have_their_places() -> None:
    """A list that nobody mends is a list of nothing; a few lost ones are no reason to stop."""
    package, listed = bugs.trees(), bugs.listed()
    places = {bug: bugs.find(bug, package) for bug in listed}
    lost = [f"{bug.function}: {bug.old}" for bug, place in places.items() if place is None]
    assert len(listed) <= 120
    assert len(lost) <= MOST_LOST * len(listed), lost
    before = {module: ast.dump(tree) for module, tree in package.items()}
    for bug, place in places.items():
        if place is not None:
            source = (selection.REPO / selection.modules()[place.module]).read_text()
            tree = ast.parse(bugs.planted(bug, place, source))
            assert ast.dump(tree) != before[place.module], bug


@pytest.mark.parametrize(
    ("function", "old", "new", "line"),
    [
        ("angle", "time * task.rate", "time / task.rate", "clock = time / task.rate - 1"),
        ("angle", "A - 1", "A", "clock = time * task.rate"),
        ("board.angle", "clock = A", "clock = 0", "clock = 0"),
        ("Board.angle", "max(A, 2 * A)", "max(A, A)", "return max(x, x)"),
        ("renamed", "min(A, 2)", "max(A, 2)", "return max(clock, 2)"),
    ],
)
def test_a_bug_is_found_by_its_shape(function: str, old: str, new: str, line: str) -> None:
    """Layout, comments, parentheses and the function's name do not matter."""
    text = place_of(bugs.Bug(function, old, new))
    assert text is not None
    assert line in text


@pytest.mark.parametrize("old", ["time - task.rate", "A * B", "min(A, A)", "angle"])
def test_a_bug_without_one_place_is_lost(old: str) -> None:
    """Of another shape, or of two places."""
    assert place_of(bugs.Bug("gone", old, "0")) is None


def test_tests_of_a_module_import_it_the_nearest_first() -> None:
    first, *others = selection.tests_of("mjx_balance.task.tilt")
    further = [file for group in others for file in group]
    assert first[0] == "tests/task/test_tilt.py"
    assert "tests/training/test_stagger.py" in further, "through the fixture `fleet`"
    assert len({*first, *further}) == len(first) + len(further)


@pytest.mark.slow
def test_mutants_are_drawn_from_the_whole_package_and_are_python() -> None:
    drawn = mutants.drawn(12, 3, 1.0)
    assert drawn == mutants.drawn(12, 3, 1.0) != mutants.drawn(12, 4, 1.0)
    assert len({mutant.file for mutant in drawn}) > 6
    for mutant in drawn:
        before = (selection.REPO / mutant.file).read_text()
        assert ast.dump(ast.parse(mutant.content)) != ast.dump(ast.parse(before))
        assert mutant.difference.startswith(f"{mutant.file}:")


def test_the_interval_is_wilsons() -> None:
    """Newcombe 1998, table I: 81 of 263 is 0.2553 to 0.3662."""
    assert mutants.wilson(81, 263) == pytest.approx((0.2553, 0.3662), abs=1e-4)
    assert mutants.wilson(0, 20)[0] == pytest.approx(0, abs=1e-12)


def test_a_result_is_written_between_its_marks(tmp_path: Path) -> None:
    page = tmp_path / "page.md"
    page.write_text("a\n" + "\nold\n".join(mutants.MARKERS) + "\nb\n")
    for result in ("one", "two"):
        mutants.write(page, result, ["file:1 x"])
    assert page.read_text() == "a\n{}\n\ntwo\n\nSurvivors:\n\n- `file:1 x`\n\n{}\nb\n".format(
        *mutants.MARKERS
    )
