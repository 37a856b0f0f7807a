"""Pools on disk: one Parquet file of cut-ins, with all that is known of shells and surrogates in its metadata."""

from __future__ import annotations

import hashlib
import json
from dataclasses import fields, replace
from pathlib import Path
from typing import Any

import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq

from harness.compiled import WORLD_SOURCES, cache_root, source_hash
from harness.errors import RunFolderError
from harness.pool.build import build_pool
from harness.pool.cut_ins import CutIns, Pool, environment_hash
from harness.pool.library import Library
from harness.progress import Progress
from harness.records.folder import require_place, write_atomically
from harness.records.schemas import prefixes, rows
from harness.resolved import Resolved
from harness.vocabulary import STATE_COLUMNS, IntArray, states_from

_FORMAT = 6
"""Raise it when the meaning of a pool changes."""
_MADE_BY = ("build.py", "cut_ins.py")
"""Code that decides what is in a pool, beside the kernels."""
_METADATA, _DIGEST = b"harness_pool", b"harness_pool_sha256"


def campaign_pool_key(resolved: Resolved) -> str:
    """Hash of all that a pool depends on: environment, level of lane changing, library, settings, and code."""
    library = resolved.library
    content = [
        _FORMAT,
        source_hash(WORLD_SOURCES),
        *(hashlib.sha256((Path(__file__).parent / name).read_bytes()).hexdigest() for name in _MADE_BY),
        environment_hash(resolved.environment),
        {name: model.model_dump() for name, model in library.surrogates.items()},
        [(name, model.model_dump()) for name, model in library.references.items()],
        [sorted(library.boundaries), library.boundary, library.envelope],
        resolved.campaign.pool.model_dump(exclude={"library", "shadow_paths"}),
    ]
    return hashlib.sha256(json.dumps(content, sort_keys=True).encode()).hexdigest()[:24]


def pool_path(key: str) -> Path:
    """Where a pool is cached."""
    return cache_root() / "pools" / f"{key}.parquet"


def campaign_pool(resolved: Resolved, progress: Progress | None = None) -> Pool:
    """The pool of a campaign's environment and library, from the cache or built and cached.

    Raises `RunFolderError`: the pool could not be kept.
    """
    key = campaign_pool_key(resolved)
    if (cached := cached_pool(resolved)) is not None:
        return cached
    require_place(pool_path(key).parent, mend="Change its permissions, or name another place in HARNESS_CACHE_DIR.")
    pool = build_pool(resolved.environment, resolved.library, resolved.campaign.pool, key, progress)
    write_pool(pool_path(key), pool)
    return pool


def cached_pool(resolved: Resolved) -> Pool | None:
    """The pool of a campaign; None if none has been built on this machine, or its file is damaged or another's."""
    key = campaign_pool_key(resolved)
    try:
        pool = read_pool(pool_path(key)) if pool_path(key).is_file() else None
    except RunFolderError:
        return None
    # The key does not hold the words of statements: they are those of today.
    return replace(pool, library=resolved.library) if pool is not None and pool.key == key else None


def write_pool(path: Path, pool: Pool) -> None:
    """Write a pool atomically."""
    table = _table(pool)
    write_atomically(path, lambda temporary: pq.write_table(table, temporary, compression="zstd"))


def read_pool(path: Path) -> Pool:
    """Read a pool.

    Raises `RunFolderError`: the file is missing, damaged, or not a pool.
    """
    try:
        with pq.ParquetFile(path) as file:  # read_table would import, for 0.3 s, what reads folders
            table = file.read()
        return _pool(table, sound_facts(table))
    except (OSError, pa.ArrowException, KeyError, TypeError, ValueError) as error:
        found = f"a file that is not a whole pool ({str(error).splitlines()[0] if str(error) else error!r})"
        mend = "Delete it: it is built again when it is needed."
        raise RunFolderError(str(path), found, "a pool that `harness pool` has written", mend) from error


def stamped(table: pa.Table, facts: dict[str, Any]) -> pa.Table:
    """The table with facts, and a hash of both: Parquet notices a truncated file, but hardly any flipped bit."""
    known = json.dumps({"format": _FORMAT, **facts}).encode()
    return table.replace_schema_metadata({_METADATA: known, _DIGEST: _digest(table, known)})


def sound_facts(table: pa.Table) -> dict[str, Any]:
    """The facts of a `stamped` table.

    Raises `KeyError`, `TypeError` or `ValueError`: it is none of this version, or its content has changed.
    """
    metadata = table.schema.metadata or {}
    facts: dict[str, Any] = json.loads(metadata[_METADATA])
    if facts["format"] != _FORMAT:
        raise ValueError(f"a pool of format {facts['format']}, this version reads {_FORMAT}")
    if metadata[_DIGEST].decode() != _digest(table, metadata[_METADATA]):
        raise ValueError("its content has changed since it was written")
    return facts


