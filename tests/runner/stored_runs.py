"""Run folders as tests look at them: whole tables in order, compared by bits, and ways to damage a file."""

from __future__ import annotations

import json
import shutil
from pathlib import Path
from typing import Any

import pyarrow as pa
import pyarrow.compute as pc
import pyarrow.parquet as pq

from harness.records.folder import TABLES

ORDER = {"episodes": ["episode"], "moments": ["episode", "step"], "traces": ["episode", "step"]}


def manifest(folder: Path) -> dict[str, Any]:
    return json.loads((folder / "manifest.json").read_text())


def shard_files(folder: Path, table: str = "episodes") -> list[Path]:
    return sorted((folder / table).glob("shard-*.parquet"))


def stored_table(folder: Path, table: str) -> pa.Table:
    """All rows of a table that the manifest counts, sorted; the vehicles of a step keep their order."""
    files = [folder / shard["files"][table] for shard in manifest(folder)["shards"]]
    rows = pa.concat_tables([pq.read_table(file, partitioning=None) for file in files])
    keys = pa.table({name: _plain(rows[name]) for name in ORDER[table]})
    return rows.take(pc.sort_indices(keys, [(name, "ascending") for name in ORDER[table]]))


def _plain(column: pa.ChunkedArray | pa.Array) -> pa.ChunkedArray | pa.Array:
    return column.cast(column.type.value_type) if pa.types.is_dictionary(column.type) else column


def bits(column: pa.ChunkedArray | pa.Array) -> list[Any]:
    """A column as something in which equal means the same bits, nulls apart from zeros."""
    array = column.combine_chunks() if isinstance(column, pa.ChunkedArray) else column
    if pa.types.is_dictionary(array.type):
        return _plain(array).to_pylist()
    if pa.types.is_fixed_size_list(array.type) or pa.types.is_list(array.type):
        return [pc.list_value_length(array).to_pylist(), bits(array.flatten())]
    if pa.types.is_floating(array.type) or pa.types.is_integer(array.type):
        return [array.is_null().to_pylist(), array.fill_null(0).to_numpy().tobytes()]
    return array.to_pylist()


def unlike_columns(a: Path, b: Path) -> list[str]:
    """Columns in which two runs differ in any bit, as ``table.column``; estimates.json counts as one."""
    unlike = []
    for table in TABLES:
        rows_a, rows_b = stored_table(a, table), stored_table(b, table)
        assert rows_a.schema.equals(rows_b.schema, check_metadata=True)
        unlike += [f"{table}.{name}" for name in rows_a.column_names if bits(rows_a[name]) != bits(rows_b[name])]
    if (a / "estimates.json").read_bytes() != (b / "estimates.json").read_bytes():
        unlike.append("estimates.json")
    return unlike


def copy_of(folder: Path, to: Path) -> Path:
    """A copy that a test may damage."""
    return Path(shutil.copytree(folder, to))


def truncate(path: Path) -> None:
    """Cut a file in half, as a crashed machine may leave it."""
    content = path.read_bytes()
    path.write_bytes(content[: len(content) // 2])
