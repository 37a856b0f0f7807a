"""What simulates the vehicles: one small protocol over K cells, implemented by SUMO and by the numba twin."""

from __future__ import annotations

from typing import Protocol, runtime_checkable

from harness.vocabulary import BoolArray, FloatArray, Int8Array, IntArray


class World(Protocol):
    """K cells, each with LV, BV and AV on a two-lane road of its own.

    ``x``, ``v`` (K, 3) are front bumpers' positions (m) and speeds (m/s) of LV, BV, AV, as the world reports them.
    """

    x: FloatArray
    v: FloatArray

    @property
    def n_cells(self) -> int:
        """K."""
        ...

    def place(self, cells: IntArray, x: FloatArray, v: FloatArray) -> None:
        """Put the vehicles of the given cells (n,) at ``x[cells]``, ``v[cells]``; LV and BV left, AV right.

        ``x`` and ``v`` (K, 3) may be the world's own arrays, already overwritten.
        """
        ...

    def step(self, speed: FloatArray, cut_in: Int8Array) -> BoolArray:
        """Advance all cells to the speeds (m/s, shape (K, 3)) at the end of the step.

        ``cut_in`` (K,) says whose BV moves to the right lane in this step. Returns the cells (K,) in which vehicles on
        the same lane have come into contact in it.
        """
        ...

    def close(self) -> None:
        """Release what the world holds."""
        ...


@runtime_checkable
class DrivingWorld(Protocol):
    """A world that drives the AV itself: SUMO's own models, or a program connected to SUMO."""

    @property
    def acts_before_cut_in(self) -> bool:
        """Whether it drives from the start of an episode, or from the step after the cut-in."""
        ...

    def announce(self, cells: IntArray, episodes: IntArray) -> None:
        """Episodes (n,) of the given cells (n,), told before they are placed."""
        ...

    def restart(self) -> None:
        """Begin again with all cells idle, after an `AVLostError`."""
        ...


class AVLostError(Exception):
    """What drives the AVs is gone: all running episodes fail with this cause; ``x``, ``v`` are as before the step."""
