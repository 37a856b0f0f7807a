"""From a shard's buffers to Arrow tables with the committed schemas."""

from __future__ import annotations

from typing import Any, NamedTuple

import numpy as np
import pyarrow as pa

from harness.episode.loop import Shard
from harness.records.schemas import episodes_schema, moments_schema, shadow_schema, traces_schema
from harness.vocabulary import (
    AV,
    BV,
    CRASH,
    OUTCOMES,
    STATE_COLUMNS,
    VEHICLES,
    FloatArray,
    Int8Array,
    IntArray,
    RecordArray,
)


class ShardTables(NamedTuple):
    """The tables of a shard; ``moments`` and ``traces`` are None when the campaign keeps none."""

    episodes: pa.Table
    moments: pa.Table | None
    traces: pa.Table | None


def shard_tables(shard: Shard, seed: int, *, keep_traces: bool) -> ShardTables:
    """Tables of a shard, sorted by episode, step and vehicle."""
    return ShardTables(
        episodes_table(shard, seed),
        moments_table(shard) if shard.results.moment_limit else None,
        traces_table(shard) if keep_traces else None,
    )


def _table(schema: pa.Schema, columns: dict[str, Any], records: RecordArray | None = None) -> pa.Table:
    """A table of ``columns``, and of fields of ``records`` where there is no column of the name.

    Null stands for «there is none»: for NaN and infinity where a number may be null, and for a step below zero.
    """
    arrays = []
    for field in schema:
        values = columns[field.name] if records is None or field.name in columns else records[field.name]
        if isinstance(values, np.ndarray):
            none = (values < 0 if values.dtype.kind == "i" else ~np.isfinite(values)) if field.nullable else None
            values = pa.array(np.ascontiguousarray(values), mask=none)
        arrays.append(values)
    return pa.table(arrays, schema=schema)


def rows(values: np.ndarray) -> pa.Array:
    """List column of the rows of a matrix."""
    n, width = values.shape
    flat = pa.array(np.ascontiguousarray(values).ravel())
    if width:
        return pa.FixedSizeListArray.from_arrays(flat, width)
    return pa.ListArray.from_arrays(pa.array(np.zeros(n + 1, np.int32)), flat)


def prefixes(values: Int8Array, lengths: IntArray) -> pa.Array:
    """List column of the first ``lengths[i]`` entries of each row."""
    used = np.arange(values.shape[1]) < lengths[:, None]
    offsets = np.concatenate([[0], np.cumsum(lengths)]).astype(np.int32)
    return pa.ListArray.from_arrays(pa.array(offsets), pa.array(values[used]))


def _names(codes: Int8Array, names: tuple[str, ...]) -> pa.Array:
    return pa.DictionaryArray.from_arrays(pa.array(codes.astype(np.int8)), pa.array(names))


def _driven(shard: Shard) -> dict[str, Any]:
    """Columns that tests and shadow runs have in common."""
    results = shard.results
    e = results.episode
    return {
        **{name: shard.states[name] for name in STATE_COLUMNS},
        "outcome": _names(e["outcome"], OUTCOMES),
        "lv_maneuvers": prefixes(results.lv_path, e["n_lv"].astype(np.int64)),
        "bv_maneuvers": prefixes(results.bv_path, e["n_bv"].astype(np.int64)),
        "failure": pa.array([shard.failures.get(row) for row in range(e.size)], pa.string()),
    }


def episodes_table(shard: Shard, seed: int) -> pa.Table:
    """One row per episode, in index order."""
    e, n, prescribed = shard.results.episode, shard.results.episode.size, shard.cut_ins
    columns = _driven(shard) | {
        "episode": shard.first_episode + np.arange(n),
        "seed": np.full(n, seed, np.int64),
        "log_q": rows(shard.results.log_q),
        "martingale": rows(shard.results.martingale),
        "pool_cut_in": pa.nulls(n, pa.int64()) if prescribed is None else prescribed.row,
    }
    if prescribed is not None:
        columns |= {"cell": prescribed.cell.astype(np.int16), "cell_mass": rows(prescribed.cell_mass)}
    if shard.lateral.present:
        columns |= _lateral_columns(e)
    of_all = shard.results.log_q.shape[1], shard.results.martingale.shape[1]
    n_cells = 0 if prescribed is None else prescribed.cell_mass.shape[1]
    return _table(episodes_schema(*of_all, n_cells, takes_time=shard.lateral.present), columns, e)


