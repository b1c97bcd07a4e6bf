"""The source code that modules depend on: their own, and that of their imports in this package."""

import ast
from pathlib import Path

PACKAGE = Path(__file__).resolve().parents[1]


def code(*of: str, package: Path = PACKAGE) -> dict[str, str]:
    """Collects modules and all that they import from this package, directly or indirectly.

    Args:
      of: full dotted names.
      package: folder of mjx_balance.

    Returns:
      {module: code}, without comments and docstrings.
    """
    modules: dict[str, str] = {}
    names = list(of)
    while names:
        name = names.pop()
        root, *parts = name.split(".")
        if root != PACKAGE.name or not parts or name in modules:
            continue
        inside = package.joinpath(*parts)
        file = inside / "__init__.py" if inside.is_dir() else inside.with_suffix(".py")
        if not file.is_file():  # `name` is a name inside a module
            continue
        tree = _DropDocstrings().visit(ast.parse(file.read_text(encoding="utf-8")))
        modules[name] = ast.unparse(tree)
        names.append(name.rpartition(".")[0])
        for node in ast.walk(tree):
            if isinstance(node, ast.Import):
                names += [alias.name for alias in node.names]
            elif isinstance(node, ast.ImportFrom):
                names += [str(node.module), *(f"{node.module}.{x.name}" for x in node.names)]
    return modules


class _DropDocstrings(ast.NodeTransformer):
    def visit_Expr(self, node: ast.Expr) -> ast.Expr | None:
        docstring = isinstance(node.value, ast.Constant) and isinstance(node.value.value, str)
        return None if docstring else node
