"""What can be made again is kept where it can be, and what is damaged or another's is as good as none."""

import os
import pwd
import re
import resource
import shutil
import tempfile
import time
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path

import pytest

from harness import cache
from harness.errors import HarnessError, writing

NAME, OTHER, CONTENT = "pools/one", "pools/other", bytes(range(256))


@pytest.fixture(autouse=True)
def folder(tmp_path, monkeypatch) -> Path:
    monkeypatch.setenv(cache.FOLDER, str(tmp_path / "cache"))
    monkeypatch.delenv(cache.SAID, raising=False)
    monkeypatch.setattr(tempfile, "tempdir", str(tmp_path))
    return tmp_path / "cache"


@pytest.fixture
def spare(tmp_path) -> Path:
    return tmp_path / f"harness-{os.geteuid()}"


def flipped(bit: int):
    def flip(path: Path) -> None:
        content = bytearray(path.read_bytes())
        content[bit // 8 % len(content)] ^= 1 << bit % 8
        path.write_bytes(content)

    return flip


@pytest.mark.parametrize(
    "damage",
    [
        *map(flipped, range(0, 8 * 260, 497)),
        lambda path: path.write_bytes(b""),
        lambda path: path.write_bytes(path.read_bytes()[:-1]),
        lambda path: shutil.copy(path.with_name("other"), path),
        lambda path: (path.unlink(), path.mkdir()),
        lambda path: (path.unlink(), os.mkfifo(path)),
        lambda path: (path.unlink(), path.symlink_to("/dev/zero")),
    ],
)
def test_a_damaged_file_or_that_of_another_is_as_good_as_none(folder, damage):
    for name in (NAME, OTHER):
        cache.keep(name, CONTENT)
    assert cache.read(NAME) == CONTENT
    damage(folder / NAME)
    assert cache.read(NAME) is None
    assert cache.find(NAME) is None
    if (folder / NAME).is_file():
        cache.keep(NAME, CONTENT)
        assert cache.read(NAME) == CONTENT


def nowhere_writable(folder, monkeypatch) -> None:
    """Below a file nobody can make a folder, root included."""
    folder.parent.joinpath("file").touch()
    monkeypatch.setenv(cache.FOLDER, str(folder.parent / "file" / "cache"))


def no_home(_folder, monkeypatch) -> None:
    def unknown(_uid):
        raise KeyError

    for name in (cache.FOLDER, "HOME", "XDG_CACHE_HOME"):
        monkeypatch.delenv(name, raising=False)
    monkeypatch.setattr(pwd, "getpwuid", unknown)


@pytest.mark.parametrize(("where", "said"), [(nowhere_writable, "cannot be written"), (no_home, "no home folder")])
def test_what_cannot_be_kept_in_its_place_is_kept_for_this_user_alone_and_that_is_said_once(
    folder, spare, monkeypatch, capsys, where, said
):
    where(folder, monkeypatch)
    assert cache.read(NAME) is None
    assert not spare.exists()
    for name in (NAME, OTHER):
        assert cache.keep(name, CONTENT) == spare / name
    assert (cache.read(NAME), cache.has(OTHER)) == (CONTENT, True)
    assert spare.stat().st_mode & 0o777 == 0o700
    (note,) = capsys.readouterr().err.splitlines()
    assert said in note
    assert str(spare) in note


def test_a_cache_that_may_only_be_read_is_read_and_what_it_lacks_goes_elsewhere(folder, spare, monkeypatch):
    cache.keep(NAME, CONTENT)
    write = cache.write_atomically

    def read_only(path, fill):
        if path.is_relative_to(folder):
            raise PermissionError(13, "Permission denied")
        write(path, fill)

    monkeypatch.setattr(cache, "write_atomically", read_only)
    cache.keep(OTHER, CONTENT)
    assert (cache.read(NAME), cache.find(OTHER)) == (CONTENT, spare / OTHER)
    flipped(100)(folder / NAME)
    cache.keep(NAME, CONTENT)
    assert cache.find(NAME) == spare / NAME


@pytest.mark.parametrize("kind", ["link", "open", "file", "foreign"])
def test_a_folder_that_others_can_write_to_is_neither_read_nor_written(folder, spare, monkeypatch, kind):
    nowhere_writable(folder, monkeypatch)
    cache.keep(NAME, CONTENT)
    if kind == "link":
        spare.rename(spare.with_name("elsewhere"))
        spare.symlink_to("elsewhere")
    elif kind == "open":
        spare.chmod(0o775)
    elif kind == "file":
        shutil.rmtree(spare)
        spare.touch(0o600)
    else:
        stranger = os.geteuid() + 1
        monkeypatch.setattr(os, "geteuid", lambda: stranger)
        spare.rename(spare.with_name(f"harness-{stranger}"))
    assert cache.read(NAME) is None
    with pytest.raises(HarnessError, match="not this user's alone"):
        cache.keep(NAME, CONTENT)


def test_a_full_disk_is_no_reason_to_go_elsewhere(spare):
    def fail(path):
        with writing(path):
            raise OSError(28, "No space left on device")

    with pytest.raises(OSError, match="No space left") as raised:
        cache.put(NAME, fail)
    assert raised.value.filename.endswith(NAME)
    assert not spare.exists()


def test_what_has_not_been_used_for_longest_makes_room(folder, monkeypatch):
    names = [f"tables/{i}" for i in range(4)]
    for i, name in enumerate(names[:3]):
        cache.keep(name, CONTENT)
        os.utime(folder / name, (i, i))
    monkeypatch.setattr(cache, "MOST_BYTES", 3 * 260)
    assert cache.read(names[0]) == CONTENT
    cache.keep(names[3], CONTENT)
    assert [cache.has(name) for name in names] == [True, False, True, True]
    monkeypatch.setattr(cache, "MOST_BYTES", 0)  # a file is not its own room
    cache.keep(names[1], CONTENT)
    assert [cache.has(name) for name in names] == [False, True, False, False]


def test_what_another_makes_is_waited_for(folder):
    waited, made = [], []

    def make(i):
        time.sleep(0.05 * i)
        with cache.made_once(NAME, waited.append):
            if cache.read(NAME) is None:
                time.sleep(0.2)
                made.append(i)
                cache.keep(NAME, CONTENT)

    with ThreadPoolExecutor(3) as threads:
        list(threads.map(make, range(3)))
    assert (len(made), len(waited)) == (1, 2)
    assert all(re.fullmatch(rf"process {os.getpid()}, since \d\d:\d\d:\d\d", each) for each in waited)
    assert [path.name for path in (folder / "pools").iterdir()] == ["one"]
    with cache.made_once(OTHER, waited.append):
        pass
    assert len(waited) == 2


def test_who_does_not_get_on_is_not_waited_for_longer_than_that(folder):
    waited = []
    with cache.made_once(NAME, waited.append), cache.made_once(NAME, waited.append, most_s=0.2):
        assert len(waited) == 1
    assert not list((folder / "pools").iterdir())


def test_a_lock_is_held_also_where_nothing_can_be_written(folder):
    soft, hard = resource.getrlimit(resource.RLIMIT_FSIZE)
    resource.setrlimit(resource.RLIMIT_FSIZE, (0, hard))
    try:
        with cache.made_once(NAME, lambda _: None):
            assert [path.name for path in (folder / "pools").iterdir()] == [".one.lock"]
    finally:
        resource.setrlimit(resource.RLIMIT_FSIZE, (soft, hard))
    assert not list((folder / "pools").iterdir())
