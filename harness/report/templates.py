"""Templates of pages: with the style and script that all have, and numbers, notes and sentences as filters."""

from __future__ import annotations

import base64
import hashlib
from functools import cache
from inspect import getmembers, isfunction
from pathlib import Path
from typing import Any

import numpy as np
from jinja2 import ChoiceLoader, Environment, PackageLoader, StrictUndefined
from markupsafe import Markup

from harness import numbers
from harness.errors import printable
from harness.records.folder import write_bytes
from harness.report.notes import method_words, note_words


def sentence(text: str) -> str:
    """Write a phrase as a sentence: capital first, full stop last."""
    text = text.strip()
    return text[:1].upper() + text[1:] + ("" if text[-1:] in ".!?" else ".")


@cache
def templates(package: str = "harness.report") -> Environment:
    """Templates of a package, which may include those of this one."""
    place = Path(__file__).parent
    css, script = ((place / name).read_text(encoding="utf-8") for name in ("report.css", "player.js"))
    loader = ChoiceLoader([PackageLoader(each, ".") for each in (package, "harness.report")])
    jinja = Environment(loader=loader, autoescape=True, undefined=StrictUndefined, trim_blocks=True, lstrip_blocks=True)
    digest = base64.b64encode(hashlib.sha256(script.encode()).digest()).decode()
    # Our own files; the page's policy lets this one script run, by its hash.
    jinja.globals.update(style=Markup(css), script=Markup(script), script_hash=Markup(digest))  # noqa: S704
    jinja.filters.update(getmembers(numbers, isfunction), sentence=sentence, note=note_words, method=method_words)
    jinja.policies["json.dumps_kwargs"] = {"default": np.ndarray.tolist, "separators": (",", ":")}
    return jinja


def write_page(file: Path, template: str, **content: Any) -> Path:
    """Write a page, which is self-contained, and return its file."""
    page = templates().get_template(template).render(**content)
    write_bytes(file, printable(page).encode("utf-8"))
    return file
