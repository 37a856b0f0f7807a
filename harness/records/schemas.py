"""The tables of a run: Arrow schemas with units and meanings in the field metadata, and tables made from a shard.

Importance functions are in the order of `importance_names`: for the episode mixture the defensive ``forced`` cut-in
first, then the surrogates; for the others the surrogates alone. Values are from `harness.loop.judge.end_test`.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np
import pyarrow as pa

from harness.families.protocol import Chosen, Column, Family
from harness.loop.loop import Shard
from harness.records.folder import Tables
from harness.vocabulary import CRASH, OUTCOMES, FloatArray, Int8Array, IntArray, RecordArray

_F8, _I1, _I2, _I8 = pa.float64(), pa.int8(), pa.int16(), pa.int64()
_NAME, _MOTION = pa.dictionary(_I1, pa.string()), pa.list_(_F8)


def _field(name: str, kind: pa.DataType, unit: str, doc: str, *, nullable: bool = False) -> pa.Field:
    return pa.field(name, kind, nullable=nullable, metadata={"unit": unit, "doc": doc})


def _or_null(name: str, kind: pa.DataType, unit: str, doc: str) -> pa.Field:
    return _field(name, kind, unit, doc, nullable=True)


def _facts(columns: Sequence[Column]) -> list[pa.Field]:
    return [_field(each.name, each.kind, each.unit, each.doc) for each in columns]


def _per(n: int) -> pa.DataType:
    """List of one float64 per importance function or surrogate; Parquet has no fixed-size list of zero."""
    return pa.list_(_F8, n or -1)


def episodes_schema(
    columns: Sequence[Column],
    n_importance: int = 0,
    n_surrogates: int = 0,
    n_cells: int = 0,
    *,
    acts: bool = False,
    shows: bool = False,
) -> pa.Schema:
    """Schema of the ``episodes`` table, with numbers of importance functions, surrogates and cells of shells.

    ``columns`` are the family's facts; ``acts`` adds those of shells of vehicles that act before the event, ``shows``
    those of events that take time.
    """
    shell_columns = [
        _field("cell", _I2, "1", "cell of shells.json: shell, and which references crash (method shells alone)"),
        _field("cell_mass", _per(n_cells), "1", "P of an event of each cell on the same path (method shells alone)"),
    ]
    own_mass = "P of the test's own event, or of those it stands for, in the measure of cell_mass"
    baseline_columns = [
        _or_null("shadow", _I8, "1", "baseline run that the test repeats (method shells, vehicles that act before)"),
        _or_null("event_mass", _F8, "1", own_mass),
    ]
    taking_time = "where cut-ins take time alone"
    lateral_columns = [
        _or_null("lead_steps", _I2, "0.1 s", f"from the onset of lateral motion to overlap ({taking_time})"),
        _or_null("onset_step", _I2, "0.1 s", "step at whose end BV began to move sideways"),
        _or_null("onset_gap_m", _F8, "m", "R2 at the onset"),
        _or_null("onset_rate_mps", _F8, "m/s", "R2dot at the onset"),
        _or_null("onset_ttc_s", _F8, "s", "R2/-R2dot at the onset, null where the AV does not close in"),
        _or_null("overlap_ttc_s", _F8, "s", "the same at the cut-in decision, the last state before overlap"),
        _or_null("contact", pa.string(), "", "of a crash: side, in the first state of overlap, or rear"),
    ]
    return pa.schema(
        [
            _field("episode", _I8, "1", "number of the test in the campaign"),
            _field("seed", _I8, "1", "campaign seed; with the index it determines every random number"),
            *_facts(columns),
            _field("outcome", _NAME, "", "crash, passed, timeout, bv_lv_contact or failed"),
            _field("n_steps", _I2, "0.1 s", "steps simulated until the test ended"),
            _or_null("event_step", _I2, "0.1 s", "step of the event, null without one"),
            _or_null("event_gap_m", _F8, "m", "R2 then, the gap to the vehicle it is about"),
            _or_null("event_rate_mps", _F8, "m/s", "R2dot then, its rate of change"),
            _or_null("took_over_step", _I2, "0.1 s", "first step in which the AV did what its vehicle asked for"),
            _or_null("braked_step", _I2, "0.1 s", "first step after the onset in which it braked with 1 m/s² or more"),
            _field("asked_to_speed_up", pa.bool_(), "", "whether it asked to speed up while it was held at its speed"),
            _field("braked_before", pa.bool_(), "", "whether it asked to brake while nothing happened, in its warm-up"),
            _field(
                "fell_behind", pa.bool_(), "", "whether it was over 5 s behind the vehicle ahead when the event began"
            ),
            _or_null("crash_time_s", _F8, "s", "time of the crash"),
            _or_null("impact_speed_mps", _F8, "m/s", "v_AV - v_BV at the crash"),
            _or_null("min_ttc_s", _F8, "s", "smallest R2/-R2dot after the event while closing"),
            _or_null("end_ttc_s", _F8, "s", "of a timeout: to a collision as it accelerates (a program: at its speed)"),
            _field(
                "hardest_braking_mps2", _F8, "m/s2", "largest deceleration of the AV after the onset, 0 without any"
            ),
            _field("av_distance_m", _F8, "m", "distance that the AV drove in the test"),
            _field("n_control_steps", _I2, "1", "stratum l: steps drawn from an importance function"),
            _field("component", _I1, "1", "importance function drawn (episode mixture), or shell, else -1"),
            _field("log_weight", _F8, "1", "log p(x_c) - log q_sampled(x_c), 0 without control; of shells log p_s"),
            _or_null("log_p_event", _F8, "1", "log P(event | path), where the method draws the path ahead"),
            _field("log_q", _per(n_importance), "1", "per importance function: sum of log(q_j/p)"),
            _field("martingale", _per(n_surrogates), "1", "per surrogate: sum W_t C_j,t - W_(t-1) V_j,t"),
            _or_null("pool_row", _I8, "1", "row of the pool's event (method shells), else null"),
            *(shell_columns if n_cells else ()),
            *(baseline_columns if acts else ()),
            *(lateral_columns if shows else ()),
            _or_null("failure", pa.string(), "", "cause, for failed tests"),
        ]
    )


def moments_schema(columns: Sequence[Column], n_surrogates: int) -> pa.Schema:
    """Schema of the ``moments`` table: one row per control step, with the ``columns`` of its state."""
    return pa.schema(
        [
            _field("episode", _I8, "1", "index of the episode"),
            _field("step", _I2, "0.1 s", "step of the control"),
            *_facts(columns),
            _field("maneuver", _I1, "1", "0..30 acceleration, 31 cut_in, 32 stay"),
            _field("p", _F8, "1", "exposure: probability under the NDE"),
            _field("q_sampled", _F8, "1", "probability it was drawn with, given the shared history"),
            _field("q", _per(n_surrogates), "1", "probability under each surrogate's importance function"),
            _field("v", _per(n_surrogates), "1", "criticality V_j of the state"),
        ]
    )


def traces_schema(*, shows: bool = False) -> pa.Schema:
    """Schema of the ``traces`` table: one row per step and vehicle, with how far BV has come over."""
    over = "how far it has come over to the right lane (where cut-ins take time alone)"
    return pa.schema(
        [
            _field("episode", _I8, "1", "index of the episode"),
            _field("step", _I2, "0.1 s", "step, 0 is the initial state"),
            _field("vehicle", _NAME, "", "LV, BV or AV"),
            _field("lane", _I1, "1", "0 right, 1 left"),
            _field("x_m", _F8, "m", "position of the front bumper along the road"),
            _field("v_mps", _F8, "m/s", "speed"),
            _or_null("a_mps2", _F8, "m/s2", "acceleration in the next step: of the AV what was commanded"),
            *([_field("lateral_m", _F8, "m", over)] if shows else ()),
        ]
    )


def baseline_schema(columns: Sequence[Column]) -> pa.Schema:
    """Schema of the ``shadow`` table: one row per baseline run, with the family's ``columns``."""
    return pa.schema(
        [
            _field("shadow", _I8, "1", "index of the run; tests on its path tell it to the vehicle"),
            _field("path", _I8, "1", "number of the path among those of the pool; may occur more than once"),
            _field("weight", _F8, "1", "naturalistic density of the path over that of the draw"),
            *_facts(columns),
            _field("outcome", _NAME, "", "passed, timeout, bv_lv_contact or failed"),
            _field("n_steps", _I2, "0.1 s", "steps simulated until the run ended"),
            _field("av_position_m", _MOTION, "m", "front bumper of the AV, initially and after each step"),
            _field("av_speed_mps", _MOTION, "m/s", "speed of the AV, initially and after each step"),
            _or_null("failure", pa.string(), "", "cause, for failed runs"),
        ]
    )


