"""Digest of the code that decides a result, so that a kept one is known to be out of date."""

import ast
import hashlib
from pathlib import Path

import mujoco

from mjx_balance import controllers, evaluation

PACKAGE = Path(evaluation.__file__).parent


def code_digest(package: Path = PACKAGE) -> str:
    """Digest of the evaluation, the controllers, and whatever they import of the package.

    MuJoCo's version counts, too; comments and docstrings decide nothing.

    Args:
      package: folder of mjx_balance.

    Returns:
      16 hexadecimal digits.
    """
    found: dict[str, str] = {}
    for module in (evaluation, controllers):
        _collect(package, module.__name__, found)
    parts = [mujoco.__version__, *(f"{name}:{code}" for name, code in sorted(found.items()))]
    return hashlib.sha256("\n".join(parts).encode()).hexdigest()[:16]


def _collect(package: Path, name: str, found: dict[str, str]) -> None:
    """Adds the code of a module of the package, and of the modules that it imports."""
    root, *parts = name.split(".")
    if root != PACKAGE.name or not parts or name in found:
        return
    inside = package.joinpath(*parts)
    file = inside / "__init__.py" if inside.is_dir() else inside.with_suffix(".py")
    if not file.is_file():  # a name in a module
        return
    tree = _WithoutWords().visit(ast.parse(file.read_text(encoding="utf-8")))
    found[name] = ast.unparse(tree)
    targets = [name.rpartition(".")[0]]
    for node in ast.walk(tree):
        if isinstance(node, ast.Import):
            targets += [alias.name for alias in node.names]
        elif isinstance(node, ast.ImportFrom):
            targets += [f"{node.module}.{alias.name}" for alias in node.names]
            targets.append(str(node.module))
    for target in targets:
        _collect(package, target, found)


class _WithoutWords(ast.NodeTransformer):
    """Takes docstrings out."""

    def visit_Expr(self, node: ast.Expr) -> ast.Expr | None:
        """Drops strings that stand alone."""
        words = isinstance(node.value, ast.Constant) and isinstance(node.value.value, str)
        return None if words else node
