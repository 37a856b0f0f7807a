"""Results as Python shows them: a short answer, in a notebook with what there is to see below it.

What they show is the report's, which is imported when something is shown: `run` and `estimate` draw nothing.
"""

from __future__ import annotations

from abc import abstractmethod
from collections.abc import Iterable
from typing import TYPE_CHECKING

if TYPE_CHECKING:
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
        from harness.report.drawing import shown_with  # noqa: PLC0415 - see above

        return shown_with(repr(self), self._plot())
