"""The notebook of the documentation. `make docs` runs it; here is what a run does not show."""

import ast
import importlib
import importlib.util
import json
import re
import subprocess
import sys
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest

import mjx_balance

REPO = Path(__file__).resolve().parent.parent
NOTEBOOK = REPO / "docs" / "tour.ipynb"
CELLS: list[dict[str, Any]] = json.loads(NOTEBOOK.read_text())["cells"]
CODE = ["".join(cell["source"]) for cell in CELLS if cell["cell_type"] == "code"]
API = "".join(page.read_text() for page in (REPO / "docs" / "api").glob("*.md"))


def test_it_is_stored_as_nobody_has_run_it() -> None:
    code = [cell for cell in CELLS if cell["cell_type"] == "code"]
    assert [cell["outputs"] for cell in code] == [[]] * len(code)
    assert {cell["execution_count"] for cell in code} == {None}
    assert not re.findall(r"(?:/home|/root|/tmp|/Users|/content)/", NOTEBOOK.read_text())


def test_every_picture_says_what_is_seen() -> None:
    drawn = [cell for cell in CELLS if "plt.subplots" in "".join(cell["source"])]
    assert drawn
    for cell in drawn:
        assert len(cell["metadata"]["mystnb"]["image"]["alt"].split()) > 10
    assert any("aria-label=" in text for text in CODE)


def used(tree: ast.AST) -> Iterator[str]:
    """Full names of what code takes from our package."""
    for node in ast.walk(tree):
        if isinstance(node, ast.ImportFrom) and (node.module or "").startswith("mjx_balance"):
            yield from (f"{node.module}.{name.name}" for name in node.names)
        elif isinstance(node, ast.Attribute) and ast.unparse(node.value) == "mjx_balance":
            yield f"mjx_balance.{node.attr}"


def test_it_uses_what_the_api_pages_have() -> None:
    modules = set(re.findall(r"automodule:: (\S+)(?!\S|\n   :no-members:)", API))
    members = set(re.findall(r"autofunction:: (\S+)", API))
    names = {name for text in CODE for name in used(ast.parse(text))}
    assert {"mjx_balance.train", "mjx_balance.evaluation.rollout.run_suite"} <= names
    for name in names:
        module, _, member = name.rpartition(".")
        assert hasattr(importlib.import_module(module), member), name
        if module == "mjx_balance":
            assert member in mjx_balance.__all__, name
        else:
            assert not member.startswith("_"), name
            assert module in modules or name in members, f"{name} is not in docs/api"


@pytest.mark.parametrize(("sign", "most"), [("def proportional", 6), ("= Suite(", 10)])
def test_what_is_your_own_takes_few_lines(sign: str, most: int) -> None:
    (text,) = (text for text in CODE if sign in text)
    lines = [line for line in text.splitlines() if line.strip() and "print(" not in line]
    assert len(lines) <= most


class TestInstall:
    """The first cell."""

    @pytest.fixture
    def installed(self, monkeypatch: pytest.MonkeyPatch) -> list[str]:
        """What pip would install, on a machine that has none of it."""
        sources: list[str] = []

        def run(command: list[str], check: bool) -> None:
            assert command[:4] == [sys.executable, "-m", "pip", "install"]
            assert check
            sources.append(command[-1])

        monkeypatch.setattr(subprocess, "run", run)
        monkeypatch.setattr(importlib.util, "find_spec", lambda name: None)
        return sources

    def test_nothing_is_installed_where_it_is(self, monkeypatch: pytest.MonkeyPatch) -> None:
        monkeypatch.setattr(subprocess, "run", lambda *_, **__: pytest.fail("pip was called"))
        exec(CODE[0], {})

    def test_from_the_repository(
        self, installed: list[str], monkeypatch: pytest.MonkeyPatch
    ) -> None:
        for folder in (REPO, NOTEBOOK.parent):
            monkeypatch.chdir(folder)
            exec(CODE[0], {})
        assert installed == [f"{REPO}[train]"] * 2

    def test_from_a_wheel_beside_it(
        self, installed: list[str], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
    ) -> None:
        wheel = tmp_path / "mjx_balance-1.0-py3-none-any.whl"
        wheel.touch()
        monkeypatch.chdir(tmp_path)
        exec(CODE[0], {})
        assert installed == [f"{wheel}[train]"]

    def test_from_nowhere(
        self, installed: list[str], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
    ) -> None:
        (tmp_path / "notebooks").mkdir()
        monkeypatch.chdir(tmp_path / "notebooks")
        with pytest.raises(FileNotFoundError, match=r"upload the wheel of `make dist` .* or clone"):
            exec(CODE[0], {})
        assert not installed
