"""How Sphinx makes the site: `make docs`. Nothing is fetched, at build time or by the pages."""

import dataclasses
import re
import sys
from pathlib import Path
from typing import Any

import ziamath
from docutils import nodes
from sphinx.application import Sphinx
from sphinx.util import logging

REPO = Path(__file__).resolve().parent.parent
sys.path.insert(0, str(REPO))
from mjx_balance.quiet import quiet_imports  # noqa: E402

with quiet_imports("torch", "warp"):  # MJX prints that it finds no Warp
    import mjx_balance.envs.balance  # noqa: F401

project = html_title = "mjx_balance"
author, copyright = "the authors of mjx_balance", "the authors of mjx_balance, Apache-2.0"
extensions = ["sphinx.ext.autodoc", "sphinx.ext.napoleon", "sphinx.ext.viewcode", "myst_nb"]
exclude_patterns = ["_build"]

myst_enable_extensions = ["dollarmath"]
myst_heading_anchors = 3

# The notebook is in git without outputs. A build of its page runs it, and fails if a cell does.
nb_execution_mode = "force"
nb_execution_raise_on_error = True
nb_execution_timeout = 1_800  # s, of a cell, on a busy machine
nb_output_stderr = "remove"  # JAX's and MuJoCo's remarks on the machine
nb_merge_streams = True

# The docstrings are Google's, with names in single backticks: a link where there is something to
# link to, code where there is not.
default_role = "py:obj"
autodoc_default_options = {"members": True, "undoc-members": True, "exclude-members": "T"}
autodoc_member_order = "bysource"
autodoc_preserve_defaults = True
autoclass_content = "both"
add_module_names = False
python_maximum_signature_line_length = 88
python_use_unqualified_type_names = True

html_theme = "furo"
html_static_path = ["_static"]
html_css_files = ["site.css"]
html_math_renderer = "drawn"
EM = 14.5  # a little larger than the text around it, whose letters are wide
ziamath.config.svg2 = False  # no symbols with ids, which all equations of a page would share
html_copy_source = False
html_show_sphinx = False
pygments_style, pygments_dark_style = "a11y-high-contrast-light", "a11y-high-contrast-dark"

LINKS = {
    "../benchmarks/README.md": "results.md",
    "benchmarks/README.md": "results.md",
    "docs/browser.md": "browser.md",
    "docs/clusters.md": "clusters.md",
    "docs/install.md": "install.md",
    "docs/python.md": "python.md",
    "docs/versions.md": "versions.md",
    "../docs/clusters.md": "clusters.md",
    "../docs/other_algorithms.md": "other_algorithms.md",
    "../docs/results.md": "results.md",
    "../docs/robots.md": "robots.md",
    "ARCHITECTURE.md": "architecture.md",
}
"""Where links of the repository's files lead on the site."""


def to_the_site(text: str) -> str:
    """Markdown whose links are those of the repository, with the site's."""
    return re.sub(
        r"\]\(([^)#\s]+)(#[^)\s]*)?\)",
        lambda m: f"]({LINKS.get(m[1], m[1])}{m[2] or ''})",
        text,
    )


def drawn(translator: Any, node: nodes.Element, block: bool) -> None:
    """Writes an equation as an SVG, which needs no script and no font of the reader's."""
    tex = " ".join(node.astext().split())
    try:
        equation = ziamath.Latex(tex, size=EM, inline=not block, color="currentColor")
        if "\\" in equation.mathmlstr():  # a command that it does not know stands there as text
            raise ValueError("unknown command")
        width, height = (size + 2 * equation.margin for size in equation.getsize())
    except Exception as error:  # whatever the library makes of wrong TeX: the build says where
        logging.getLogger(__name__).warning("no equation: %r: %s", error, tex, location=node)
        raise nodes.SkipNode from error
    look = f"width: {width / EM:.3f}em; height: {height / EM:.3f}em"
    if not block:
        look += f"; vertical-align: {(equation.getyofst() - equation.margin) / EM:.3f}em"
    svg = equation.svg().replace(
        "<svg ", f'<svg role="img" aria-label="{translator.attval(tex)}" style="{look}" ', 1
    )
    kind = "div" if block else "span"
    translator.body.append(f'<{kind} class="math">{svg}</{kind}>')
    raise nodes.SkipNode


def setup(app: Sphinx) -> None:
    """Called by Sphinx."""
    whole: dict[str, list[str]] = {}

    # Napoleon takes what stands before a colon in a field's docstring for the field's type.
    def before_napoleon(
        app: Sphinx, what: str, name: str, obj: Any, options: Any, lines: list[str]
    ) -> None:
        whole[name] = list(lines)

    def after_napoleon(
        app: Sphinx, what: str, name: str, obj: Any, options: Any, lines: list[str]
    ) -> None:
        if what in ("attribute", "data", "property"):
            lines[:] = whole[name]
        made = ("Alias for field number", "Create new instance of")  # by typing.NamedTuple
        lines[:] = [line for line in lines if not line.startswith(made)]

    def on_source(app: Sphinx, name: str, text: list[str]) -> None:
        text[0] = to_the_site(text[0])

    def on_include(app: Sphinx, path: Path, name: str, text: list[str]) -> None:
        text[0] = to_the_site(text[0])

    # A record's fields follow, each with its own docstring.
    def on_signature(app: Sphinx, what: str, name: str, obj: Any, *others: Any) -> Any:
        record = dataclasses.is_dataclass(obj) or hasattr(obj, "_fields")
        return ("", None) if what == "class" and record else None

    app.connect("autodoc-process-signature", on_signature)
    app.connect("autodoc-process-docstring", before_napoleon, priority=400)
    app.connect("autodoc-process-docstring", after_napoleon, priority=600)
    app.connect("source-read", on_source)
    app.connect("include-read", on_include)
    app.add_html_math_renderer(
        "drawn",
        (lambda translator, node: drawn(translator, node, False), None),
        (lambda translator, node: drawn(translator, node, True), None),
    )
