"""Read the shards that count, in index order, one at a time."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path

import pyarrow as pa
import pyarrow.parquet as pq

from harness.errors import RunFolderError
from harness.records.folder import MEND_SHARD, damaged, read_manifest, read_table


def read_shards(
    folder: Path, *, episode_columns: list[str] | None = None, moment_columns: list[str] | None = None
) -> Iterator[tuple[pa.Table, pa.Table | None]]:
    """Episodes and moments of every shard that the manifest lists.

    Parameters
    ----------
    folder : Path
        Run folder.
    episode_columns, moment_columns : list of str, optional
        Columns to read; all by default, and no moments at all for an empty list.

    Yields
    ------
    (episodes, moments)
        ``moments`` is None where the campaign kept none.

    Raises
    ------
    RunFolderError
        A file is missing or damaged, or holds another number of episodes than the manifest says.
    """
    for shard in read_manifest(folder)["shards"]:
        files = shard["files"]
        episodes = read_table(folder / files["episodes"], episode_columns)
        if episodes.num_rows != shard["n_episodes"]:
            raise RunFolderError(
                str(folder / files["episodes"]),
                found=f"{episodes.num_rows} rows",
                expected=f"{shard['n_episodes']} rows (manifest.json)",
                mend=MEND_SHARD,
            )
        moments = None
        if "moments" in files and moment_columns != []:
            moments = read_table(folder / files["moments"], moment_columns)
        yield episodes, moments


def stored_columns(folder: Path) -> set[str]:
    """Columns of the episodes table of a run; none if it has no shard.

    Raises
    ------
    RunFolderError
        The first shard is missing or damaged.
    """
    shards = read_manifest(folder)["shards"]
    if not shards:
        return set()
    path = folder / shards[0]["files"]["episodes"]
    try:
        return set(pq.read_schema(path).names)
    except (OSError, pa.ArrowException) as error:
        raise damaged(path, error) from error
