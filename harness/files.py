"""Atomic writing: a file is there completely, or not at all; and where a path leads."""

from __future__ import annotations

import fcntl
import hashlib
import os
import time
import uuid
import zlib
from collections.abc import Callable, Iterable
from contextlib import suppress
from pathlib import Path

from harness.errors import writing

_UNFINISHED = ".harness-{}.part"
"""A file that is being written; nobody else's temporary files have such names."""
_BLOCK_BYTES = 1 << 20
_ABOUT_TO_BE_S = 60.0
"""Age from which an unlocked, empty file is not one that is just being begun."""


def real_path(path: Path | str) -> Path:
    """The path without links; links in a circle stay, so that opening it fails."""
    return Path(os.path.realpath(path))


def checksum(path: Path, crc: int = 0) -> int:
    """CRC-32 of a file's bytes, going on from ``crc``, that of bytes before them."""
    with path.open("rb") as file:
        while block := file.read(_BLOCK_BYTES):
            crc = zlib.crc32(block, crc)
    return crc


def write_atomically(path: Path, write: Callable[[Path], object]) -> None:
    """Let ``write`` fill a temporary file beside ``path``, then put it in place.

    A full disk or a killed process leaves no half-written file under the final name. The temporary file of a killed
    process goes when the next one writes into this folder.
    """
    path.parent.mkdir(parents=True, exist_ok=True)
    with writing(path):
        remove_unfinished(path.parent.glob(_UNFINISHED.format("*")))
        temporary = path.with_name(_UNFINISHED.format(uuid.uuid4().hex))
        try:
            with temporary.open("xb") as file:
                with suppress(OSError):  # some network file systems have no locks
                    fcntl.flock(file, fcntl.LOCK_EX)
                write(temporary)
                temporary.replace(path)
        finally:
            temporary.unlink(missing_ok=True)


def remove_unfinished(files: Iterable[Path]) -> None:
    """Remove temporary files whose writers were killed: those of living ones are locked, or about to be if new."""
    for path in files:
        with suppress(OSError), path.open("rb+") as file:
            fcntl.flock(file, fcntl.LOCK_EX | fcntl.LOCK_NB)
            status = path.stat()
            if status.st_size or time.time() - status.st_mtime > _ABOUT_TO_BE_S:
                path.unlink()


def content_hash(content: bytes) -> str:
    """Hash of some bytes, as files name it."""
    return hashlib.sha256(content).hexdigest()[:16]