def _digest(table: pa.Table, facts: bytes) -> str:
    digest = hashlib.sha256(facts)
    for column in table.columns:
        array = column.combine_chunks()
        if isinstance(array, pa.ListArray):
            digest.update(np.asarray(array.value_lengths()).tobytes())
        values = array.flatten() if isinstance(array, pa.ListArray | pa.FixedSizeListArray) else array
        digest.update(values.to_numpy(zero_copy_only=False).tobytes())
    return digest.hexdigest()


def _table(pool: Pool) -> pa.Table:
    c = pool.cut_ins
    probability = pool.shell_p / np.maximum(np.bincount(pool.shell, minlength=pool.shell_p.size), 1)
    columns: dict[str, tuple[pa.Array, str]] = {
        "path": (pa.array(c.path), "index of the path in the pool"),
        **{name: (pa.array(np.ascontiguousarray(c.state[name])), "initial state") for name in STATE_COLUMNS},
        "cut_in_step": (pa.array(c.step.astype(np.int16)), "step (0.1 s) in which BV cuts in"),
        "probability": (pa.array(probability[pool.shell]), "P under the NDE that it stands for"),
        "shell": (pa.array(pool.shell.astype(np.int8)), "first surrogate that crashes; the last shell: none does"),
        "cell": (pa.array(c.cell.astype(np.int16)), "shell and references that crash, as the metadata lists cells"),
        "crashes": (
            rows(c.crashes),
            "which surrogates crash, in the order of the metadata's names, and which references",
        ),
        "path_mass": (
            rows(c.path_mass),
            "P of a cut-in of each cell on the same path, times naturalistic over proposal density of the path",
        ),
        "lv_maneuvers": (prefixes(c.lv, c.n_lv), "LV's draws, one per hold period"),
        "bv_maneuvers": (prefixes(c.bv, c.n_bv), "BV's draws; 31 marks the cut-in"),
        "lead_steps": (pa.array(c.lead.astype(np.int16)), "steps from the onset of lateral motion to overlap"),
    }
    schema = pa.schema(
        [pa.field(name, array.type, nullable=False, metadata={"doc": doc}) for name, (array, doc) in columns.items()]
    )
    known = {each.name: getattr(pool, each.name) for each in fields(pool) if each.name not in ("library", "cut_ins")}
    plain = {name: value.tolist() if isinstance(value, np.ndarray) else value for name, value in known.items()}
    table = pa.table([array for array, _ in columns.values()], schema=schema)
    return stamped(table, {"library": pool.library.model_dump(), **plain})


def padded(column: pa.ChunkedArray, width: int) -> tuple[np.ndarray, IntArray]:
    """Lists (n,) as rows of zeros beyond their lengths, shape (n, width), and their lengths (n,)."""
    lists = column.combine_chunks()
    lengths, flat = np.asarray(lists.value_lengths()).astype(np.int64), np.asarray(lists.flatten())
    values = np.zeros((len(lists), width), flat.dtype)
    values[np.arange(width) < lengths[:, None]] = flat
    return values, lengths


def _pool(table: pa.Table, facts: dict[str, Any]) -> Pool:
    def whole(name: str) -> IntArray:
        return np.asarray(table.column(name)).astype(np.int64)

    def matrix(name: str) -> np.ndarray:
        values = table.column(name).combine_chunks().flatten().to_numpy(zero_copy_only=False)
        return np.asarray(values).reshape(table.num_rows, -1)

    width = int(np.asarray(table.column("bv_maneuvers").combine_chunks().value_lengths()).max(initial=0))
    (lv, n_lv), (bv, n_bv) = (padded(table.column(name), width) for name in ("lv_maneuvers", "bv_maneuvers"))
    cut_ins = CutIns(
        path=whole("path"),
        step=whole("cut_in_step"),
        cell=whole("cell"),
        state=states_from(np.asarray(table.column(name)) for name in STATE_COLUMNS),
        lv=lv,
        bv=bv,
        n_lv=n_lv,
        n_bv=n_bv,
        crashes=matrix("crashes"),
        path_mass=matrix("path_mass"),
        lead=whole("lead_steps"),
    )
    known: dict[str, Any] = {
        name: np.array(value) if isinstance(value, list) else value for name, value in facts.items()
    }
    known |= {"library": Library.model_validate(facts["library"]), "names": tuple(facts["names"]), "cut_ins": cut_ins}
    return Pool(**{field.name: known[field.name] for field in fields(Pool)})
