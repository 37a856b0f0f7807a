"""Shared libraries that SUMO's wheels expect of the system: its window toolkit is linked even where no window opens.

The wheels bring the others along (policy manylinux_2_28, PEP 600, names what they may leave out). The list is what the
files of libsumo 1.28.0 and of eclipse-sumo 1.28.0 need and do not bring, the C library and the compiler's runtime
aside; a test reads it from the installed files.
"""

from __future__ import annotations

import ctypes
import sys
from collections.abc import Sequence
from typing import NamedTuple

from harness.errors import HarnessError


class SystemLibrary(NamedTuple):
    """A shared library, and the packages that bring it on Debian and Ubuntu, on Fedora and its kin, and on Alpine."""

    soname: str
    apt: str
    dnf: str
    apk: str


LIBRARIES = (
    SystemLibrary("libX11.so.6", "libx11-6", "libX11", "libx11"),
    SystemLibrary("libXext.so.6", "libxext6", "libXext", "libxext"),
    SystemLibrary("libXrender.so.1", "libxrender1", "libXrender", "libxrender"),
    SystemLibrary("libGL.so.1", "libgl1", "libglvnd-glx", "mesa-gl"),
    SystemLibrary("libatomic.so.1", "libatomic1", "libatomic", "libatomic"),
    SystemLibrary("libexpat.so.1", "libexpat1", "expat", "libexpat"),
    SystemLibrary("libz.so.1", "zlib1g", "zlib", "zlib"),
    SystemLibrary("libstdc++.so.6", "libstdc++6", "libstdc++", "libstdc++"),
)


def missing_libraries() -> list[SystemLibrary]:
    """Those that the dynamic loader does not find (it takes 40 ms to ask); none where SUMO's wheels are not Linux's."""
    if not sys.platform.startswith("linux"):
        return []
    return [library for library in LIBRARIES if not _loads(library.soname)]


def _loads(soname: str) -> bool:
    try:
        ctypes.CDLL(soname)
    except OSError:
        return False
    return True


def require_libraries() -> None:
    """Refuse a machine that SUMO cannot be loaded on.

    Raises
    ------
    HarnessError
        Libraries are missing; it names their packages.
    """
    missing = missing_libraries()
    if missing:
        raise cannot_load(missing, "Run `harness setup`, which installs them")


def cannot_load(missing: Sequence[SystemLibrary], advice: str) -> HarnessError:
    """Error that names the missing libraries, and what an administrator is to type."""
    return HarnessError(
        "system libraries of SUMO",
        found=f"no {', '.join(library.soname for library in missing)}",
        expected="the shared libraries that libsumo needs of the system",
        mend=f"{advice}, or give your administrator the line for this system:\n{install_lines(missing)}",
    )


def not_importable(words: str) -> HarnessError:
    """Error for a libsumo that does not load though the known libraries are there, with the loader's own words."""
    return HarnessError(
        "libsumo",
        found=f"that it cannot be imported: {words}",
        expected="libsumo 1.28.0 as `pip install` brings it, and the system libraries that it names",
        mend="Install the package of this system that holds the named file, or libsumo again (`pip install "
        "--force-reinstall libsumo==1.28.0`).",
    )


def install_lines(libraries: Sequence[SystemLibrary]) -> str:
    """Command lines for an administrator, one per package manager."""
    apt, dnf, apk = (" ".join(getattr(library, manager) for library in libraries) for manager in ("apt", "dnf", "apk"))
    return (
        f"    Debian, Ubuntu:  apt-get update && apt-get install -y --no-install-recommends {apt}\n"
        f"    Fedora, RHEL:    dnf install -y {dnf}\n"
        f"    Alpine:          apk add {apk}"
    )
