"""Read the shards that count, in index order: one at a time, or all as pandas frames with units and weights.

Every function raises a `RunFolderError` that names a file which is missing or damaged.
"""

from __future__ import annotations

from collections.abc import Collection, Iterator, Mapping, Sequence
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Any, NamedTuple

import numpy as np
import pyarrow as pa
import pyarrow.compute as pc
import pyarrow.parquet as pq

from harness.errors import RunFolderError
from harness.processes import made_ahead
from harness.records.folder import (
    MEND_SHARD,
    SHELLS,
    TABLES,
    concatenated,
    damaged,
    no_episodes,
    read_manifest,
    read_table,
)

if TYPE_CHECKING:
    import pandas as pd

_READERS = 2
"""Threads; each holds a shard."""
_WEIGHT = pa.field(
    "weight", pa.float64(), metadata={"unit": "1", "doc": "the mean of weight times crash is the crash rate"}
)


def read_shards(
    folder: Path, *, episode_columns: list[str] | None = None, moment_columns: list[str] | None = None
) -> Iterator[tuple[pa.Table, pa.Table | None]]:
    """Episodes and moments of every shard that the manifest lists; moments are None where the campaign kept none.

    Columns are all by default, and no moments for an empty list. Each shard must be as long as the manifest says.
    """
    read = partial(read_shard, folder, episode_columns=episode_columns, moment_columns=moment_columns)
    yield from made_ahead(read, read_manifest(folder)["shards"], _READERS)


def read_shard(
    folder: Path,
    shard: Mapping[str, Any],
    *,
    episode_columns: list[str] | None = None,
    moment_columns: list[str] | None = None,
) -> tuple[pa.Table, pa.Table | None]:
    """Episodes and moments of one shard, as the manifest lists it; see `read_shards`."""
    files = shard["files"]
    episodes = read_table(folder / files["episodes"], episode_columns)
    if episodes.num_rows != shard["n_episodes"]:
        expected = f"{shard['n_episodes']} rows (manifest.json)"
        raise RunFolderError(str(folder / files["episodes"]), f"{episodes.num_rows} rows", expected, MEND_SHARD)
    moments = None
    if "moments" in files and moment_columns != []:
        moments = read_table(folder / files["moments"], moment_columns)
    return episodes, moments


def read_traces(folder: Path, episodes: Collection[int], columns: list[str]) -> pa.Table | None:
    """Trace rows of a few episodes; None where none of them was traced."""
    wanted = pc.field("episode").isin(sorted(episodes))
    tables = []
    for shard in read_manifest(folder)["shards"]:
        held = range(shard["first_episode"], shard["first_episode"] + shard["n_episodes"])
        if shard["files"].get("traces") and any(episode in held for episode in episodes):
            tables.append(read_table(folder / shard["files"]["traces"], columns, wanted))
    found = [table for table in tables if table.num_rows]
    return concatenated(found, folder) if found else None


def stored_columns(folder: Path) -> set[str]:
    """Columns of the episodes table of a run; none if it has no shard."""
    shards = read_manifest(folder)["shards"]
    return set(footer(folder / shards[0]["files"]["episodes"]).schema.to_arrow_schema().names) if shards else set()


class TableSize(NamedTuple):
    """How much of one table a run kept."""

    table: str
    n_files: int
    n_rows: int
    n_bytes: int


def table_sizes(folder: Path) -> list[TableSize]:
    """Files, rows and bytes per table."""
    shards = read_manifest(folder)["shards"]
    sizes = []
    for table in TABLES:
        kept = [shard for shard in shards if shard["files"].get(table)]
        files = [folder / shard["files"][table] for shard in kept]
        try:
            n_bytes = sum(file.stat().st_size for file in files)
        except OSError as error:
            raise damaged(Path(error.filename), error) from error
        sizes.append(TableSize(table, len(files), sum(footer(file).num_rows for file in files), n_bytes))
    return sizes


def footer(path: Path) -> pq.FileMetaData:
    """What a Parquet file says of itself."""
    try:
        return pq.read_metadata(path)
    except (OSError, pa.ArrowException) as error:
        raise damaged(path, error) from error


@dataclass(frozen=True)
class StoredRun:
    """A run folder, whose tables are read when asked for.

    ``frame.attrs["unit"]`` and ``frame.attrs["doc"]`` give unit and meaning of each column by its name; the unit
    of a number without one is ``"1"``, that of a text ``""``.
    """

    folder: Path

    def episodes(self, columns: Sequence[str] | None = None) -> pd.DataFrame:
        """One row per test, failed ones included, with its ``weight`` and all ``columns``, or those that are named.

        The mean of ``weight`` over all rows, those alone counted that crashed, is the crash rate per test, whatever the
        method. With ``shells`` a row weighs p_s n / n_s: its shell has probability p_s and n_s of the n tests.
        """
        kept = stored_columns(self.folder)
        if not kept:
            raise no_episodes(self.folder)
        asked = None if columns is None else set(columns) - {_WEIGHT.name}
        if unknown := sorted((asked or set()) - kept):
            found = f"no column {unknown[0]!r} in episodes"
            raise RunFolderError(str(self.folder), found, f"one of {', '.join(sorted(kept))}", "Correct its name.")
        needed = None if asked is None else sorted(asked | {"log_weight", "component"})
        shards = read_shards(self.folder, episode_columns=needed, moment_columns=[])
        table = concatenated([episodes for episodes, _ in shards], self.folder)
        frame = table.to_pandas()
        # The weight of a failed test, which counts as no crash, may be unknown.
        frame[_WEIGHT.name] = np.exp(frame["log_weight"].fillna(0.0))
        if (self.folder / SHELLS).is_file():
            frame[_WEIGHT.name] *= len(frame) / frame.groupby("component")["component"].transform("size")
        shown = frame if columns is None else frame[list(dict.fromkeys([*columns, _WEIGHT.name]))]
        return _described(shown, table.schema.append(_WEIGHT))

    def moments(self) -> pd.DataFrame:
        """One row per control step; a `RunFolderError` where the campaign kept none (``records.moments``)."""
        return self._kept("moments")

    def traces(self) -> pd.DataFrame:
        """One row per step and vehicle; a `RunFolderError` where nothing was traced (``records.traces``)."""
        return self._kept("traces")

    def _kept(self, name: str) -> pd.DataFrame:
        shards = read_manifest(self.folder)["shards"]
        tables = [read_table(self.folder / shard["files"][name]) for shard in shards if shard["files"].get(name)]
        if not tables:
            mend = f"Run it into another folder with --set records.{name}=all."
            raise RunFolderError(str(self.folder), f"no {name}", f"a run whose campaign kept {name}", mend)
        table = concatenated(tables, self.folder)
        return _described(table.to_pandas(), table.schema)


def _described(frame: pd.DataFrame, schema: pa.Schema) -> pd.DataFrame:
    """The same frame with what Arrow's field metadata says of its columns."""
    for key in ("unit", "doc"):
        frame.attrs[key] = {name: schema.field(name).metadata[key.encode()].decode() for name in frame.columns}
    return frame


def read(folder: str | Path) -> StoredRun:
    """Tables of a stored run as pandas frames, with units and weights."""
    return StoredRun(Path(folder))
