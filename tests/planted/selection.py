"""Which tests notice a change of a module: those that import it, the nearest first."""

import ast
import functools
from collections.abc import Iterator
from pathlib import Path

REPO = Path(__file__).resolve().parents[2]
PACKAGE = "mjx_balance"
CLI = "mjx_balance.cli"
"""Imports its commands by name; `train.py` starts it."""


@functools.cache
def parsed(file: Path) -> ast.Module:
    """A file's syntax tree; do not modify it."""
    return ast.parse(file.read_text())


def sources() -> list[Path]:
    """The package's files, from the repository's root."""
    return [path.relative_to(REPO) for path in sorted((REPO / PACKAGE).rglob("*.py"))]


def name_of(file: Path) -> str:
    """Dotted name of a module of the package."""
    return ".".join(file.with_suffix("").parts).removesuffix(".__init__")


@functools.cache
def modules() -> dict[str, Path]:
    """Dotted name -> file, from the repository's root."""
    return {name_of(file): file for file in sources()}


def imported(tree: ast.AST) -> Iterator[str]:
    """The package's modules that a syntax tree imports anywhere."""
    for node in ast.walk(tree):
        if isinstance(node, ast.Import):
            yield from (alias.name for alias in node.names if alias.name in modules())
        elif isinstance(node, ast.ImportFrom) and node.module in modules():
            for alias in node.names:
                full = f"{node.module}.{alias.name}"
                yield full if full in modules() else node.module


def fixtures(tree: ast.Module) -> set[str]:
    """Names of the fixtures that a file defines."""
    return {
        node.name
        for node in tree.body
        if isinstance(node, ast.FunctionDef)
        and any("fixture" in ast.unparse(decorator) for decorator in node.decorator_list)
    }


@functools.cache
def graph() -> dict[str, set[str]]:
    """Module or test file -> what it imports, or gets from the fixtures of another file."""
    edges = {name: set(imported(parsed(REPO / file))) for name, file in modules().items()}
    tests = {path.relative_to(REPO): parsed(path) for path in sorted(REPO.glob("tests/**/*.py"))}
    shared = {
        file: fixtures(tree)
        for file, tree in tests.items()
        if file.name == "conftest.py" or file.parent.name == "fixtures"
    }
    for file, tree in tests.items():
        arguments = {node.arg for node in ast.walk(tree) if isinstance(node, ast.arg)}
        reach = {
            str(other)
            for other, names in shared.items()
            if other != file
            and names & arguments
            and (other.parent.name == "fixtures" or other.parent in file.parents)
        }
        starts = any(isinstance(x, ast.Constant) and x.value == "train.py" for x in ast.walk(tree))
        edges[str(file)] = set(imported(tree)) | reach | ({CLI} if starts else set())
    edges[CLI] |= {name for name in modules() if name.startswith(f"{CLI}.")}
    return edges


def distances(file: str) -> dict[str, int]:
    """Of all modules that a test file reaches."""
    steps, edge = {file: 0}, [file]
    while edge:
        following = []
        for name in edge:
            for other in graph()[name] - steps.keys():
                steps[other] = steps[name] + 1
                following.append(other)
        edge = following
    return steps


def tests_of(module: str) -> list[list[str]]:
    """Test files that import a module, directly or not, in groups: the nearest first.

    A group is of one distance; tests of the folder that mirrors the module's are all in the first.
    Within a group, a file of the module's name comes first, then those that import the least.
    """
    room = Path("tests", *modules()[module].parts[1:-1])
    reached: dict[int, list[str]] = {}
    for file in graph():
        if Path(file).name.startswith("test_") and module in (steps := distances(file)):
            near = Path(file).parent == room != Path("tests")
            reached.setdefault(1 if near else steps[module], []).append(file)

    def rank(file: str) -> tuple[bool, bool, int]:
        alike = Path(file).stem.removeprefix("test_") == module.rpartition(".")[2]
        return not alike, Path(file).parent != room, len(graph()[file])

    return [sorted(files, key=rank) for _, files in sorted(reached.items())]
