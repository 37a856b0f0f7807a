"""Install the missing system libraries with the system's package manager: as root, or by sudo where that is allowed."""

from __future__ import annotations

import os
import shlex
import shutil
import subprocess
import sys
from collections.abc import Sequence

from harness.errors import HarnessError
from harness.sumo.system_libraries import SystemLibrary, cannot_load, install_lines, not_importable

_INSTALL: dict[str, tuple[tuple[str, ...], ...]] = {
    # Ubuntu's own updates hold the lock for some minutes after a first start: wait instead of failing.
    "apt": (
        ("apt-get", "update"),
        ("apt-get", "-o", "DPkg::Lock::Timeout=300", "install", "-y", "--no-install-recommends"),
    ),
    "dnf": (("dnf", "install", "-y", "--setopt=install_weak_deps=False"),),
    "apk": (("apk", "add", "--no-cache"),),
}
_ASK_NOTHING = ("env", "DEBIAN_FRONTEND=noninteractive", "LC_ALL=C")
_QUOTED = 2
"""Lines of each command that an error repeats."""


def install_commands(missing: Sequence[SystemLibrary]) -> list[list[str]]:
    """Commands that install the packages of missing libraries here; all but the last prepare the last.

    Raises
    ------
    HarnessError
        No package manager that is known, or neither root nor sudo.
    """
    manager = next((name for name, commands in _INSTALL.items() if shutil.which(commands[0][0])), None)
    if manager is None:
        raise cannot_load(missing, "None of apt-get, dnf and apk is here: install them as this system does")
    *before, last = _INSTALL[manager]
    packages = [getattr(library, manager) for library in missing]
    root = _as_root(missing)
    return [[*root, *_ASK_NOTHING, *command] for command in (*before, (*last, *packages))]


def _as_root(missing: Sequence[SystemLibrary]) -> list[str]:
    if os.geteuid() == 0:
        return []
    if shutil.which("sudo") is None:
        raise cannot_load(missing, "You are not root and there is no sudo: run `harness setup` as root")
    return ["sudo"] if sys.stdin.isatty() else ["sudo", "-n"]  # nobody is there to type a password


def install(missing: Sequence[SystemLibrary], commands: Sequence[Sequence[str]]) -> None:
    """Run the commands of `install_commands`, silently unless the last fails.

    Raises
    ------
    HarnessError
        The packages could not be installed; it repeats what the package manager complained about.
    """
    said: list[str] = []
    for command in commands:
        # Standard input is left out, so that nothing waits for an answer; sudo asks at the terminal itself.
        done = subprocess.run(  # noqa: S603 - our own words, and names from our own table
            command, stdin=subprocess.DEVNULL, stdout=subprocess.PIPE, stderr=subprocess.STDOUT, text=True, check=False
        )
        said += _complaints(done.stdout, failed=done.returncode != 0)
    if done.returncode:
        raise HarnessError(
            shlex.join(commands[-1]),
            found=f"exit code {done.returncode}: {' | '.join(said)}",
            expected="the packages installed",
            mend=f"See to what it says, or give your administrator the line for this system:\n{install_lines(missing)}",
        )


def _complaints(said: str, *, failed: bool) -> list[str]:
    """The lines that say what went wrong: apt marks them, the cause first; others end with them."""
    lines = [line.strip() for line in said.splitlines() if line.strip()]
    marked = [line for line in lines if line.startswith(("E:", "W:"))]
    return marked[:_QUOTED] or (lines[-_QUOTED:] if failed else [])


def require_libsumo() -> None:
    """Import libsumo in a process of its own: what this one's loader did not find before, it may not look for again.

    Raises
    ------
    HarnessError
        It does not load.
    """
    command = [sys.executable, "-c", "import libsumo"]
    done = subprocess.run(command, capture_output=True, text=True, check=False)  # noqa: S603 - our own words
    if done.returncode:
        words = done.stderr.strip().splitlines()
        raise not_importable(words[-1] if words else f"exit code {done.returncode}")
