"""Columns of many finished shards in few files: a copy, so that nobody has to open thousands of them again.

A part holds some columns of the episodes tables of consecutive shards, and size and checksum of each of their files. A
shard whose files are not the same bytes any more is not answered for, nor is one that no part holds: it is read itself.
Deleting the folder costs time, nothing else.
"""

from __future__ import annotations

import json
import zlib
from collections.abc import Mapping, Sequence
from contextlib import suppress
from pathlib import Path
from typing import Any, NamedTuple

import pyarrow as pa
import pyarrow.parquet as pq

from harness.compiled import WORLD_SOURCES, source_hash
from harness.records.folder import COMPRESSION, read_table, write_atomically

FOLDER = "gathered"
MOST_SHARDS, MOST_EPISODES = 500, 200_000
"""Of a part. A run that is killed loses a part that was not full; reading one takes some 20 MB of memory."""
_KEY = b"harness.gathered"
_LAYOUT = 1

Fingerprint = tuple[int, int]
"""Size (bytes) and CRC-32 of a file: against damage, not against malice."""


def fingerprint(path: str | Path) -> Fingerprint | None:
    """Size and checksum of a file; None if it cannot be read."""
    with suppress(OSError), open(path, "rb", buffering=0) as file:  # noqa: PTH123 - a path takes as long as reading
        content = file.read()
        return len(content), zlib.crc32(content)
    return None


class GatheredShard(NamedTuple):
    """Where a part holds a shard, and what is known of the shard besides.

    ``row`` is its first row in the part ``path``; ``n_retraced`` are the episodes that the twin retraced when it was
    taken over; ``metadata`` is that of its episodes file.
    """

    path: Path
    row: int
    first_episode: int
    n_episodes: int
    n_retraced: int
    files: dict[str, Fingerprint]
    metadata: dict[bytes, bytes]


class Gathered:
    """What the parts of a run folder hold.

    ``same_sources`` leaves out parts from other versions of what decides about a test.
    """

    def __init__(self, folder: Path, *, same_sources: bool = False) -> None:
        self._folder = folder
        self._shards: dict[int, GatheredShard] = {}
        sources = source_hash(WORLD_SOURCES) if same_sources else None
        for path in parts(folder):
            with suppress(OSError, pa.ArrowException, KeyError, ValueError, TypeError):  # then it answers for nothing
                self._shards |= _listed(path, sources)

    def find(self, index: int, first_episode: int, n_episodes: int, files: Mapping[str, str]) -> GatheredShard | None:
        """A shard of these episodes whose ``files``, by table, are the same to the last byte; else None."""
        shard = self._shards.get(index)
        if shard is None or (shard.first_episode, shard.n_episodes) != (first_episode, n_episodes):
            return None
        same = all(fingerprint(f"{self._folder}/{file}") == shard.files.get(name) for name, file in files.items())
        return shard if same else None

    def table(self, path: Path) -> pa.Table | None:
        """A whole part; None if it has been damaged, and from then on it answers for nothing."""
        with suppress(OSError, pa.ArrowException), pq.ParquetFile(path, page_checksum_verification=True) as file:
            return file.read()
        self._shards = {index: shard for index, shard in self._shards.items() if shard.path != path}
        return None


def parts(folder: Path) -> list[Path]:
    """Files of gathered shards; of a shard that is in two of them the later one speaks."""
    return sorted((folder / FOLDER).glob("part-*.parquet"))


def _listed(path: Path, sources: str | None) -> dict[int, GatheredShard]:
    metadata = pq.read_schema(path).metadata or {}
    content = json.loads(metadata[_KEY])
    if content["layout"] != _LAYOUT or (sources is not None and content["sources"] != sources):
        return {}
    found, row = {}, 0
    for shard in content["shards"]:
        files = {name: (int(size), int(checksum)) for name, (size, checksum) in shard["files"].items()}
        kept = {key.encode(): value.encode() for key, value in shard["metadata"].items()}
        n = int(shard["n_episodes"])
        found[int(shard["index"])] = GatheredShard(
            path, row, int(shard["first_episode"]), n, int(shard["n_retraced"]), files, kept
        )
        row += n
    return found


def gather(folder: Path, shards: Sequence[Mapping[str, Any]], columns: Sequence[str]) -> None:
    """Write a part of consecutive shards, as the manifest lists them, each with ``n_retraced``.

    Raises
    ------
    HarnessError, OSError
        A shard cannot be read, or nothing can be written.
    """
    tables, listed = [], []
    for shard in shards:
        table = read_table(folder / shard["files"]["episodes"], list(columns))
        tables.append(table.replace_schema_metadata(None))
        files = {name: fingerprint(folder / file) for name, file in shard["files"].items()}
        metadata = {key.decode(): value.decode() for key, value in (table.schema.metadata or {}).items()}
        listed.append({**shard, "files": files, "metadata": metadata})
    content = {"layout": _LAYOUT, "sources": source_hash(WORLD_SOURCES), "shards": listed}
    part = pa.concat_tables(tables).unify_dictionaries().combine_chunks()
    part = part.replace_schema_metadata({_KEY: json.dumps(content)})
    number = max((int(path.stem.removeprefix("part-")) for path in parts(folder)), default=-1) + 1
    path = folder / FOLDER / f"part-{number:06d}.parquet"
    options = {"compression": COMPRESSION, "write_page_checksum": True}
    write_atomically(path, lambda unfinished: pq.write_table(part, unfinished, **options))
