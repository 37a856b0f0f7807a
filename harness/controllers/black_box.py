"""In which call of a controller a worker was when it died: sixteen bytes in a file that outlive the process."""

from __future__ import annotations

import struct
from pathlib import Path
from typing import NamedTuple

import numpy as np

from harness.arrays import IntArray
from harness.errors import writing

START = -1
"""Stands for the call of ``start``, which comes before step 0."""
_NONE = -1
_FORMAT = struct.Struct("<qq")


class Call(NamedTuple):
    """A call of a controller: episode and step, or `START`."""

    episode: int
    step: int


class Death(NamedTuple):
    """A call that is known to end the process: its step, or `START`, and the cause for the record."""

    step: int
    cause: str


class BlackBox:
    """The worker's side: notes the call that is under way.

    Parameters
    ----------
    path : Path, optional
        File; without one the notes go nowhere.
    """

    def __init__(self, path: Path | None) -> None:
        self._note: IntArray = np.array([_NONE, START], np.int64)
        if path is not None:
            with writing(path):
                path.write_bytes(_FORMAT.pack(_NONE, START))
            self._note = np.memmap(path, np.dtype("<i8"), "r+", shape=(2,))

    def enter(self, episode: int, step: int) -> None:
        """Note a call before it is made."""
        self._note[1] = step
        self._note[0] = episode

    def leave(self) -> None:
        """The call has come back; a process that dies does not come here."""
        self._note[0] = _NONE


def last_call(path: Path) -> Call | None:
    """The call that a dead worker was in, or None if it was not in a controller."""
    try:
        episode, step = _FORMAT.unpack(path.read_bytes())
    except (OSError, struct.error):
        return None
    return None if episode == _NONE else Call(episode, step)
