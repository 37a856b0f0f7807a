"""Worlds in which SUMO's own car-following model drives the AV from the step after the cut-in.

Until then the AV is commanded and compared like LV and BV. Then it is released (``setSpeed`` -1) under SUMO's default
speed mode: its position and speed are read, not compared. LV and BV stay commanded and compared in every bit.
"""

from __future__ import annotations

import os
import sys
import tempfile
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import numpy as np

from harness.controllers.hosts import episode_random
from harness.vocabulary import AV, BoolArray, FloatArray, Int8Array, IntArray
from harness.worlds.av_type import TYPE_NAME, refused, type_xml
from harness.worlds.cells import OBEY
from harness.worlds.sumo import SumoWorld

SUMO_DECIDES = 31
"""Speed mode in which all of SUMO's own checks hold: its default."""
RELEASE = -1.0
"""The speed that, commanded, gives a vehicle back to its model."""


class SumoAvWorld(SumoWorld):
    """`SumoWorld` whose AVs are driven by SUMO after the cut-in.

    Parameters
    ----------
    n_cells : int
    av : mapping
        vType attributes (``av.sumo``); see `harness.worlds.av_type`.
    acts_before_cut_in : bool
        Release the AV at the start of an episode already.
    options
        Those of `SumoWorld`.

    Raises `CampaignError`: SUMO does not know, or refuses, an attribute.
    """

    def __init__(
        self, n_cells: int, av: Mapping[str, str | float], *, acts_before_cut_in: bool = False, **options: Any
    ) -> None:
        self.acts_before_cut_in = acts_before_cut_in
        self._released: BoolArray = np.zeros(n_cells, np.bool_)
        self._wanted: FloatArray = np.zeros((n_cells, 3))
        self._xml = type_xml(av)
        with self._written_type() as folder:
            said = folder / "stderr"
            try:
                with _stderr_to(said):
                    super().__init__(n_cells, **options)
            except Exception as error:
                lines = said.read_text(encoding="utf-8").splitlines()
                messages = [line.removeprefix("Error: ") for line in lines if line.startswith("Error: ")]
                if not messages:
                    raise
                raise refused(av, messages[0]) from error

    @contextmanager
    def _written_type(self) -> Iterator[Path]:
        """A folder with the file of the AV's type, for as long as SUMO reads it."""
        with tempfile.TemporaryDirectory(prefix="harness-av-") as folder:
            self._type_file = Path(folder) / "av.add.xml"
            self._type_file.write_text(self._xml, encoding="utf-8")
            yield Path(folder)

    def _type_files(self) -> list[Path]:
        return [*super()._type_files(), self._type_file]

    def _type_of(self, vehicle: int) -> str:
        return TYPE_NAME if vehicle == AV else super()._type_of(vehicle)

    def announce(self, cells: IntArray, episodes: IntArray) -> None:
        """See `harness.worlds.protocol.DrivingWorld`; vehicles are recycled, whatever the episode."""

    def restart(self) -> None:
        """See `harness.worlds.protocol.DrivingWorld`; SUMO's models are never lost."""

    def place(self, cells: IntArray, x: FloatArray, v: FloatArray) -> None:
        """See `harness.worlds.protocol.World`; the AVs of these cells are taken back under command."""
        for k in cells.tolist():
            self._api.vehicle.setSpeedMode(self._names[k][AV], OBEY)
        super().place(cells, x, v)
        self._released[cells] = False
        if self.acts_before_cut_in:
            self._let_go(cells)

    def step(self, speed: FloatArray, cut_in: Int8Array) -> BoolArray:
        """See `harness.worlds.protocol.World`; speeds of released AVs are ignored."""
        self._wanted[:] = speed
        self._wanted[self._released, AV] = RELEASE
        contact = super().step(self._wanted, cut_in)
        if cut_in.any():
            self._let_go(np.flatnonzero((cut_in == 1) & ~self._released))
        return contact

    def _let_go(self, cells: IntArray) -> None:
        """From the next step on SUMO decides."""
        for k in cells.tolist():
            self._api.vehicle.setSpeedMode(self._names[k][AV], SUMO_DECIDES)
        self._released[cells] = True

    def _read_released(self) -> None:
        for k in np.flatnonzero(self._released).tolist():
            name = self._names[k][AV]
            self.x[k, AV], self.v[k, AV] = self._get_position(name), self._get_speed(name)


class FreshWorld(SumoAvWorld):
    """One cell, and for every episode a simulation of its own, seeded with the campaign's seed and the episode.

    For types whose vehicles keep hidden state or draw random numbers: slower, and the same again in any order.
    """

    def __init__(self, av: Mapping[str, str | float], seed: int, **options: Any) -> None:
        self._seed = seed
        self._sumo_seed = 0
        super().__init__(1, av, **options)

    def announce(self, cells: IntArray, episodes: IntArray) -> None:  # noqa: ARG002 - there is one cell
        """Load a new simulation for the coming episode."""
        self._sumo_seed = sumo_seed(self._seed, int(episodes[0]))
        with self._written_type():
            self.load_again()

    def _arguments(self) -> list[str]:
        return [*super()._arguments(), "--seed", str(self._sumo_seed)]


def sumo_seed(seed: int, episode: int) -> int:
    """SUMO's seed (31 bits) for an episode: from the AV's own stream of random numbers."""
    return int(episode_random(seed, episode).integers(2**31))


@contextmanager
def _stderr_to(path: Path) -> Iterator[None]:
    """Write what SUMO says to a file: libsumo's exception is no more than 'Process Error'."""
    sys.stderr.flush()
    kept = os.dup(2)
    try:
        with path.open("wb") as file:
            os.dup2(file.fileno(), 2)
            yield
    finally:
        os.dup2(kept, 2)
        os.close(kept)
