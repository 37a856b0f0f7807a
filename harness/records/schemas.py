"""Columns of the tables that a run leaves: Arrow schemas with units and meanings in the field metadata.

``episodes``: one row per episode, failed ones included. ``moments``: one row per control step. ``traces``: one row
per step and vehicle. ``shadow``: one row per path that a vehicle which acts before the cut-in was driven along without
one. Importance functions are in the order of `importance_names`: for the episode mixture the
defensive ``forced`` cut-in first, then the surrogates; for the others the surrogates alone. Values are from
`harness.episode.judge.end_episode`, and in the tables of a shard by `harness.records.tables`.
"""

from __future__ import annotations

import pyarrow as pa

from harness.vocabulary import STATE_COLUMNS

_F8, _I1, _I2, _I8 = pa.float64(), pa.int8(), pa.int16(), pa.int64()
_NAME = pa.dictionary(_I1, pa.string())


def _field(name: str, kind: pa.DataType, unit: str, doc: str, *, nullable: bool = False) -> pa.Field:
    return pa.field(name, kind, nullable=nullable, metadata={"unit": unit, "doc": doc})


def _or_null(name: str, kind: pa.DataType, unit: str, doc: str) -> pa.Field:
    return _field(name, kind, unit, doc, nullable=True)


def _state_fields(which: str = "") -> list[pa.Field]:
    docs = (
        "speed of BV",
        "gap LV-BV, bumper to bumper",
        "rate of R1: v_LV - v_BV",
        "gap BV-AV, bumper to bumper",
        "rate of R2: v_BV - v_AV",
    )
    return [
        _field(name, _F8, "m/s" if name.endswith("_mps") else "m", which + doc)
        for name, doc in zip(STATE_COLUMNS, docs, strict=True)
    ]


def _per(n: int) -> pa.DataType:
    """List of one float64 per importance function or surrogate; Parquet has no fixed-size list of zero."""
    return pa.list_(_F8, n) if n else pa.list_(_F8)


def episodes_schema(n_importance: int, n_surrogates: int, n_cells: int = 0, *, takes_time: bool = False) -> pa.Schema:
    """Schema of the ``episodes`` table for given numbers of importance functions, surrogates, and cells of shells.

    Cut-ins that take time have columns of their own.
    """
    of_shells = [
        _field("cell", _I2, "1", "cell of shells.json: shell, and which references crash (method shells alone)"),
        _or_null(
            "ahead_step",
            _I2,
            "0.1 s",
            "step after which the AV was first ahead of the boundary that is checked, null: never, or not asked",
        ),
        _field("cell_mass", _per(n_cells), "1", "P of a cut-in of each cell on the same path (method shells alone)"),
    ]
    return pa.schema(
        [
            _field("episode", _I8, "1", "index of the episode in the campaign"),
            _field("seed", _I8, "1", "campaign seed; with the index it determines every random number"),
            *_state_fields("initial "),
            _field("outcome", _NAME, "", "crash, passed, timeout, bv_lv_contact or failed"),
            _field("n_steps", _I2, "0.1 s", "steps simulated until the episode ended"),
            _or_null("cut_in_step", _I2, "0.1 s", "step in which BV cut in, null without one"),
            _or_null("cut_in_r2_m", _F8, "m", "R2 at the cut-in decision"),
            _or_null("cut_in_r2dot_mps", _F8, "m/s", "R2dot at the cut-in decision"),
            _or_null("crash_time_s", _F8, "s", "time of the crash"),
            _or_null("impact_speed_mps", _F8, "m/s", "v_AV - v_BV at the crash"),
            _or_null("min_ttc_s", _F8, "s", "smallest R2/-R2dot after the cut-in while closing"),
            _field("av_distance_m", _F8, "m", "distance that the AV drove in the episode"),
            _field("n_control_steps", _I2, "1", "stratum l: steps drawn from an importance function"),
            _field("component", _I1, "1", "importance function drawn (episode mixture), or shell, else -1"),
            _field("log_weight", _F8, "1", "log p(x_c) - log q_sampled(x_c), 0 without control; of shells log p_s"),
            _or_null("log_p_cut_in", _F8, "1", "log P(cut-in | path), where the method draws the path ahead"),
            _field("log_q", _per(n_importance), "1", "per importance function: sum of log(q_j/p)"),
            _field("martingale", _per(n_surrogates), "1", "per surrogate: sum W_(t-1) V_j (q_j,t/q_alpha,t - 1)"),
            _field("lv_maneuvers", pa.list_(_I1), "1", "LV's draws, in order"),
            _field("bv_maneuvers", pa.list_(_I1), "1", "BV's draws, in order; 31 marks the cut-in"),
            _or_null("pool_cut_in", _I8, "1", "row of the pool's cut-in (method shells), else null"),
            *(of_shells if n_cells else ()),
            *(_lateral_fields() if takes_time else ()),
            _or_null("failure", pa.string(), "", "cause, for failed episodes"),
        ]
    )


