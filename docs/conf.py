"""Sphinx settings of the documentation site; its sources are the Markdown pages as they stand, and the docstrings.

    .venv/bin/python -m sphinx -W --keep-going -b html -c docs . build/site

The source folder is the whole repository, so that links between pages, to README.md and to campaigns are the same on
the site and on a code host. The pages need nothing from the network.
"""

from __future__ import annotations

import re
import tomllib
from pathlib import Path
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from sphinx.application import Sphinx

ROOT = Path(__file__).parent.parent

project = "harness"
author = "the harness authors"
release = tomllib.loads((ROOT / "pyproject.toml").read_text(encoding="utf-8"))["project"]["version"]

extensions = ["myst_parser", "sphinx.ext.autodoc", "numpydoc"]
root_doc = "README"
include_patterns = ["README.md", "CHANGELOG.md", "CONTRIBUTING.md", "docs/**.md"]
templates_path = ["_templates"]
myst_heading_anchors = 4  # links as docs/estimators.md#stopping-of-shells, as code hosts make them

default_role = "py:obj"  # docstrings name objects in single backticks
autodoc_typehints = "signature"
numpydoc_show_class_members = False  # autodoc lists them
autodoc_member_order = "bysource"

html_theme = "furo"
html_static_path = ["_static"]
html_css_files = ["site.css"]
html_title = f"harness {release}"
html_additional_pages = {"index": "redirect.html"}  # a host shows index.html first; the first page is README
html_copy_source = html_show_sourcelink = False
html_show_copyright = html_show_sphinx = False

_SECTION = re.compile(r"^\*\*([^*]+)\*\*", re.MULTILINE)
_PAGE = re.compile(r"\]\(([\w/-]+)\.md\)")


def _list_pages(_app: Sphinx, page: str, source: list[str]) -> None:
    """Add tables of contents to the first page, which a code host would show as code: sections of docs/index.md."""
    if page == "README":
        _, *parts = _SECTION.split((ROOT / "docs" / "index.md").read_text(encoding="utf-8"))
        sections = {
            title: [f"docs/{found}" for found in dict.fromkeys(_PAGE.findall(text))]
            for title, text in zip(parts[::2], parts[1::2], strict=True)
        }
        for title, pages in {**sections, "The project": ["docs/index", "CONTRIBUTING", "CHANGELOG"]}.items():
            source[0] += "\n".join(["\n```{toctree}", ":hidden:", f":caption: {title.strip('.')}", "", *pages, "```\n"])


def setup(app: Sphinx) -> None:
    """Connect what needs more than a setting."""
    app.connect("source-read", _list_pages)