def shard_tables(shard: Shard, seed: int, *, keep_traces: bool) -> Tables:
    """Tables of a shard, sorted by episode, step and vehicle."""
    tables = {"episodes": episodes_table(shard, seed)}
    drawn = shard.traffic.drawn
    if drawn is not None and drawn.moment_limit:
        tables["moments"] = moments_table(shard)
    if keep_traces:
        tables["traces"] = traces_table(shard)
    return tables


def _table(schema: pa.Schema, columns: dict[str, Any], records: RecordArray | None = None) -> pa.Table:
    """A table of ``columns``, and of fields of ``records`` else; null for NaN, infinity, a step below 0."""
    arrays = []
    for field in schema:
        values = columns[field.name] if records is None or field.name in columns else records[field.name]
        if isinstance(values, np.ndarray):
            null = (values < 0 if values.dtype.kind == "i" else ~np.isfinite(values)) if field.nullable else None
            values = pa.array(np.ascontiguousarray(values), mask=null)
        arrays.append(values)
    return pa.table(arrays, schema=schema)


def rows(values: np.ndarray) -> pa.Array:
    """List column of the rows of a matrix."""
    n, width = values.shape
    flat = pa.array(np.ascontiguousarray(values).ravel())
    if width:
        return pa.FixedSizeListArray.from_arrays(flat, type=pa.list_(flat.type, width))
    return pa.ListArray.from_arrays(pa.array(np.zeros(n + 1, np.int32)), flat)


