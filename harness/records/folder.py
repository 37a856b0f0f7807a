"""The files of a run folder, and how they are written and read.

Functions that read raise a `RunFolderError` that names a file which is missing, damaged, or not what a run has written.
"""

from __future__ import annotations

import fcntl
import json
import os
import tempfile
import zlib
from collections.abc import Iterable, Iterator, Mapping, Sequence
from contextlib import contextmanager, suppress
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Any, TypeVar

import pyarrow as pa
import pyarrow.parquet as pq
from pydantic import BaseModel, ConfigDict, Field, TypeAdapter, ValidationError

from harness.errors import MEND_PART, RunFolderError, shortened
from harness.files import write_atomically
from harness.vocabulary import StoppedBy

T = TypeVar("T")
Tables = dict[str, pa.Table]
"""Tables of the same tests, by name."""

MANIFEST = "manifest.json"
CAMPAIGN = "campaign.yaml"
SHELLS = "shells.json"
"""Strata of a shells campaign, as its estimates need them."""
ESTIMATES, SENSITIVITY = "estimates.json", "sensitivity.json"
TABLES = ("episodes", "moments", "traces")
SHADOW, MILDER = BEFORE = ("shadow", "milder")
"""Tables of what comes before tests that count: baseline runs (of old named shadow), and milder events."""
SEAL = "crc32"
"""Key of a JSON file's checksum."""
NO_RUN = "Give a folder that `harness run` has written."


def require_place(folder: Path) -> None:
    """Refuse a folder in which nothing can be written, before work is spent on it; the folder is not changed."""
    with _made(folder):
        pass


@contextmanager
def _made(folder: Path) -> Iterator[None]:
    """Make a folder to write in; afterwards remove new folders, it and those above, that are still empty."""
    new = [path for path in (folder, *folder.parents) if not path.exists()]
    try:
        try:
            folder.mkdir(parents=True, exist_ok=True)
            tempfile.TemporaryFile(dir=folder).close()
        except OSError as error:
            found, expected = f"a place where nothing can be written ({error.strerror})", "a folder, or a place for one"
            mend = "Choose another place, or change its permissions."
            raise RunFolderError(str(folder), found, expected, mend) from error
        yield
    finally:
        with suppress(OSError):
            for path in new:
                path.rmdir()


@contextmanager
def sole_use(folder: Path) -> Iterator[None]:
    """Make a run folder and lock it against other processes; a new one that stays empty is removed again."""
    with _made(folder):
        handle = os.open(folder, os.O_RDONLY)
        try:
            try:
                fcntl.flock(handle, fcntl.LOCK_EX | fcntl.LOCK_NB)
            except BlockingIOError:
                found = "a folder into which another process is running a campaign"
                mend = "Wait for the other one, or end it, or choose another folder with --out."
                raise RunFolderError(str(folder), found, "a folder for this process alone", mend) from None
            except OSError:
                pass  # some network file systems cannot lock a folder
            yield
        finally:
            os.close(handle)


def write_bytes(path: Path, content: bytes) -> None:
    """Write a file atomically."""
    write_atomically(path, lambda temporary: temporary.write_bytes(content))


def write_together(contents: Mapping[Path, bytes]) -> None:
    """Write files atomically: all are written before any is put in place, the first one last."""
    (path, content), *others = contents.items()

    def write(temporary: Path) -> None:
        temporary.write_bytes(content)
        if others:
            write_together(dict(others))

    write_atomically(path, write)


def write_json(path: Path, content: Any) -> None:
    """Write JSON atomically."""
    text = json.dumps(content, indent=2, ensure_ascii=False, allow_nan=False)
    write_bytes(path, f"{text}\n".encode())


def write_sealed(path: Path, content: Mapping[str, Any]) -> None:
    """Write a JSON file for `read_as`: a checksum of its values is the last of them."""
    values = {key: value for key, value in content.items() if key != SEAL}
    write_json(path, {**values, SEAL: _seal(values)})


def _seal(values: Mapping[str, Any]) -> int:
    return zlib.crc32(json.dumps(values, ensure_ascii=False).encode())


def require_sum(path: Path, crc32: int | None, content: bytes, mend: str) -> None:
    """Refuse (`RunFolderError`) a file whose ``content`` has another checksum than the manifest's, if that has one."""
    if crc32 is not None and (found := zlib.crc32(content)) != crc32:
        expected = f"{crc32:08x} (manifest.json): the file as the run has left it"
        raise RunFolderError(str(path), f"a changed or damaged file: checksum {found:08x}", expected, mend)


