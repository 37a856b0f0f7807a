"""In which call of a controller a process was when it died: a few bytes in a file that outlive the process."""

from __future__ import annotations

import os
import struct
from pathlib import Path
from typing import NamedTuple

import numpy as np

from harness.errors import writing
from harness.vocabulary import IntArray

START = -1
"""Stands for the call of ``start``, which comes before step 0."""
_FORMAT = struct.Struct("<qqq")
_NONE = 0
CONSTRUCTOR, OF_EPISODE, START_BATCH, STEP_BATCH, CLOSE = range(1, 6)
_WORDS = {CONSTRUCTOR: "its constructor", START_BATCH: "start_batch", STEP_BATCH: "step_batch", CLOSE: "close"}


class Call(NamedTuple):
    """A call of a controller: its kind, and where it belongs to one episode, that and the step, or `START`."""

    kind: int
    episode: int
    step: int

    def __str__(self) -> str:
        if self.kind != OF_EPISODE:
            return _WORDS[self.kind]
        where = "start" if self.step == START else f"the call of step {self.step}"
        return f"{where} of episode {self.episode}"


class Death(NamedTuple):
    """A call that is known to end the process: its step, or `START`, and the cause for the record."""

    step: int
    cause: str


_forks: list[None] = []
"""One entry for each `os.fork` of this process; what starts programs (subprocess) does not pass here."""
os.register_at_fork(after_in_parent=lambda: _forks.append(None))


class BlackBox:
    """Notes the call that is under way in a file, if any, and lets no copy of the process come back from one."""

    def __init__(self, path: Path | None) -> None:
        self._note: IntArray = np.zeros(3, np.int64)
        self._forks = len(_forks)
        if path is not None:
            with writing(path):
                path.write_bytes(_FORMAT.pack(_NONE, 0, 0))
            self._note = np.memmap(path, np.dtype("<i8"), "r+", shape=(3,))
        self._pid = os.getpid()

    def enter(self, kind: int, episode: int = 0, step: int = START) -> None:
        """Note a call before it is made."""
        self._note[1] = episode
        self._note[2] = step
        self._note[0] = kind
        self._forks = len(_forks)

    def leave(self) -> None:
        """The call has come back; a process that dies does not come here, and one that was copied must not go on."""
        if os.getpid() != self._pid:
            os._exit(0)
        self._note[0] = _NONE

    def misdeed(self) -> str | None:
        """What a controller did in the last call that no controller may do, or None."""
        return None if len(_forks) == self._forks else "copied the process (os.fork); start programs with subprocess"


def last_call(path: Path) -> Call | None:
    """The call that a dead process was in, or None if it was not in a controller."""
    try:
        call = Call._make(_FORMAT.unpack(path.read_bytes()))
    except (OSError, struct.error):
        return None
    return None if call.kind == _NONE else call
