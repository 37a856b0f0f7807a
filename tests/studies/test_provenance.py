"""What carries the paper's tag is stated in the paper: docs/environment.md has its words."""

from __future__ import annotations

import re
from pathlib import Path

ROOT = Path(__file__).parents[2]
TAG = re.compile(r"\[paper(: [^\]]+)?\]|source: paper")
PLACE = re.compile(r"section [IVX]+-[A-Z]|\(II-A\)|Lemma|Theorem|Algorithm")
"""What follows the paper's text or algorithm says where, and is no number."""


def test_every_number_tagged_with_the_paper_has_its_words_beside_it():
    page = (ROOT / "docs" / "environment.md").read_text()
    quoted = re.findall(r'^\| (`.+`) \| [IVX]+-[A-Z] \| ".+" \|$', page, re.MULTILINE)
    names = [name for cell in quoted for name in re.findall("`(.+?)`", cell)]
    assert len(quoted) >= 7
    files = [file for top in ("harness", "scenarios", "docs") for file in (ROOT / top).rglob("*")]
    lines = [
        (str(file.relative_to(ROOT)), line)
        for file in files
        if file.suffix in {".py", ".yaml", ".md", ".json"} and "validation" not in file.parts
        for line in file.read_text().splitlines()
        if TAG.search(line) and not line.startswith(("| [paper] |", "# docs/environment.md:"))
    ]
    assert len(lines) > 25
    assert [each for each in lines if not (PLACE.search(each[1]) or any(name in each[1] for name in names))] == []
