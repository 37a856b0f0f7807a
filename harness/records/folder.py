"""Where things are in a run folder, and atomic writing: a file is there completely, or not at all."""

from __future__ import annotations

import json
import os
import tempfile
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pyarrow as pa
import pyarrow.parquet as pq

from harness.errors import RunFolderError
from harness.records.tables import ShardTables

MANIFEST = "manifest.json"
SHELLS = "shells.json"
"""Strata of a shells campaign, as its estimates need them."""
TABLES = ("episodes", "moments", "traces")
COMPRESSION = "zstd"


def shard_file(table: str, index: int) -> str:
    """Path of a shard's table, relative to the run folder."""
    return f"{table}/shard-{index:06d}.parquet"


def write_atomically(path: Path, write: Callable[[Path], None]) -> None:
    """Let ``write`` fill a temporary file beside ``path``, then put it in place.

    A full disk or a killed process leaves no half-written file under the final name.
    """
    path.parent.mkdir(parents=True, exist_ok=True)
    handle, name = tempfile.mkstemp(dir=path.parent, prefix=".", suffix=".part")
    os.close(handle)
    temporary = Path(name)
    try:
        write(temporary)
        temporary.chmod(0o644)
        temporary.replace(path)
    finally:
        temporary.unlink(missing_ok=True)


def write_bytes(path: Path, content: bytes) -> None:
    """Write a file atomically."""
    write_atomically(path, lambda temporary: _write(temporary, content))


def _write(path: Path, content: bytes) -> None:
    path.write_bytes(content)


def write_text(path: Path, text: str) -> None:
    """Write a text file atomically."""
    write_bytes(path, text.encode("utf-8"))


def write_json(path: Path, content: Any) -> None:
    """Write JSON atomically."""
    write_text(path, json.dumps(content, indent=2, ensure_ascii=False, allow_nan=False) + "\n")


def write_shard(folder: Path, index: int, tables: ShardTables) -> dict[str, str]:
    """Write a shard's tables; ``episodes`` last, so that its presence means that the shard is complete.

    Returns
    -------
    dict
        Table name → path relative to the folder.
    """
    files = {}
    for name in reversed(TABLES):
        table = getattr(tables, name)
        if table is not None:
            files[name] = shard_file(name, index)
            write_atomically(folder / files[name], lambda path, table=table: _write_parquet(path, table))  # type: ignore[misc]
    return files


def _write_parquet(path: Path, table: pa.Table) -> None:
    pq.write_table(table, path, compression=COMPRESSION)


def read_table(path: Path, columns: list[str] | None = None) -> pa.Table:
    """Read one Parquet file of a run.

    Raises
    ------
    RunFolderError
        The file is missing or damaged.
    """
    try:
        return pq.read_table(path, columns=columns, memory_map=False, partitioning=None)
    except (OSError, pa.ArrowException, KeyError) as error:
        raise damaged(path, error) from error


def damaged(path: Path, error: Exception) -> RunFolderError:
    """What to say of a Parquet file of a run that cannot be read."""
    return RunFolderError(
        str(path),
        found=f"a file that cannot be read ({str(error).splitlines()[0]})",
        expected="a complete Parquet file of this run",
        mend="Delete it and its episodes file and run again with --resume: the same episodes are made anew.",
    )


def read_manifest(folder: Path) -> dict[str, Any]:
    """Read ``manifest.json`` of a run.

    Raises
    ------
    RunFolderError
        There is none, or it is not one that a run has written.
    """
    path, mend = folder / MANIFEST, "Give a folder that `harness run` has written."
    content = read_json(path, mend=mend)
    missing = [key for key in ("campaign_hash", "n_episodes", "shards") if key not in content]
    if missing:
        found = f"no {', '.join(missing)}"
        raise RunFolderError(str(path), found=found, expected="the manifest of a run", mend=mend)
    return content


def read_json(path: Path, *, mend: str) -> dict[str, Any]:
    """Read a JSON object of a run.

    Raises
    ------
    RunFolderError
        The file is missing or not a JSON object.
    """
    try:
        content = json.loads(path.read_text(encoding="utf-8"))
    except (OSError, ValueError) as error:
        raise RunFolderError(str(path), found=str(error), expected="a JSON file of a run", mend=mend) from error
    if not isinstance(content, dict):
        raise RunFolderError(str(path), found=type(content).__name__, expected="a JSON object", mend=mend)
    return content