def prefixes(values: Int8Array, lengths: IntArray) -> pa.Array:
    """List column of the first ``lengths[i]`` entries of each row."""
    used = np.arange(values.shape[1]) < lengths[:, None]
    offsets = np.concatenate([[0], np.cumsum(lengths)]).astype(np.int32)
    return pa.ListArray.from_arrays(pa.array(offsets), pa.array(values[used]))


def _names(codes: Int8Array, names: tuple[str, ...]) -> pa.Array:
    return pa.DictionaryArray.from_arrays(pa.array(codes.astype(np.int8)), pa.array(names))


def padded(column: pa.ChunkedArray, width: int | None = None) -> tuple[np.ndarray, IntArray]:
    """Lists (n,) as rows filled up by zeros, shape (n, ``width`` or the longest length), and their lengths (n,)."""
    lists = column.combine_chunks()
    lengths, flat = np.asarray(lists.value_lengths()).astype(np.int64), np.asarray(lists.flatten())
    places = np.arange(lengths.max(initial=0) if width is None else width)
    values = np.zeros((len(lists), places.size), flat.dtype)
    values[places < lengths[:, None]] = flat
    return values, lengths


def fact_columns(facts: RecordArray, columns: Sequence[Column]) -> dict[str, Any]:
    """The facts (n,) of a family as columns of a table."""

    def values_of(column: Column) -> Any:
        values = facts[column.name]
        return prefixes(values, facts[column.length]) if column.length else pa.array(np.ascontiguousarray(values))

    return {column.name: values_of(column) for column in columns}


def facts_from(table: pa.Table, columns: Sequence[Column]) -> RecordArray:
    """The facts (n,) in the columns that `fact_columns` has made."""
    fields: dict[str, np.ndarray] = {}
    for column in columns:
        values = table.column(column.name)
        if column.length:
            fields[column.name], fields[column.length] = padded(values)
        else:
            fields[column.name] = np.asarray(values)
    kind = np.dtype([(name, field.dtype, field.shape[1:]) for name, field in fields.items()])
    facts: RecordArray = np.zeros(table.num_rows, kind)
    for name, field in fields.items():
        facts[name] = field
    return facts


LEAD = "lead_steps"
"""A column of tables whose events can be seen before they happen."""


def path_columns(family: Family) -> tuple[str, ...]:
    """Columns of the episodes table that determine the others' motion, with `LEAD` where it is one."""
    return ("episode", "n_steps", "event_step", *(column.name for column in family.columns))


def chosen_from(rows: pa.Table, family: Family) -> Chosen:
    """The events of rows (n,) of the episodes table, which has `path_columns`."""

    def integers(name: str, null: int) -> IntArray:
        return np.asarray(rows.column(name).fill_null(null)).astype(np.int64)

    lead = integers(LEAD, 0) if LEAD in rows.column_names else np.zeros(rows.num_rows, np.int64)
    return Chosen(facts_from(rows, family.columns), integers("event_step", -1), lead)


def _shared_columns(shard: Shard) -> dict[str, Any]:
    """Columns that tests and baseline runs have in common."""
    e = shard.episode
    return fact_columns(shard.traffic.facts, shard.scenario.columns) | {
        "outcome": _names(e["outcome"], OUTCOMES),
        "failure": pa.array([shard.failures.get(row) for row in range(e.size)], pa.string()),
    }


