"""A written page as a reader sees it; ``python -m tests.report.page_text`` writes the golden pages anew."""

from __future__ import annotations

import re
import tempfile
from html.parser import HTMLParser
from pathlib import Path

from harness.report.page import write_report
from tests.report.page_runs import write_run

GOLDEN = Path(__file__).parent / "golden"
KINDS = ("shells", "weighted", "nde", "no_crash")
VOID = {"meta", "br", "link", "img", "hr", "input"}


class Page(HTMLParser):
    """Checks nesting while it reads, and collects texts, ids and attributes."""

    def __init__(self, folder: Path) -> None:
        super().__init__()
        self.html = (folder / "report.html").read_text(encoding="utf-8")
        self.open: list[str] = []
        self.lines: list[str] = []
        self.attributes: list[tuple[str, str, str]] = []
        self.feed(self.html)
        self.close()
        assert self.open == []

    @property
    def ids(self) -> list[str]:
        return [value for _, name, value in self.attributes if name == "id"]

    @property
    def words(self) -> str:
        """The text with single blanks."""
        return " ".join(self.lines)

    def handle_starttag(self, tag: str, attrs: list[tuple[str, str | None]]) -> None:
        if tag not in VOID:
            self.open.append(tag)
        self.handle_startendtag(tag, attrs)

    def handle_startendtag(self, tag: str, attrs: list[tuple[str, str | None]]) -> None:
        self.attributes += [(tag, name, value or "") for name, value in attrs]
        self.lines += [f"[{value}]" for name, value in attrs if name == "aria-label" and value]

    def handle_endtag(self, tag: str) -> None:
        assert self.open.pop() == tag

    def handle_data(self, data: str) -> None:
        if text := " ".join(data.split()) if self.open and not {"style", "svg"} & set(self.open) else "":
            self.lines.append(text)


def golden_text(folder: Path) -> str:
    """What the page says, of plots what stands for them; no settings and no pool's key, which change with the code."""
    text = re.sub(r"\nKey\n.*\n", "\n", "\n".join(Page(folder).lines))
    return re.sub(r"\nSettings\nAll settings.*?\nReproduce\n", "\nReproduce\n", text, flags=re.DOTALL) + "\n"


if __name__ == "__main__":
    with tempfile.TemporaryDirectory() as place:
        for kind in KINDS:
            folder = write_run(Path(place) / kind / "run", kind)
            write_report(folder)
            (GOLDEN / f"{kind}.txt").write_text(golden_text(folder), encoding="utf-8")
