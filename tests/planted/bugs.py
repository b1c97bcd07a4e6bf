"""Plants the bugs of bugs.toml, one at a time, and lists those that no test notices.

A bug is a change of one expression or statement of one function, matched by its syntax tree:
layout, parentheses and the module that holds the function do not matter, and a capital letter
stands for any expression (`A - B * task.target_period`). A bug whose function has another name
is found if its expression occurs only once in the package.

    make bugs [ARGS="--match NAME --jobs 2 --seconds 300"]
"""

import argparse
import ast
import functools
import os
import string
import sys
import time
import tomllib
from collections.abc import Iterator
from pathlib import Path
from typing import NamedTuple

from planted import forks
from planted.selection import REPO, modules, parsed, tests_of

LIST = Path(__file__).with_name("bugs.toml")
Captured = dict[str, ast.AST]


class Bug(NamedTuple):
    """A change that tests must notice."""

    function: str
    """Its name, as qualified as it needs to be: `draw`, `Policy.fingerprint`, `tilt.draw`."""
    old: str
    new: str


class Place(NamedTuple):
    """Where a bug is planted."""

    module: str
    node: ast.AST
    captured: Captured


def listed(path: Path = LIST) -> list[Bug]:
    """All bugs of the list."""
    return [Bug(*entry) for entry in tomllib.loads(path.read_text())["bugs"]]


def pattern(text: str) -> ast.AST:
    """An expression or one statement."""
    [node] = ast.parse(text).body
    return node.value if isinstance(node, ast.Expr) else node


def match(shape: object, node: object, captured: Captured) -> bool:
    """Whether a syntax tree has the pattern's shape; fills in what capital letters stand for."""
    if isinstance(shape, ast.Name) and shape.id in string.ascii_uppercase:
        known = captured.setdefault(shape.id, node)  # pyright: ignore
        return isinstance(node, ast.expr) and ast.dump(known) == ast.dump(node)
    if isinstance(shape, ast.AST):
        fields = (name for name in shape._fields if name not in ("ctx", "type_comment", "kind"))
        return type(shape) is type(node) and all(
            match(getattr(shape, name), getattr(node, name), captured) for name in fields
        )
    if isinstance(shape, list):
        return (
            isinstance(node, list)
            and len(shape) == len(node)
            and all(match(a, b, captured) for a, b in zip(shape, node, strict=True))
        )
    return type(shape) is type(node) and shape == node


def matches(shape: ast.AST, tree: ast.AST) -> Iterator[tuple[ast.AST, Captured]]:
    """Every node that has the pattern's shape."""
    for node in ast.walk(tree):
        captured: Captured = {}
        if isinstance(node, (ast.expr, ast.stmt)) and match(shape, node, captured):
            yield node, captured


@functools.cache
def functions(tree: ast.AST, prefix: str) -> list[tuple[str, ast.AST]]:
    """Dotted names and nodes of functions, classes and whatever they hold."""
    nodes = [
        x for x in ast.iter_child_nodes(tree) if isinstance(x, (ast.FunctionDef, ast.ClassDef))
    ]
    named = [(f"{prefix}.{node.name}", node) for node in nodes]
    return [x for name, node in named for x in [(name, node), *functions(node, name)]]


def find(bug: Bug, trees: dict[str, ast.Module]) -> Place | None:
    """The one place of a bug: in a function of its name, or else in the package.

    Args:
      bug: what is to be planted.
      trees: syntax tree of each module, by dotted name.
    """
    shape = pattern(bug.old)
    named = [
        (module, node)
        for module, tree in trees.items()
        for name, node in functions(tree, module)
        if f".{name}".endswith(f".{bug.function}")
    ]
    for places in (named, trees.items()):
        hits = [Place(module, *hit) for module, tree in places for hit in matches(shape, tree)]
        if len(hits) == 1:
            return hits[0]
    return None


class _Filled(ast.NodeTransformer):
    """Puts expressions in the place of capital letters."""

    def __init__(self, captured: Captured):
        self.captured = captured

    def visit_Name(self, node: ast.Name) -> ast.AST:
        return self.captured.get(node.id, node)


def planted(bug: Bug, place: Place, source: str) -> str:
    """A module's text with the bug in it."""
    new = ast.unparse(_Filled(place.captured).visit(pattern(bug.new)))
    node = place.node
    assert isinstance(node, (ast.expr, ast.stmt))
    assert node.end_lineno is not None
    lines = source.encode().splitlines(keepends=True)
    before = b"".join(lines[: node.lineno - 1]) + lines[node.lineno - 1][: node.col_offset]
    rest = lines[node.end_lineno - 1][node.end_col_offset :]
    after = rest + b"".join(lines[node.end_lineno :])
    replaced = f"({new})" if isinstance(node, ast.expr) else new
    return (before + replaced.encode() + after).decode()


def trees() -> dict[str, ast.Module]:
    """The package's syntax trees."""
    return {module: parsed(REPO / file) for module, file in modules().items()}


def caught(work: tuple[Bug, Place, float]) -> str | None:
    """Plants a bug in this process' copy for a while; returns what noticed it."""
    bug, place, seconds = work
    file = modules()[place.module]
    with forks.changed(file, planted(bug, place, (REPO / file).read_text())):
        return forks.noticed(tests_of(place.module)[:2], seconds)


def main() -> int:
    """Plants every bug; returns 1 if one survives or has lost its place."""
    parser = argparse.ArgumentParser(prog="make bugs")
    parser.add_argument("--match", default="", help="only bugs whose function or text holds this")
    parser.add_argument("--jobs", type=int, default=os.cpu_count(), help="runs at once")
    parser.add_argument("--seconds", type=float, default=300.0, help="of tests for each bug")
    args = parser.parse_args()
    bugs = [bug for bug in listed() if args.match in " ".join(bug)]
    package, begin = trees(), time.perf_counter()
    places = {bug: find(bug, package) for bug in bugs}
    lost = [bug for bug, place in places.items() if place is None]
    for bug in lost:
        print(f"LOST ITS PLACE {bug.function}: {bug.old}")
    work = [(bug, place, args.seconds) for bug, place in places.items() if place]
    survivors = 0
    for (bug, place, _), noticed in forks.run_all(caught, work, args.jobs):
        survivors += noticed is None
        result = f"caught by {noticed}" if noticed else "SURVIVED"
        print(f"{place.module} {bug.function}: {bug.new} | {result}", flush=True)
    minutes = (time.perf_counter() - begin) / 60
    print(f"{len(work) - survivors} of {len(bugs)} caught, {len(lost)} lost, {minutes:.0f} min")
    return int(bool(survivors or lost))


if __name__ == "__main__":
    sys.exit(main())