def episodes_table(shard: Shard, seed: int) -> pa.Table:
    """One row per episode, in index order."""
    e, prescribed, drawn = shard.episode, shard.events, shard.traffic.drawn
    n = e.size
    log_q, martingale = (np.zeros((n, 0)),) * 2 if drawn is None else (drawn.log_q, drawn.martingale)
    columns = _shared_columns(shard) | {
        "episode": shard.first_episode + np.arange(n),
        "seed": np.full(n, seed, np.int64),
        "log_q": rows(log_q),
        "martingale": rows(martingale),
        **{name: e[name] > 0 for name in ("asked_to_speed_up", "braked_before", "fell_behind")},
        "pool_row": pa.nulls(n, pa.int64()) if prescribed is None else prescribed.row,
    }
    if prescribed is not None:
        columns |= {"cell": prescribed.cell.astype(np.int16), "cell_mass": rows(prescribed.cell_mass)}
        columns |= {"shadow": prescribed.shadow, "event_mass": prescribed.mass}
    if shard.scenario.shows:
        side = np.where(e["n_steps"] == e["event_step"] + 1, "side", "rear")
        columns |= {
            LEAD: pa.array(e["lead_steps"], mask=e["onset_step"] < 0),
            "onset_ttc_s": _time_to_collision(e["onset_gap_m"], e["onset_rate_mps"]),
            "overlap_ttc_s": _time_to_collision(e["event_gap_m"], e["event_rate_mps"]),
            "contact": pa.array(side, pa.string(), mask=e["outcome"] != CRASH),
        }
    n_cells = 0 if prescribed is None else prescribed.cell_mass.shape[1]
    acts, scenario = prescribed is not None and prescribed.shadow.size > 0, shard.scenario
    schema = episodes_schema(
        scenario.columns, log_q.shape[1], martingale.shape[1], n_cells, acts=acts, shows=scenario.shows
    )
    return _table(schema, columns, e)


def _time_to_collision(r2_m: FloatArray, r2dot_mps: FloatArray) -> FloatArray:
    """Time (s) to collision (n,), NaN where the AV does not close in, or has passed."""
    closing = (r2dot_mps < 0.0) & (r2_m >= 0.0)
    return np.asarray(np.divide(r2_m, -r2dot_mps, out=np.full(r2_m.shape, np.nan), where=closing))


def moments_table(shard: Shard) -> pa.Table:
    """One row per control step, by episode and step, of tests that were drawn in the loop."""
    drawn = shard.traffic.drawn
    used = int(drawn.moment_count[0])
    m = drawn.moment[:used]
    order = np.lexsort((m["step"], m["row"]))
    m, q, v = m[order], drawn.moment_q[:used][order], drawn.moment_v[:used][order]
    columns = {"episode": shard.first_episode + m["row"], "q": rows(q), "v": rows(v)}
    state_columns = [column for column in shard.scenario.columns if column.name in (m.dtype.names or ())]
    return _table(moments_schema(state_columns, q.shape[1]), columns, m)


def traces_table(shard: Shard) -> pa.Table:
    """One row per step and vehicle of the traced episodes."""
    scenario, rows = shard.scenario, sorted(shard.traces)
    schema, n_vehicles = traces_schema(shows=scenario.shows), len(scenario.vehicles)
    if not rows:
        return schema.empty_table()
    n_states = [shard.traces[row].shape[0] for row in rows]
    row = np.repeat(rows, n_vehicles * np.array(n_states))
    step = np.repeat(np.concatenate([np.arange(n, dtype=np.int16) for n in n_states]), n_vehicles)
    vehicle = np.tile(np.arange(n_vehicles, dtype=np.int8), sum(n_states))
    x, v, a, lane = np.concatenate([shard.traces[traced].reshape(-1, 4) for traced in rows]).T
    over = _came_over(shard.episode[row], step, scenario.sideways_m)
    columns = {
        "episode": shard.first_episode + row, "step": step, "vehicle": _names(vehicle, scenario.vehicles),
        "lane": lane.astype(np.int8), "x_m": x, "v_mps": v,
        "a_mps2": np.where(vehicle == n_vehicles - 1, a, np.round(a, 9)),  # the others' follows from their speeds
        "lateral_m": np.where(vehicle == scenario.principal, over, 0.0),
    }  # fmt: skip
    return _table(schema, columns)


def _came_over(episode: RecordArray, state: np.ndarray, distance_m: float) -> FloatArray:
    """How far (m) BV has come over in states (n,), each of its ``episode`` (n,)."""
    lead, onset, cut = (episode[name].astype(np.int64) for name in ("lead_steps", "onset_step", "event_step"))
    begins = np.where(cut >= 0, cut - lead, onset)  # it may have begun before the test
    share = np.where(lead == 0, state > onset, np.clip((state - begins - 1) / np.maximum(lead, 1), 0.0, 1.0))
    return np.where(onset < 0, 0.0, distance_m * share)


def baseline_table(shard: Shard, path: IntArray, weight: FloatArray) -> pa.Table:
    """One row per baseline run of a shard that has kept all motion; ``path``, ``weight`` (n,) as in the schema."""
    e = shard.episode
    traces = [shard.traces[row] for row in range(e.size)]
    columns = _shared_columns(shard) | {
        "shadow": shard.first_episode + np.arange(e.size),
        "path": path,
        "weight": weight,
        "av_position_m": pa.array([trace[:, -1, 0] for trace in traces], _MOTION),
        "av_speed_mps": pa.array([trace[:, -1, 1] for trace in traces], _MOTION),
    }
    return _table(baseline_schema(shard.scenario.columns), columns, e)
