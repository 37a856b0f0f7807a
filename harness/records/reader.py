"""Read the shards that count, in index order, one at a time."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path

import pyarrow as pa

from harness.records.folder import read_manifest, read_table


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
        A file is missing or damaged.
    """
    for shard in read_manifest(folder)["shards"]:
        files = shard["files"]
        episodes = read_table(folder / files["episodes"], episode_columns)
        moments = None
        if "moments" in files and moment_columns != []:
            moments = read_table(folder / files["moments"], moment_columns)
        yield episodes, moments