def _lateral_fields() -> list[pa.Field]:
    about = "where cut-ins take time alone"
    return [
        _or_null("lead_steps", _I2, "0.1 s", f"from the onset of lateral motion to overlap ({about})"),
        _or_null("onset_step", _I2, "0.1 s", "step at whose end BV began to move sideways"),
        _or_null("onset_r2_m", _F8, "m", "R2 at the onset"),
        _or_null("onset_r2dot_mps", _F8, "m/s", "R2dot at the onset"),
        _or_null("onset_ttc_s", _F8, "s", "R2/-R2dot at the onset, null where the AV does not close in"),
        _or_null("overlap_ttc_s", _F8, "s", "the same at the cut-in decision, the last state before overlap"),
        _or_null("contact", pa.string(), "", "of a crash: side, in the first state of overlap, or rear"),
    ]


def moments_schema(n_surrogates: int) -> pa.Schema:
    """Schema of the ``moments`` table: one row per control step."""
    return pa.schema(
        [
            _field("episode", _I8, "1", "index of the episode"),
            _field("step", _I2, "0.1 s", "step of the control"),
            *_state_fields(),
            _field("maneuver", _I1, "1", "0..30 acceleration, 31 cut_in, 32 stay"),
            _field("p", _F8, "1", "exposure: probability under the NDE"),
            _field("q_sampled", _F8, "1", "probability it was drawn with, given the shared history"),
            _field("q", _per(n_surrogates), "1", "probability under each surrogate's importance function"),
            _field("v", _per(n_surrogates), "1", "criticality V_j of the state"),
        ]
    )


def traces_schema(*, takes_time: bool = False) -> pa.Schema:
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
            _or_null("a_mps2", _F8, "m/s2", "acceleration commanded for the next step"),
            *([_field("lateral_m", _F8, "m", over)] if takes_time else ()),
        ]
    )


def shadow_schema() -> pa.Schema:
    """Schema of the ``shadow`` table: one row per shadow run."""
    return pa.schema(
        [
            _field("shadow", _I8, "1", "index of the run; tests on its path tell it to the vehicle"),
            _field("path", _I8, "1", "number of the path among those of the pool; may occur more than once"),
            _field("weight", _F8, "1", "naturalistic density of the path over that of the draw"),
            *_state_fields("initial "),
            _field("outcome", _NAME, "", "passed, timeout, bv_lv_contact or failed"),
            _field("n_steps", _I2, "0.1 s", "steps simulated until the run ended"),
            _field("lv_maneuvers", pa.list_(_I1), "1", "LV's draws, in order"),
            _field("bv_maneuvers", pa.list_(_I1), "1", "BV's draws, in order"),
            _field("av_position_m", pa.list_(_F8), "m", "front bumper of the AV, initially and after each step"),
            _field("av_speed_mps", pa.list_(_F8), "m/s", "speed of the AV, initially and after each step"),
            _or_null("failure", pa.string(), "", "cause, for failed runs"),
        ]
    )