def _lateral_columns(e: RecordArray) -> dict[str, Any]:
    """What BV's lateral motion was like; `onset_step` and the like are in ``e`` itself."""
    side = np.where(e["n_steps"] == e["cut_in_step"] + 1, "side", "rear")
    return {
        "lead_steps": pa.array(e["lead_steps"], mask=e["onset_step"] < 0),
        "onset_ttc_s": _time_to_collision(e["onset_r2_m"], e["onset_r2dot_mps"]),
        "overlap_ttc_s": _time_to_collision(e["cut_in_r2_m"], e["cut_in_r2dot_mps"]),
        "contact": pa.array(side, pa.string(), mask=e["outcome"] != CRASH),
    }


def _time_to_collision(r2_m: FloatArray, r2dot_mps: FloatArray) -> FloatArray:
    """NaN where nobody closes in, or has passed."""
    closing = (r2dot_mps < 0.0) & (r2_m >= 0.0)
    found: FloatArray = np.divide(r2_m, -r2dot_mps, out=np.full(r2_m.shape, np.nan), where=closing)
    return found


def moments_table(shard: Shard) -> pa.Table:
    """One row per control step, by episode and step."""
    used = int(shard.results.moment_count[0])
    m = shard.results.moment[:used]
    order = np.lexsort((m["step"], m["row"]))
    m, q, v = m[order], shard.results.moment_q[:used][order], shard.results.moment_v[:used][order]
    columns = {"episode": shard.first_episode + m["row"], "q": rows(q), "v": rows(v)}
    return _table(moments_schema(q.shape[1]), columns, m)


def traces_table(shard: Shard) -> pa.Table:
    """One row per step and vehicle of the traced episodes."""
    schema = traces_schema(takes_time=shard.lateral.present)
    if not shard.traces:
        return schema.empty_table()
    parts = [_trace_columns(shard, row) for row in sorted(shard.traces)]
    joined = {name: np.concatenate([part[name] for part in parts]) for name in schema.names}
    return _table(schema, joined | {"vehicle": _names(joined["vehicle"], VEHICLES)})


def _trace_columns(shard: Shard, row: int) -> dict[str, np.ndarray]:
    trace = shard.traces[row]
    steps = trace.shape[0]
    step = np.repeat(np.arange(steps, dtype=np.int16), len(VEHICLES))
    vehicle = np.tile(np.arange(len(VEHICLES), dtype=np.int8), steps)
    cut = int(shard.results.episode["cut_in_step"][row])
    on_right = (vehicle == VEHICLES.index("AV")) | ((vehicle == VEHICLES.index("BV")) & (cut >= 0) & (step > cut))
    flat = trace.reshape(-1, 3)
    return {
        "episode": np.full(step.size, shard.first_episode + row, np.int64),
        "step": step,
        "vehicle": vehicle,
        "lane": np.where(on_right, 0, 1).astype(np.int8),
        "x_m": flat[:, 0],
        "v_mps": flat[:, 1],
        "a_mps2": flat[:, 2],
        "lateral_m": np.where(vehicle == BV, _came_over(shard, row, step), 0.0),
    }


def _came_over(shard: Shard, row: int, state: np.ndarray) -> FloatArray:
    """How far (m) BV has come over in states (n,) of an episode."""
    episode, distance_m = shard.results.episode[row], shard.lateral.distance_m
    lead, onset, cut = (int(episode[name]) for name in ("lead_steps", "onset_step", "cut_in_step"))
    if onset < 0:
        return np.zeros(state.shape)
    if lead == 0:
        return np.where(state > onset, distance_m, 0.0)
    begins = cut - lead if cut >= 0 else onset  # it may have begun before the test
    return distance_m * np.clip((state - begins - 1) / lead, 0.0, 1.0)


def shadow_table(shard: Shard, path: IntArray, weight: FloatArray) -> pa.Table:
    """One row per shadow run of a shard that has kept all motion; ``path``, ``weight`` (n,) as in the schema."""
    e, traces = shard.results.episode, [shard.traces[row] for row in range(shard.results.episode.size)]
    columns = _driven(shard) | {
        "shadow": shard.first_episode + np.arange(e.size),
        "path": path,
        "weight": weight,
        "av_position_m": pa.array([trace[:, AV, 0] for trace in traces], pa.list_(pa.float64())),
        "av_speed_mps": pa.array([trace[:, AV, 1] for trace in traces], pa.list_(pa.float64())),
    }
    return _table(shadow_schema(), columns, e)
