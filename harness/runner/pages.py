"""Write the page of a stored folder anew: of a run, of a comparison, or of several scenarios."""

from __future__ import annotations

from pathlib import Path
from typing import Any

from harness.arguments import checked
from harness.errors import RunFolderError
from harness.records.folder import read_as
from harness.report import compare_page
from harness.report.page import write_hours, write_page_of
from harness.report.summary import read_run_folder
from harness.runner.families import read_families
from harness.runner.stored import replay_episode
from harness.vocabulary import COMPARISON, FAMILIES


@checked("harness.write_report")
def write_report(folder: str | Path) -> Path:
    """Write ``report.html`` and ``plots/`` (SVG) into a run folder anew, or the page of a comparison, or of scenarios.

    Parameters
    ----------
    folder : str or Path
        Run folder, or the folder of a comparison, or of several scenarios.

    The page is self-contained: it can be mailed, archived and opened offline. The same folder gives the same bytes if
    it is reached from the working directory by the same relative path, by which the commands on the page name it;
    outside the working directory they use its name alone. Plots of an earlier report that this one does not have are
    removed.

    Raises `RunFolderError`: if the folder misses a file, or a file is damaged or belongs to another run.
    """
    if (Path(folder) / COMPARISON).is_file():
        return _write_comparison(Path(folder))
    if (Path(folder) / FAMILIES).is_file():
        return write_hours(Path(folder), read_families(Path(folder)))
    return write_page_of(read_run_folder(Path(folder)))


def _write_comparison(folder: Path) -> Path:
    """Of the comparison, and of each scenario's where it is a sum."""
    stored = read_as(dict[str, Any], folder / COMPARISON, mend=compare_page.MEND)
    if "families" in stored:
        for name in stored["families"]:
            _write_comparison(folder / name)
        return compare_page.write_sum(folder, stored)
    runs = [read_run_folder(folder / side) for side in ("a", "b")]
    for run, of in zip(runs, stored["campaigns"].values(), strict=True):
        if (found := run.manifest["campaign_hash"]) != of["campaign_hash"]:
            expected = f"campaign {of['campaign_hash']} ({COMPARISON})"
            raise RunFolderError(str(run.path), f"a run of campaign {found}", expected, compare_page.MEND)
    return compare_page.write_page_of(folder, stored, runs, replay_episode)
