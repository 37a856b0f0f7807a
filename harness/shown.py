"""Results as Python shows them: a short answer, in a notebook with what there is to see below it.

What they show is the report's, which is imported when something is shown: `run` and `estimate` draw nothing.
"""

from __future__ import annotations

from abc import abstractmethod
from collections.abc import Iterable, Mapping
from pathlib import Path
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from harness.campaign.campaign import Campaign
    from harness.report.drawing import Plot


class ShownInPython:
    """Something that is shown as lines of text, of which there are some ten, and maybe a plot."""

    @abstractmethod
    def _lines(self) -> Iterable[str]:
        """The text."""

    def _plot(self) -> Plot | None:
        """What a notebook shows below."""
        return None

    def __repr__(self) -> str:
        return "\n".join(self._lines())

    def _repr_html_(self) -> str:
        from harness.report.page import shown_with  # noqa: PLC0415 - see above

        return shown_with(repr(self), self._plot())


def lines_of_run(
    campaign: Campaign, manifest: Mapping[str, Any], estimates: Mapping[str, Any], folder: Path
) -> list[str]:
    """The short answer of a stored run."""
    from harness.report.lines import run_lines  # noqa: PLC0415 - see above

    return run_lines(campaign, manifest, estimates, folder / "report.html")


def plot_of_run(folder: Path, told: dict[str, Any] | None = None) -> Plot | None:
    """The map of a stored run, by its own estimates or those that are ``told``."""
    from harness.report.page import where_plot_of  # noqa: PLC0415 - see above
    from harness.report.summary import read_run_folder  # noqa: PLC0415

    return where_plot_of(read_run_folder(folder, told))
