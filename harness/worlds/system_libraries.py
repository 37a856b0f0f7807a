"""The version of libsumo; shared libraries that SUMO's wheels expect of the system, and how missing ones are installed.

The wheels bring the others along (policy manylinux_2_28, PEP 600, names what they may leave out). The list is what the
files of libsumo 1.28.0 and of eclipse-sumo 1.28.0 need and do not bring, the C library and the compiler's runtime
aside; a test reads it from the installed files. SUMO's window toolkit is linked even where no window opens.
"""

from __future__ import annotations

import ctypes
import os
import shlex
import shutil
import subprocess
import sys
from collections.abc import Sequence
from contextlib import suppress
from importlib.metadata import PackageNotFoundError, distribution
from importlib.util import find_spec
from typing import NamedTuple

from harness.errors import HarnessError

SUMO_VERSION = "1.28.0"
"""The one that `pyproject.toml` pins, for which bits are promised."""


class SystemLibrary(NamedTuple):
    """A shared library, and the packages that bring it on Debian and Ubuntu, and on Fedora and its kin."""

    soname: str
    apt: str
    dnf: str


LIBRARIES = (
    SystemLibrary("libX11.so.6", "libx11-6", "libX11"),
    SystemLibrary("libXext.so.6", "libxext6", "libXext"),
    SystemLibrary("libXrender.so.1", "libxrender1", "libXrender"),
    SystemLibrary("libGL.so.1", "libgl1", "libglvnd-glx"),
    SystemLibrary("libatomic.so.1", "libatomic1", "libatomic"),
    SystemLibrary("libexpat.so.1", "libexpat1", "expat"),
    SystemLibrary("libz.so.1", "zlib1g", "zlib"),
    SystemLibrary("libstdc++.so.6", "libstdc++6", "libstdc++"),
)
# Ubuntu's own updates hold the lock for some minutes after a first start: wait instead of failing.
_INSTALL = {
    "apt": ("apt-get update", "apt-get -o DPkg::Lock::Timeout=300 install -y --no-install-recommends"),
    "dnf": ("dnf install -y --setopt=install_weak_deps=False",),
}
_ASK_NOTHING = ("env", "DEBIAN_FRONTEND=noninteractive", "LC_ALL=C")
_REINSTALL = f"install libsumo again: pip install --force-reinstall libsumo=={SUMO_VERSION}"
_QUOTED = 2
"""Lines of each command that an error repeats."""


def missing_libraries() -> list[SystemLibrary]:
    """Those that the dynamic loader does not find; it takes 40 ms to ask."""
    missing = []
    for library in LIBRARIES:
        try:
            ctypes.CDLL(library.soname)
        except OSError:
            missing.append(library)
    return missing


def require_libraries() -> None:
    """Refuse a machine that SUMO cannot be loaded on, naming the packages that are missing, or with another SUMO."""
    if missing := missing_libraries():
        raise _cannot_load(missing, "Run `harness setup`, which installs them")
    _require_version()


def _require_version() -> None:
    """Refuse another version, wherever PYTHONPATH finds it; one that is not the installed package's is named."""
    place = getattr(find_spec("libsumo"), "origin", None)
    with suppress(PackageNotFoundError):
        package = distribution("libsumo")
        if (str(package.locate_file("libsumo/__init__.py")), package.version) == (place, SUMO_VERSION):
            return
    try:
        import libsumo  # noqa: PLC0415 - takes half a second

        version = str(libsumo.getVersion()[1]).removeprefix("SUMO ")
    except (ImportError, AttributeError) as error:
        raise not_importable(f"{error}; it is that of {place}") from error
    if version != SUMO_VERSION:
        mend = f"Take its folder off PYTHONPATH, or {_REINSTALL}."
        raise HarnessError(f"libsumo in {place}", f"version {version}", f"version {SUMO_VERSION}", mend)
    sys.stderr.write(f"note: libsumo {version} is that of {place}.\n")


def install_commands(missing: Sequence[SystemLibrary]) -> list[list[str]]:
    """Commands that install missing libraries here, or a `HarnessError`: no known package manager, or no right to."""
    manager = next((name for name, commands in _INSTALL.items() if shutil.which(commands[0].split()[0])), None)
    if manager is None:
        raise _cannot_load(missing, "Neither apt-get nor dnf is here: install them as this system does")
    root: list[str] = []
    if os.geteuid() != 0:
        if shutil.which("sudo") is None:
            raise _cannot_load(missing, "You are not root and there is no sudo: run `harness setup` as root")
        root = ["sudo"] if sys.stdin.isatty() else ["sudo", "-n"]  # nobody is there to type a password
    commands = [[*root, *_ASK_NOTHING, *command.split()] for command in _INSTALL[manager]]
    commands[-1] += [getattr(library, manager) for library in missing]
    return commands


def install(missing: Sequence[SystemLibrary], commands: Sequence[Sequence[str]]) -> None:
    """Run the commands of `install_commands`, of which the last counts, silently.

    Raises `HarnessError`: it failed, with what the package manager complained about.
    """
    output: list[str] = []
    for command in commands:
        # Standard input is left out, so that nothing waits for an answer; sudo asks at the terminal itself.
        process = subprocess.run(  # noqa: S603 - our own words, and names from our own table
            command, stdin=subprocess.DEVNULL, stdout=subprocess.PIPE, stderr=subprocess.STDOUT, text=True, check=False
        )
        output += process.stdout.splitlines()[-_QUOTED:] if process.returncode else []
    if process.returncode:
        found = f"exit code {process.returncode}: {' | '.join(output)}"
        mend = f"See to what it says, or give your administrator the line for this system:\n{_install_lines(missing)}"
        raise HarnessError(shlex.join(commands[-1]), found, "the packages installed", mend)


def require_libsumo() -> None:
    """Import libsumo in another process: the loader of this one may not look again for what it did not find before."""
    command = [sys.executable, "-c", "import libsumo"]
    process = subprocess.run(command, capture_output=True, text=True, check=False)  # noqa: S603 - our own words
    if process.returncode:
        words = process.stderr.strip().splitlines()
        raise not_importable(words[-1] if words else f"exit code {process.returncode}")


def not_importable(words: str) -> HarnessError:
    """Error for a libsumo that does not load though the known libraries are there, with the loader's own words."""
    expected = f"libsumo {SUMO_VERSION} as `pip install` brings it, and the system libraries that it names"
    mend = f"Install the package of this system that holds the named file, or {_REINSTALL}."
    return HarnessError("libsumo", f"that it cannot be imported: {words}", expected, mend)


def _cannot_load(missing: Sequence[SystemLibrary], advice: str) -> HarnessError:
    found = f"no {', '.join(library.soname for library in missing)}"
    expected = "the shared libraries that libsumo needs of the system"
    mend = f"{advice}, or give your administrator the line for this system:\n{_install_lines(missing)}"
    return HarnessError("system libraries of SUMO", found, expected, mend)


def _install_lines(libraries: Sequence[SystemLibrary]) -> str:
    apt, dnf = (" ".join(getattr(library, manager) for library in libraries) for manager in ("apt", "dnf"))
    return (
        f"    Debian, Ubuntu:  apt-get update && apt-get install -y --no-install-recommends {apt}\n"
        f"    Fedora, RHEL:    dnf install -y {dnf}"
    )