def parquet(table: pa.Table) -> bytes:
    """A table as the content of a file: the same bytes whether its rows come from here, a worker, or another file.

    Arrow calls the values of a list "item", Parquet "element", and pickling keeps the name only of some lists.
    """

    def renamed(kind: pa.DataType) -> pa.DataType:
        if not hasattr(kind, "value_field"):
            return kind
        return pa.list_(pa.field("element", kind.value_type), getattr(kind, "list_size", -1))

    schema = pa.schema([field.with_type(renamed(field.type)) for field in table.schema])
    table = pa.Table.from_arrays(table.columns, schema=schema.with_metadata(table.schema.metadata))
    sink = pa.BufferOutputStream()
    pq.write_table(table, sink, compression="zstd", write_page_checksum=True)
    return sink.getvalue().to_pybytes()  # type: ignore[no-any-return]


def write_part(folder: Path, shards: Sequence[Tables], first: int, n: int) -> Part:
    """Write tables of consecutive tests, a file for each name that has rows; they count once a manifest lists them."""
    files = {}
    for name in sorted({name for shard in shards for name in shard}):
        if tables := [shard[name] for shard in shards if name in shard and shard[name].num_rows]:
            path = f"{name}/{first:09d}-{first + n:09d}.parquet"
            content = parquet(concatenated(tables, folder))
            write_bytes(folder / path, content)
            files[name] = File(path, sum(table.num_rows for table in tables), zlib.crc32(content))
    return Part(first, n, files)


def remove_unlisted(folder: Path, parts: Iterable[Part]) -> None:
    """Remove files of tables that none of the parts lists."""
    listed = {folder / file.path for part in parts for file in part.files.values()}
    for table in (*TABLES, *BEFORE):
        for path in set((folder / table).glob("*.parquet")) - listed:
            path.unlink()


def arrow_file(content: bytes) -> pa.BufferReader:
    """A file in Arrow's own memory: a reader thread that frees Python's memory as the process ends would abort it."""
    sink = pa.BufferOutputStream()
    sink.write(content)
    return pa.BufferReader(sink.getvalue())


def _content(path: Path) -> bytes:
    """Content of a file; a pipe in its place is an `OSError`, where nobody may ever write."""
    if path.is_fifo():
        raise OSError("a pipe")
    return path.read_bytes()


def read_table(
    path: Path, columns: list[str] | None = None, *, crc32: int | None = None, mend: str = MEND_PART
) -> pa.Table:
    """Read one Parquet file of a run; its checksum ``crc32`` is verified or, without one, those of its pages."""
    try:
        content = _content(path)
        require_sum(path, crc32, content, mend)
        # Faster than read_table by a millisecond.
        with pq.ParquetFile(arrow_file(content), page_checksum_verification=crc32 is None) as file:
            table = file.read(columns)
    except (OSError, pa.ArrowException, KeyError, UnicodeDecodeError) as error:
        raise damaged(path, error, mend) from error
    if missing := sorted(set(columns or ()).difference(table.column_names)):
        raise damaged(path, pa.ArrowInvalid(f"no column {missing[0]!r}"), mend)
    return table


def read_kept(folder: Path, part: Part, table: str, columns: list[str] | None = None) -> pa.Table:
    """One table of a part, with as many rows as the manifest says; see `read_table`."""
    file = part.files[table]
    content = read_table(folder / file.path, columns, crc32=file.crc32)
    if content.num_rows != file.n_rows:
        expected = f"{file.n_rows} rows (manifest.json)"
        raise RunFolderError(str(folder / file.path), f"{content.num_rows} rows", expected, MEND_PART)
    return content


def concatenated(tables: Sequence[pa.Table], folder: Path) -> pa.Table:
    """Tables of consecutive tests of a run as one, in one chunk; refused where a column is not of one type."""
    try:
        return pa.concat_tables(tables).unify_dictionaries().combine_chunks()
    except pa.ArrowException as error:
        found, expected = f"parts of different types: {error}", "records of one version of the harness"
        raise RunFolderError(str(folder), found, expected, "Run the campaign again into a new folder.") from error


def damaged(path: Path, error: Exception, mend: str = MEND_PART, kind: str = "a whole Parquet file") -> RunFolderError:
    """The error for a file of a run that cannot be read; ``mend`` is the advice unless its permissions forbid it."""
    missing, forbidden = isinstance(error, FileNotFoundError), isinstance(error, PermissionError)
    found = "no such file" if missing else f"a file that cannot be read ({str(error).splitlines()[0]})"
    return RunFolderError(str(path), found, kind, "Change its permissions." if forbidden else mend)


