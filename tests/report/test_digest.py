"""The digest changes with the code that decides a result, and with no other."""

import ast
import shutil
from pathlib import Path

import pytest

from mjx_balance.report.digest import PACKAGE, code_digest


@pytest.fixture(scope="module")
def copied(tmp_path_factory: pytest.TempPathFactory) -> Path:
    package = tmp_path_factory.mktemp("copy") / "mjx_balance"
    shutil.copytree(PACKAGE, package, ignore=shutil.ignore_patterns("__pycache__"))
    return package


@pytest.mark.parametrize(
    ("name", "decides"),
    [
        ("evaluation/rollout.py", True),
        ("evaluation/controllers.py", True),
        ("evaluation/suites.py", True),
        ("sim/engines/mujoco.py", True),
        ("sim/engines/mjx.py", False),
        ("sim/scene.py", True),
        ("config/__init__.py", True),
        ("task/__init__.py", True),
        ("task/tilt.py", True),
        ("task/actions.py", True),
        ("report/page.py", False),
        ("report/figures.py", False),
        ("dqn/replay.py", False),
        ("envs/balance.py", False),
        ("cli/__init__.py", False),
    ],
)
def test_the_code_that_decides_a_result_is_in_its_digest(
    copied: Path, name: str, decides: bool
) -> None:
    file = copied / name
    text = file.read_text()
    file.write_text(f"{text}\nadded = 1\n")
    changed = code_digest(copied)
    file.write_text(text)
    assert (changed != code_digest()) == decides


@pytest.mark.slow
def test_comments_do_not_decide_a_result(copied: Path) -> None:
    assert code_digest(copied) == code_digest(), "wherever the package lies"
    file = copied / "task" / "tilt.py"
    text = file.read_text()
    said = ast.get_docstring(ast.parse(text))
    assert said is not None
    file.write_text(f"# a comment\n{text.replace(said, 'Other words.')}")
    assert code_digest(copied) == code_digest()
    file.write_text(text)
