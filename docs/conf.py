"""Sphinx: the pages of this folder and the reference from docstrings. Build: sphinx-build -W docs docs/_build."""

from importlib import metadata
from pathlib import Path

project = "MAexp"
release = metadata.version("maexp")
extensions = ["myst_parser", "sphinx.ext.autodoc", "sphinx.ext.napoleon", "sphinx.ext.viewcode"]
exclude_patterns = ["_build"]
html_theme = "furo"
html_title = f"MAexp {release}"
html_static_path = ["static"]
html_css_files = ["wide.css"]
highlight_language = "none"  # a block without a language is a diagram or what a terminal shows
myst_heading_anchors = 3
suppress_warnings = ["myst.header"]  # pages may start below a shared heading

autodoc_member_order = "bysource"
autodoc_typehints = "signature"
autodoc_default_options = {"members": True}
napoleon_google_docstring = True
napoleon_numpy_docstring = False
napoleon_use_rtype = False
python_use_unqualified_type_names = True


def escape(app, what, name, obj, options, lines):
    """Shapes as [*, robots] and |free| mean themselves in our docstrings, not emphasis and substitution."""
    lines[:] = [line.replace("[*,", r"[\*,").replace("|free|", r"\|free\|") for line in lines]


def list_settings(app, what, name, obj, options, lines):
    """The settings of a dataclass, one a line, as its fields declare them."""
    from maexp.envs.config_fields import describe

    lines += describe(obj) if isinstance(obj, type) else []


def draw_leaderboard(app, error):
    """The page of the rows, beside their tables."""
    from maexp.agents.benchmarks.leaderboard import find_rows, read_row, write_page

    if error is None and app.builder.format == "html":
        rows = [read_row(path) for path in find_rows(Path(app.srcdir) / "leaderboard")]
        write_page(Path(app.outdir) / "leaderboard", rows)


def setup(app):
    app.connect("build-finished", draw_leaderboard)
    app.connect("autodoc-process-docstring", escape)
    app.connect("autodoc-process-docstring", list_settings)
