"""Streaming access to a run's Parquet shards: only the asked columns, one batch at a time.

A shard that is damaged, misses a column or holds another number of episodes than the manifest says is an error that
names the file: a report over part of the tests would look right and be wrong.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path

import pyarrow as pa
import pyarrow.compute as pc
import pyarrow.parquet as pq

from harness.errors import RunFolderError
from harness.records.folder import MEND_SHARD
from harness.report.run_folder import RunFolder

TABLES = ("episodes", "moments", "traces")
BATCH_ROWS = 65_536


@dataclass(frozen=True)
class TableSize:
    """How much of one table the run kept."""

    table: str
    n_files: int
    n_rows: int
    n_bytes: int


def table_sizes(run: RunFolder) -> list[TableSize]:
    """Rows and bytes per table, from the footers; checks that each episodes shard is complete.

    Raises
    ------
    RunFolderError
        If a listed file is missing or damaged, or an episodes shard has another length than the manifest says.
    """
    sizes = []
    for table in TABLES:
        rows = n_bytes = 0
        for shard, path in run.files(table):
            n_rows = _open(path).metadata.num_rows
            if table == "episodes" and n_rows != shard.n_episodes:
                raise _damaged(path, f"{n_rows} rows", f"{shard.n_episodes} rows (manifest.json)")
            rows, n_bytes = rows + n_rows, n_bytes + path.stat().st_size
        sizes.append(TableSize(table, len(run.files(table)), rows, n_bytes))
    return sizes


def episode_batches(run: RunFolder, columns: tuple[str, ...]) -> Iterator[pa.RecordBatch]:
    """Batches of the episodes that count, in index order, with the asked columns only.

    Raises
    ------
    RunFolderError
        If a shard is missing, damaged or misses a column.
    """
    for shard, path in run.files("episodes"):
        counted = run.n_episodes - shard.first_episode
        for batch in _batches(path, columns):
            if counted <= 0:
                break
            yield batch.slice(0, counted)
            counted -= batch.num_rows


def trace_rows(run: RunFolder, episodes: set[int], columns: tuple[str, ...]) -> pa.Table | None:
    """Trace rows of a few episodes; None when none of them was traced.

    Raises
    ------
    RunFolderError
        If a shard that could hold one of the episodes is damaged.
    """
    found = []
    for shard, path in run.files("traces"):
        here = [e for e in sorted(episodes) if shard.first_episode <= e < shard.first_episode + shard.n_episodes]
        if here:
            found.append(_filtered(path, here, columns))
    found = [table for table in found if table.num_rows]
    return pa.concat_tables(found).unify_dictionaries() if found else None


def _open(path: Path) -> pq.ParquetFile:
    try:
        return pq.ParquetFile(path)
    except FileNotFoundError:
        raise _damaged(path, "no such file", "the shard that manifest.json lists") from None
    except (pa.ArrowException, OSError) as error:
        raise _damaged(path, f"damaged Parquet ({error})", "a complete Parquet file") from error


def _batches(path: Path, columns: tuple[str, ...]) -> Iterator[pa.RecordBatch]:
    with _open(path) as file:
        missing = [name for name in columns if name not in file.schema_arrow.names]
        if missing:
            raise _damaged(path, f"no column {missing[0]!r}", "the columns of the episodes schema")
        try:
            yield from file.iter_batches(batch_size=BATCH_ROWS, columns=list(columns))
        except (pa.ArrowException, OSError) as error:
            raise _damaged(path, f"damaged Parquet ({error})", "a complete Parquet file") from error


def _filtered(path: Path, episodes: list[int], columns: tuple[str, ...]) -> pa.Table:
    """Rows of the given episodes; row groups that cannot hold them are skipped, so a traced run of any size is fine."""
    _open(path).close()
    try:
        return pq.read_table(path, columns=list(columns), filters=pc.field("episode").isin(episodes))
    except (pa.ArrowException, OSError) as error:
        raise _damaged(path, f"damaged Parquet ({error})", "a complete traces file") from error


def _damaged(path: Path, found: str, expected: str) -> RunFolderError:
    return RunFolderError(str(path), found=found, expected=expected, mend=MEND_SHARD)
