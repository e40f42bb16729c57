"""How Sphinx builds the documentation site (`make docs`). Warnings are errors there."""

import re
import sys
from pathlib import Path

from orthonav import __version__

DOCS = Path(__file__).resolve().parent
sys.path.insert(0, str(DOCS.parent / "tools" / "docs"))

project = "orthonav"
author = "the authors of orthonav"
project_copyright = "the authors of orthonav. Apache License 2.0"
version = release = __version__

extensions = ["myst_parser", "sphinx.ext.autodoc", "commands"]
source_suffix = {".md": "markdown"}
highlight_language = "none"  # most blocks without a language are commands and what they print

# Pages are read on the repository's host too: plain Markdown, fences only for what Sphinx makes.
myst_enable_extensions = ["colon_fence"]
myst_heading_anchors = 3  # as the host makes them
suppress_warnings = ["myst.header"]  # a page may begin its sections at any level

# Docstrings are prose with names in single backticks.
default_role = "literal"
autoclass_content = "both"
autodoc_member_order = "bysource"
autodoc_typehints = "signature"
autodoc_default_options = {"members": True, "show-inheritance": True}
autodoc_preserve_defaults = True
autodoc_mock_imports = ["torch", "transformers", "faiss", "onnx"]  # learning; not needed to be read
add_module_names = False
python_use_unqualified_type_names = True
toc_object_entries_show_parents = "hide"

# Signatures name classes that have no page, of orthonav's modules and of other projects.
nitpicky = True
nitpick_ignore_regex = [(r"py:.*", r".*")]


def _readable(_app, _what, _name, _obj, _options, lines):
    """Docstrings are prose: a vertical bar in them is a formula's, not a substitution."""
    for row, line in enumerate(lines):
        pieces = line.split("`")
        pieces[::2] = [piece.replace("|", "\\|") for piece in pieces[::2]]
        lines[row] = "`".join(pieces)


def _of_the_site(_app, _page, source):
    """Directives are comments in the pages, so that nothing of them is seen in the repository."""
    source[0] = re.sub(r"<!-- site\n(.*?)\n-->", r"\1", source[0], flags=re.DOTALL)


def setup(app):
    """Tell Sphinx what to do with pages and docstrings."""
    app.connect("source-read", _of_the_site)
    app.connect("autodoc-process-docstring", _readable)


html_theme = "furo"
html_title = f"orthonav {release}"
html_static_path = ["_static"]
html_css_files = ["site.css"]
html_copy_source = False
html_show_sourcelink = False
html_use_index = True
html_theme_options = {"top_of_page_buttons": []}
