"""The cache: what is kept from run to run because it can be made again. Compiled kernels, challenge tables, pools.

A file ends with a checksum of its name and content. One that is damaged, or has another's name, is ignored, and its
content made anew, as is what has no end: a pipe, a device. Where the cache cannot be written, files go to a folder of
this user among the temporary files. So a cache may be read-only, and a user without a home folder has one, too.
"""

from __future__ import annotations

import fcntl
import math
import os
import stat
import sys
import tempfile
import time
import zlib
from collections.abc import Callable, Iterator
from contextlib import ExitStack, contextmanager, suppress
from pathlib import Path

import platformdirs

from harness.errors import OF_THE_DISK, HarnessError
from harness.files import checksum, write_atomically

FOLDER = "HARNESS_CACHE_DIR"
"""Environment variable that names the cache; the default is the user's own, if there is a home to have it in."""
SAID = "HARNESS_CACHE_SAID"
"""Environment variable, set where another process of the same command prints the note about where the cache is."""
MOST_BYTES = 4 << 30
"""Most bytes of files of one kind [assumed]: tables of a challenge are 110 MB for each traffic."""
_LOOK_S = 0.1
"""Time between two looks at whether another process has released its lock."""
_SEAL_BYTES, _SEALED = 4, 0x2144DF1C
"""The CRC-32 of any bytes that end with their own CRC-32 is this number."""


def own_folder() -> Path | None:
    """Where the cache should be; None where there is no home folder."""
    if folder := os.environ.get(FOLDER):
        return Path(folder)
    with suppress(RuntimeError):  # nobody knows where this user is at home
        path = platformdirs.user_cache_path("harness")
        return path if path.is_absolute() else None  # so say older versions of that package
    return None


def temporary_folder() -> str:
    """Where temporary files go; a `HarnessError` where none can be written, as in a container that may only be read."""
    try:
        return tempfile.gettempdir()
    except FileNotFoundError as error:
        mend = "Set TMPDIR to a folder that can be written to."
        raise HarnessError("TMPDIR", "no place for temporary files", "a folder", mend) from error


def _spare_folder(*, make: bool = False) -> Path:
    """Folder for what cannot be written to the cache; a `HarnessError` where others may write there."""
    folder = Path(temporary_folder()) / f"harness-{os.geteuid()}"
    if make:
        with suppress(FileExistsError):
            folder.mkdir(0o700)
    status = folder.lstat()
    if not stat.S_ISDIR(status.st_mode) or status.st_uid != os.geteuid() or status.st_mode & 0o077:
        mend = f"Remove it, or set {FOLDER} or TMPDIR to another folder."
        raise HarnessError(str(folder), "what is not this user's alone", "a folder that nobody else can write to", mend)
    return folder


def places(name: str) -> Iterator[Path]:
    """Where something of a name, such as ``pools/0123``, may be."""
    if (own := own_folder()) is not None:
        yield own / name
    with suppress(HarnessError, OSError):
        yield _spare_folder() / name


def has(name: str) -> bool:
    """Whether there is something of a name, which may be a pattern, sound or not."""
    return any(any(path.parent.glob(path.name)) for path in places(name))


def find(name: str) -> Path | None:
    """A sound file of a name, with its checksum at the end; None if there is none."""
    for path in places(name):
        with suppress(OSError):
            if path.is_file() and checksum(path, zlib.crc32(name.encode())) == _SEALED:
                _used(path)
                return path
    return None


def read(name: str) -> bytes | None:
    """What is kept under a name; None if nothing is, or it is damaged."""
    for path in places(name):
        with suppress(OSError):
            content = path.read_bytes() if path.is_file() else b""  # once: a pool may be large
            if zlib.crc32(content, zlib.crc32(name.encode())) == _SEALED:
                _used(path)
                return content[:-_SEAL_BYTES]
    return None


def keep(name: str, content: bytes | memoryview) -> Path:
    """Keep a file under a name; returns where."""

    def write(path: Path) -> None:
        with path.open("wb") as file:
            file.write(content)
            file.write(zlib.crc32(content, zlib.crc32(name.encode())).to_bytes(_SEAL_BYTES, "little"))

    path = put(name, lambda path: write_atomically(path, write))
    _make_room(path)
    return path


def _used(path: Path) -> None:
    with suppress(OSError):  # a cache that may only be read
        os.utime(path)


def _make_room(kept: Path) -> None:
    """Remove the files beside a new one that were last used longest ago, until all are within `MOST_BYTES`."""
    beside = []
    for path in kept.parent.glob("[!.]*"):  # not what others are just writing
        with suppress(OSError):  # another process has removed it
            beside.append((path.stat(), path))
    excess = sum(status.st_size for status, _ in beside) - MOST_BYTES
    for status, path in sorted(beside, key=lambda entry: entry[0].st_mtime):
        if excess > 0 and path != kept:
            with suppress(OSError):
                path.unlink()
                excess -= status.st_size


@contextmanager
def made_once(name: str, waits: Callable[[str], object], most_s: float = math.inf) -> Iterator[None]:
    """Hold a lock, so that no other process makes the same at the same time.

    ``waits`` is called with who holds it already. It is waited for at most ``most_s``: that process may be stopped.
    """
    with ExitStack() as stack:
        # There is no lock in a cache that is read-only or does not exist yet, or on a file system without locks.
        with suppress(OSError, StopIteration):
            path = next(places(name))
            path = path.with_name(f".{path.name}.lock")
            path.parent.mkdir(parents=True, exist_ok=True)
            file = stack.enter_context(path.open("ab+", buffering=0))  # + as a pipe would wait for who reads it
            until = None
            while True:
                try:
                    fcntl.flock(file, fcntl.LOCK_EX | fcntl.LOCK_NB)
                    break
                except BlockingIOError:
                    if until is None:
                        waits(_holder(path))
                        until = time.monotonic() + most_s
                    if time.monotonic() >= until:
                        raise
                    time.sleep(_LOOK_S)
            stack.callback(path.unlink, missing_ok=True)
            file.truncate(0)
            file.write(str(os.getpid()).encode())
        yield


def _holder(path: Path) -> str:
    """Who locked a file, and since when; the lock may be released by now."""
    with suppress(OSError):
        if pid := path.read_text():
            return f"process {pid}, since {time.strftime('%H:%M:%S', time.localtime(path.stat().st_mtime))}"
    return "a process that has just begun"


def put(name: str, write: Callable[[Path], object]) -> Path:
    """Let ``write`` put something under a name; returns where, and says once if that is not in the cache."""
    why = "there is no home folder"
    if (own := own_folder()) is not None:
        try:
            write(own / name)
            return own / name
        except OSError as error:
            if error.errno in OF_THE_DISK:
                raise
            why = f"{own} cannot be written ({error.strerror})"
    spare = _spare_folder(make=True)
    write(spare / name)
    if SAID not in os.environ:
        os.environ[SAID] = "1"
        sys.stderr.write(f"note: what is compiled or built is kept in {spare}, as {why}. Set {FOLDER}.\n")
    return spare / name
