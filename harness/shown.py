"""Results as Python shows them: a short answer in lines, and in a notebook a plot below it."""

from __future__ import annotations

from abc import abstractmethod
from collections.abc import Iterable

from harness.report.drawing import Plot, shown_with


class ShownInPython:
    """A result that is shown as some ten lines of text, and maybe a plot."""

    @abstractmethod
    def _lines(self) -> Iterable[str]:
        """The text."""

    def _plot(self) -> Plot | None:
        """The plot that a notebook shows below the text."""
        return None

    def __repr__(self) -> str:
        return "\n".join(self._lines())

    def _repr_html_(self) -> str:
        return shown_with(repr(self), self._plot())