def no_episodes(folder: Path) -> RunFolderError:
    """The error for a run that was ended before its first shard was finished."""
    found = "a run that has not finished a test yet"
    return RunFolderError(str(folder), found, "tests on record", "Let `harness run` go on with --resume.")


Count = Annotated[int, Field(ge=0, lt=2**63)]
TablePath = Annotated[str, Field(pattern=r"^[a-z]+/[A-Za-z0-9_-]+\.parquet$")]


@dataclass(frozen=True)
class File:
    """A file of a run folder: where it is, its number of rows and, where it is known, its checksum."""

    path: TablePath
    n_rows: Count
    crc32: Count | None = None


@dataclass(frozen=True)
class Part:
    """Consecutive tests of a round, in one file per table that has rows."""

    first_episode: Count
    n_episodes: Count
    files: dict[str, File]

    @property
    def end(self) -> int:
        """Index of the test after the last."""
        return self.first_episode + self.n_episodes


@dataclass(frozen=True)
class Repeated:
    """How many tests were run twice, and which of them (campaign indices) came out otherwise the second time."""

    n_episodes: Count
    differing: list[Count]

    def __add__(self, other: Repeated) -> Repeated:
        return Repeated(self.n_episodes + other.n_episodes, sorted({*self.differing, *other.differing}))


class StoredManifest(BaseModel):
    """Keys of ``manifest.json`` that are required, and optional ones that answers rest on.

    Other keys are not checked one by one: the file's checksum covers them.
    """

    model_config = ConfigDict(extra="allow", strict=True, allow_inf_nan=False)

    campaign_hash: str
    n_episodes: Count
    parts: list[Part]
    campaign_crc32: Count | None = None
    versions: dict[str, str] = {}
    stopped_by: StoppedBy | None = None
    unmet: list[dict[str, Any]] = []
    wall_time_s: float | None = None
    distance_per_test_m: float | None = None
    tests_per_hour: float | None = None
    repeated: Repeated | None = None
    before: dict[str, Part] = {}


def read_manifest(folder: Path, *, mend: str = NO_RUN) -> dict[str, Any]:
    """Read ``manifest.json`` of a run, as `StoredManifest` says; ``mend`` is the advice where it cannot be."""
    path = folder / MANIFEST
    if not path.exists():
        expected = "a run folder, which holds a manifest.json"
        if runs := sorted(folder.glob("*/" + MANIFEST)) or sorted(folder.glob("*/*/" + MANIFEST)):
            compared = {run.parent.name for run in runs} == {"a", "b"}
            again = "the same `harness compare`" if compared else "`harness run` with --resume"
            mend = f"Name one, such as {runs[0].parent}. If it is not finished, {again} goes on."
            raise RunFolderError(str(folder), "a folder of several runs", "the run folder of one", mend)
        raise RunFolderError(str(path), "no such file: this is no run folder", expected, mend)
    manifest = read_as(StoredManifest, path, mend=mend)
    return {**manifest.model_dump(exclude_unset=True), "parts": manifest.parts, "before": manifest.before}


def read_as(kind: type[T], path: Path, *, mend: str, key: str = "") -> T:
    """Read a JSON file of a run as a type, with a key; what no run has written is refused by its first wrong value."""
    expected = "a JSON file of a run"
    try:
        content = _content(path)
        value = TypeAdapter(kind).validate_json(content, strict=True)
        values = json.loads(content)
    except (OSError, UnicodeDecodeError) as error:
        raise damaged(path, error, mend, expected) from error
    except ValidationError as error:
        first, *others = error.errors(include_url=False)
        where = ".".join(map(str, first["loc"])) or "content"
        more = f", and {len(others)} more that do not fit" if others else ""
        found = f"no key {where}" if first["type"] == "missing" else f"{where} {shortened(repr(first['input']), 60)}"
        wrong = f"what a run has written: {first['msg'][:1].lower()}{first['msg'][1:]}"
        raise RunFolderError(str(path), found + more, wrong, mend) from None
    if key and key not in values:
        raise RunFolderError(str(path), f"no key {key}", "what a run has written", mend)
    if (seal := values.pop(SEAL, "none")) != _seal(values):
        raise RunFolderError(str(path), f"values that do not fit their checksum ({SEAL}: {seal})", expected, mend)
    return value
