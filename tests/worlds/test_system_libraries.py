"""System libraries of SUMO: which they are, what is said where they are missing, and how they are installed."""

import os
import sys
from importlib import metadata
from pathlib import Path
from types import SimpleNamespace

import pytest

from harness.cli import main
from harness.errors import EXIT_BAD_INPUT
from harness.worlds import system_libraries
from harness.worlds.system_libraries import LIBRARIES, SystemLibrary
from tests.stored_runs import SCENARIOS

SMOKE = str(SCENARIOS / "smoke.yaml")
NOWHERE = SystemLibrary("libnowhere.so.7", "libnowhere7", "nowhere-libs")
ALWAYS_THERE = ("ld-linux", "libc.", "libdl.", "libgcc_s.", "libm.", "libpthread.", "libresolv.", "librt.")
LEAN = "--no-install-recommends"
MANAGERS = {
    "apt-get": ["apt-get update", f"apt-get -o DPkg::Lock::Timeout=300 install -y {LEAN} libnowhere7"],
    "dnf": ["dnf install -y --setopt=install_weak_deps=False nowhere-libs"],
}
"""What each package manager is called with."""


def _needed_of_the_system(package):
    """Sonames that the shared libraries and programs of an installed package need and do not bring along."""
    from elftools.elf.elffile import ELFFile

    needed, brought = set(), set()
    for path in (Path(str(file.locate())) for file in metadata.files(package) or []):
        if not path.is_file():
            continue
        with path.open("rb") as stream:
            if stream.read(4) == b"\x7fELF":
                brought.add(path.name)
                if dynamic := ELFFile(stream).get_section_by_name(".dynamic"):
                    needed |= {tag.needed for tag in dynamic.iter_tags("DT_NEEDED")}
    assert brought
    return needed - brought


@pytest.fixture
def bare_machine(monkeypatch):
    """A machine that lacks one library."""
    monkeypatch.setattr(system_libraries, "LIBRARIES", (*LIBRARIES, NOWHERE))


@pytest.fixture
def programs(monkeypatch, tmp_path):
    """The only programs of this machine, each noting how it was called; and who the user is."""
    folder = tmp_path / "bin"
    folder.mkdir()
    monkeypatch.setenv("PATH", str(folder))
    calls = tmp_path / "calls"
    calls.touch()

    def add(name, then="exit 0"):
        (folder / name).write_text(f'#!/bin/sh\necho {name} "$@" >> {calls}\n{then}\n')
        (folder / name).chmod(0o755)

    add("env", 'shift 2; exec "$@"')
    add.calls = lambda: [line for line in calls.read_text().splitlines() if not line.startswith("env ")]
    add.user = lambda uid, terminal=False: (
        monkeypatch.setattr(os, "geteuid", lambda: uid),
        monkeypatch.setattr(sys, "stdin", SimpleNamespace(isatty=lambda: terminal)),
    )
    return add


@pytest.mark.slow  # the versions are pinned
def test_the_list_is_what_the_wheels_need():
    known = {library.soname for library in LIBRARIES}
    needed = _needed_of_the_system("libsumo") | _needed_of_the_system("eclipse-sumo")
    assert {soname for soname in needed if not soname.startswith(ALWAYS_THERE)} == known


@pytest.mark.parametrize("command", ["check", "run"])
def test_commands_that_open_sumo_name_what_is_missing(command, bare_machine, tmp_path, monkeypatch, capsys):
    monkeypatch.chdir(tmp_path)
    assert main([command, SMOKE]) == EXIT_BAD_INPUT
    said = capsys.readouterr()
    assert said.out == ""
    for words in ("libnowhere.so.7", "harness setup", "libnowhere7", "dnf install -y nowhere-libs"):
        assert words in said.err
    assert "libX11" not in said.err  # what is there needs no package
    assert not any((tmp_path / "runs").rglob("*.*"))


@pytest.mark.parametrize(
    ("code", "where", "said"),
    [
        ("def getVersion():\n    return 21, 'SUMO 1.20.0'", "libsumo in ", "found:    version 1.20.0"),
        ("raise ImportError('no libproj.so')", "libsumo\n", "no libproj.so; it is that of "),
    ],
)
def test_a_libsumo_of_another_place_is_named_and_must_be_of_the_version_that_is_pinned(
    tmp_path, monkeypatch, capsys, code, where, said
):
    (tmp_path / "libsumo.py").write_text(code)
    monkeypatch.syspath_prepend(tmp_path)
    monkeypatch.delitem(sys.modules, "libsumo", raising=False)
    assert main(["run", SMOKE, "--out", str(tmp_path / "run")]) == EXIT_BAD_INPUT
    err = capsys.readouterr().err
    assert f"error: {where}" in err
    assert said in err
    assert str(tmp_path / "libsumo.py") in err


@pytest.fixture(autouse=True)
def compiled_before(monkeypatch):
    """`tests/test_compiled.py` compiles."""
    monkeypatch.setattr("harness.runner.setup.compile_kernels", lambda _: False)


def test_setup_does_nothing_where_nothing_is_missing(programs, capsys):
    for name in ("sudo", *MANAGERS):
        programs(name)
    programs.user(1000)
    assert main(["setup"]) == 0
    assert main(["setup", "--dry-run"]) == 0
    told = ["SUMO's system libraries are there.", "Kernels are compiled already.", "Nothing to install."]
    assert capsys.readouterr().out.splitlines() == told
    assert programs.calls() == []


USERS = [*((manager, 0, False, "") for manager in MANAGERS), ("dnf", 1, False, "sudo -n env")]


@pytest.mark.parametrize(("manager", "user", "terminal", "sudo"), USERS)
def test_root_installs_and_others_by_sudo(manager, user, terminal, sudo, bare_machine, programs, capsys):
    """Which asks only at a terminal."""
    programs(manager)
    programs("sudo", f'while [ "$1" != {manager} ]; do shift; done; exec "$@"')
    programs.user(user, terminal=terminal)
    assert main(["setup", "--dry-run"]) == 0
    assert [line.partition("LC_ALL=C ")[2] for line in capsys.readouterr().out.splitlines()] == MANAGERS[manager]
    assert programs.calls() == []
    assert main(["setup"]) == 0
    asked = [line for line in programs.calls() if line.startswith("sudo")]
    assert [line for line in programs.calls() if line not in asked] == MANAGERS[manager]
    assert [line.partition(" DEBIAN_FRONTEND=noninteractive")[0] for line in asked] == [sudo] * bool(user)


def test_a_libsumo_of_the_right_version_is_taken_from_another_place_and_that_is_said(tmp_path, monkeypatch, capsys):
    (tmp_path / "libsumo.py").write_text(f"def getVersion():\n    return 22, 'SUMO {system_libraries.SUMO_VERSION}'")
    monkeypatch.syspath_prepend(tmp_path)
    monkeypatch.delitem(sys.modules, "libsumo", raising=False)
    system_libraries.require_libraries()
    assert str(tmp_path) in capsys.readouterr().err
