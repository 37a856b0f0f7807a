"""A written page as a reader sees it."""

from __future__ import annotations

import json
import re
from html.parser import HTMLParser
from pathlib import Path
from xml.etree import ElementTree

VOID = {"meta", "br", "link", "img", "hr", "input"}


class Page(HTMLParser):
    """Checks nesting while it reads, and collects text, ids, links and attributes."""

    def __init__(self, html: str) -> None:
        super().__init__()
        self.open: list[str] = []
        self.text = ""
        self.ids: list[str] = []
        self.attributes: list[tuple[str, str, str]] = []
        self.feed(html)
        self.close()
        assert self.open == []

    @property
    def words(self) -> str:
        """The text with single blanks."""
        return " ".join(self.text.split())

    def handle_starttag(self, tag: str, attrs: list[tuple[str, str | None]]) -> None:
        if tag not in VOID:
            self.open.append(tag)
        self.handle_startendtag(tag, attrs)

    def handle_startendtag(self, tag: str, attrs: list[tuple[str, str | None]]) -> None:
        self.attributes += [(tag, name, value or "") for name, value in attrs]
        self.ids += [value or "" for name, value in attrs if name == "id"]

    def handle_endtag(self, tag: str) -> None:
        assert self.open
        assert self.open.pop() == tag

    def handle_data(self, data: str) -> None:
        self.text += data


def page_of(folder: Path) -> Page:
    return Page((folder / "report.html").read_text(encoding="utf-8"))


def edit(path: Path, **changes) -> dict:
    """Change top-level keys of a JSON file; returns what it held before."""
    content = json.loads(path.read_text())
    path.write_text(json.dumps(content | changes))
    return content


def require_sound_page(folder: Path, plots: set[str]) -> None:
    """What every page must do: say all, be self-contained, and show exactly the plots that make sense."""
    html, page = (folder / "report.html").read_text(encoding="utf-8"), page_of(folder)
    _require_all_is_said(folder, page)
    _require_self_contained(html, page)
    files = list((folder / "plots").iterdir())
    stems = {path.stem for path in files}
    assert {stem for stem in stems if not stem.startswith("crash-")} == plots
    assert {path.name for path in files} == {f"{stem}.{kind}" for stem in stems for kind in ("png", "svg")}
    for stem in stems:
        assert (folder / "plots" / f"{stem}.png").read_bytes().startswith(b"\x89PNG")
        ElementTree.parse(folder / "plots" / f"{stem}.svg")
        assert f"plot-{stem}" in page.ids
    figures = re.findall(r"<figure.*?</figure>", html, flags=re.DOTALL)
    assert len(figures) == len(stems)
    for figure in figures:
        assert len(re.search(r'aria-label="([^"]*)"', figure).group(1)) > 40
        assert len(re.search(r"<figcaption>(.*?)<span", figure, re.DOTALL).group(1)) > 40


def _require_all_is_said(folder: Path, page: Page) -> None:
    estimates = json.loads((folder / "estimates.json").read_text())
    assert estimates["statement"] in page.text
    for estimator, content in estimates["estimates"].items():
        assert estimator in page.text
        for text in [*content.get("warnings", []), *([content["reason"]] if "reason" in content else [])]:
            assert text[1:] in page.text
    assert "sampling error in this environment" in page.text
    assert f"lane-change level {estimates['lane_change_level']:g}" in page.text


def _require_self_contained(html: str, page: Page) -> None:
    """Nothing is fetched or run, ids are unique, and no link is dead."""
    assert "://" not in html
    assert len(page.ids) == len(set(page.ids))
    for tag, attribute, value in page.attributes:
        assert tag not in {"script", "link", "iframe"}
        assert not attribute.startswith("on")
        if attribute in {"href", "xlink:href", "src"}:
            assert value.startswith("#")
            assert value[1:] in page.ids
    assert {reference[1:] for reference in re.findall(r"url\(([^)]*)\)", html)} <= set(page.ids)
