"""Runs that pages are made of, and a page as a reader sees it.

``python -m tests.report.page_text`` writes the golden pages anew.
"""

import re
import tempfile
from html.parser import HTMLParser
from pathlib import Path

from harness.campaign.files import load_campaign
from harness.runner.stored import write_report
from tests.golden.campaigns import BASE, FAILING, FORCED, MIXTURE, RUNS, SHELLS
from tests.in_process import run_here
from tests.stored_runs import edit, unnoted

GOLDEN = Path(__file__).parent / "golden"
KINDS = ("shells", "weighted", "nde", "no_crash")
VOID = {"meta", "br", "link", "img", "hr", "input"}

TWIN = "world.engine=twin"
SHARDS = (TWIN, "run.shard_size=1000", "records.moments=first_9", "records.traces=crash", "stop.rhw=0.1")
UNTRACED = (TWIN, "records.traces=none", "records.moments=none", "stop.rhw=0.1")
PAGES = {
    "weighted": (MIXTURE, *SHARDS, "stop.episodes=3000"),
    "no_crash": (
        FORCED,
        *SHARDS,
        "run.shard_size=20",
        "stop.episodes=40",
        "seed=11",
        "av.parameters.min_acceleration_mps2=-8",
    ),
    "nde": RUNS["nde-twin"],
    "shells": (*SHELLS, *UNTRACED, FAILING, "stop.episodes=300"),
    "shells_refuted": RUNS["shells-refuted"],
}
FIXED = {
    "created": "2025-01-02T03:04:05Z",
    "versions": {"harness": "0.1.0", "python": "3.11.9", "numpy": "2.1.0", "libsumo": "1.28.0"},
    "cpu": "Some CPU @ 3.0 GHz",
    "wall_time_s": 71.3,
    "workers": 2,
}
"""Of the manifest."""


def write_run(folder: Path, name: str) -> Path:
    """Run it into the folder, and return that: without checksums, so that a test may change files."""
    run_here(load_campaign(BASE, PAGES[name]), folder)
    edit(folder, **FIXED)
    return unnoted(folder)


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
        if text := " ".join(data.split()) if self.open and not {"style", "svg", "script"} & set(self.open) else "":
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
