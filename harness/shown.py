"""Results as Python shows them: a short answer, in a notebook with what there is to see below it."""

from __future__ import annotations

from abc import abstractmethod
from collections.abc import Iterable

from harness.report.drawing import Plot, shown_with


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
        return shown_with(repr(self), self._plot())
