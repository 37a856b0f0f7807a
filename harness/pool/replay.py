"""Stored episodes once more, without SUMO: the twin retraces what SUMO has driven, and must arrive at the same bits.

Initial state and maneuvers determine LV's and BV's motion to the last bit, and the AV keeps its speed until the cut-in.
So R2 and R2dot at the cut-in, and every end without one, follow from what is on record; for a built-in AV the crash
too, with its time and impact speed. It takes a few microseconds per episode, where SUMO takes hundreds.
"""

from __future__ import annotations

import math
from typing import Any, NamedTuple

import numpy as np
import pyarrow as pa
import pyarrow.compute as pc

from harness.compiled import compiled_inline, compiled_threads, unboxed
from harness.episode.path import (
    NO_CRASH,
    WAS_AHEAD,
    Trajectory,
    empty_trajectory,
    end_in,
    follow,
    leave,
    state_of,
    take_over,
    walk,
)
from harness.errors import WorldDisagreementError
from harness.pool.cut_ins import padded
from harness.pool.walk import Script
from harness.resolved import Resolved
from harness.traffic.lateral import onset_of
from harness.traffic.laws import Environment
from harness.vehicles.kinematics import STEP_S
from harness.vehicles.references import reaction_steps
from harness.vocabulary import (
    AV,
    CRASH,
    CUT_IN,
    FAILED,
    OUTCOMES,
    PASSED,
    RUNNING,
    STATE_COLUMNS,
    TIMEOUT,
    BoolArray,
    FloatArray,
    IntArray,
    Record,
    RecordArray,
    states_from,
)

PATH_COLUMNS = ("episode", *STATE_COLUMNS, "n_steps", "cut_in_step", "lv_maneuvers", "bv_maneuvers")
"""What of the episodes table determines LV's and BV's motion."""
LEAD = "lead_steps"
"""And since when BV shows what it will do, where cut-ins take time."""


class StoredPaths(NamedTuple):
    """Stored episodes of a campaign with seed ``seed``, ``episode`` (n,) being their indices.

    ``state`` (n,) are initial states; ``n_steps``, ``cut_step`` (n,) steps simulated and that of the cut-in, -1
    without one; ``script`` is what LV and BV did in them.
    """

    seed: int
    episode: IntArray
    state: RecordArray
    n_steps: IntArray
    cut_step: IntArray
    script: Script


def stored_paths(episodes: pa.Table, seed: int) -> StoredPaths:
    """Initial states and maneuvers of rows of the episodes table; needs `PATH_COLUMNS`."""
    n = int(episodes.num_rows)
    lead = _whole(episodes, LEAD, 0) if LEAD in episodes.column_names else np.zeros(n, np.int64)
    (lv, n_lv), (bv, n_bv) = (padded(episodes.column(name)) for name in ("lv_maneuvers", "bv_maneuvers"))
    return StoredPaths(
        seed,
        np.asarray(episodes.column("episode")).astype(np.int64),
        states_from(np.asarray(episodes.column(name)) for name in STATE_COLUMNS),
        _whole(episodes, "n_steps", 0),
        _whole(episodes, "cut_in_step", -1),
        Script(lv, bv, n_lv, n_bv, lead),
    )


def _whole(episodes: pa.Table, name: str, null: int) -> IntArray:
    return np.asarray(episodes.column(name).fill_null(null)).astype(np.int64)


RETRACED_DTYPE = np.dtype(
    [(name, np.int64) for name in ("outcome", "n_steps")]
    + [(name, np.float64) for name in ("onset_r2", "onset_r2dot", "impact")]
)
"""What the twin says of a stored episode: how it ends, `RUNNING` where only the AV knows, and when; R2 (m), R2dot (m/s)
at the cut-in, or at its onset where that comes before, NaN without one; v_AV - v_BV (m/s) at a crash, else NaN."""


@compiled_inline
def recall(i: int, stored: StoredPaths, path: Trajectory) -> int:
    """Put the stored maneuvers into the path; returns how many there are of both LV and BV."""
    script = stored.script
    known = min(script.n_lv[i], script.n_bv[i], path.lv.size)
    for m in range(known):
        path.lv[m], path.bv[m] = script.lv[i, m], script.bv[i, m]
    return int(known)


@compiled_inline
def approach(i: int, until: int, stored: StoredPaths, environment: Environment, path: Trajectory) -> tuple[int, int]:
    """LV's and BV's stored motion to a step or a decision without cut-in; how it is decided, and the step.

    `FAILED` where fewer maneuvers are stored than that takes.
    """
    known = recall(i, stored, path)
    reach = min(until, known * environment.numbers.hold_steps, environment.numbers.max_steps)
    step = walk(stored.state[i], stored.seed, stored.episode[i], known, reach, True, environment, path)
    decided = end_in(step, path)
    return FAILED if decided == RUNNING and step < until else decided, step


@compiled_inline
def approach_cut_in(i: int, stored: StoredPaths, environment: Environment, path: Trajectory) -> tuple[int, int]:
    """`approach` through the step of the stored cut-in: BV may touch LV before it has left the lane."""
    cut = stored.cut_step[i]
    decided, step = approach(i, cut + 1, stored, environment, path)
    if decided == PASSED and step == cut + 1:  # beside the AV on its own lane: that is for the AV to answer
        return RUNNING, step
    return decided, step


@compiled_inline
def leave_stored(i: int, until: int, stored: StoredPaths, environment: Environment, path: Trajectory) -> bool:
    """BV's motion from its cut-in to a step: as stored, then under p; False if no cut-in is stored where it was.

    The path up to the cut-in must have been walked.
    """
    cut, bv = stored.cut_step[i], stored.script.bv[i]
    mark = cut // environment.numbers.hold_steps + 1
    known = stored.script.n_bv[i] - mark - 1
    if known < 0 or bv[mark] != CUT_IN:
        return False
    for m in range(min(known, path.free.size)):
        path.free[m] = bv[mark + 1 + m]
    leave(cut, until, stored.seed, stored.episode[i], 0, known, environment, path)
    return True


@compiled_inline
def retrace_episode(
    i: int, stored: StoredPaths, environment: Environment, driver: RecordArray, path: Trajectory, twin: Record
) -> None:
    """Fill ``twin``, a `RETRACED_DTYPE` record, for row ``i``."""
    max_steps = environment.numbers.max_steps
    cut, end = stored.cut_step[i], min(stored.n_steps[i], max_steps)
    lead = stored.script.lead[i]
    twin.onset_r2 = twin.onset_r2dot = twin.impact = float("nan")
    if cut < 0 or cut >= end:
        twin.outcome, twin.n_steps = approach(i, end, stored, environment, path)
    else:
        twin.outcome, twin.n_steps = approach_cut_in(i, stored, environment, path)
    if 0 <= cut <= twin.n_steps:
        state = state_of(path.x[onset_of(cut, lead)], path.v[onset_of(cut, lead)])
        twin.onset_r2, twin.onset_r2dot = state.r2_m, state.r2dot_mps
    if twin.outcome != RUNNING:
        return
    if cut < 0:
        if end == max_steps:
            twin.outcome = TIMEOUT
        return
    twin.n_steps = end
    if not leave_stored(i, end, stored, environment, path):
        twin.outcome = FAILED
        return
    if driver.size > 0:
        late = reaction_steps(driver[0], stored.seed, stored.episode[i])
        take_over(0, 0, driver, late, False, cut, lead, environment, path)
        follow(1, driver, cut, lead, end, path)
        crash, speed = path.follower[0].end, path.follower[0].v
        if crash == WAS_AHEAD:
            twin.outcome, twin.n_steps = PASSED, cut + 1
        elif crash != NO_CRASH:
            twin.outcome, twin.n_steps = CRASH, crash
            twin.impact = speed - path.v_after[crash]
        elif end == max_steps:
            twin.outcome = TIMEOUT


@compiled_threads
def retrace(
    stored: StoredPaths, environment: Environment, driver: RecordArray, path: Trajectory, twin: RecordArray
) -> None:
    """What the twin says of every stored episode of an AV that keeps its speed until the cut-in; ``twin`` receives it.

    ``driver`` is (1,) for a built-in AV, else (0,): nothing is known about another one after the cut-in. ``path`` is
    scratch space.
    """
    for i in range(stored.cut_step.size):
        retrace_episode(i, stored, environment, driver, path, twin[i])


@compiled_threads
def drive_others(
    stored: StoredPaths,
    start: FloatArray,
    environment: Environment,
    drivers: RecordArray,
    path: Trajectory,
    end: IntArray,
    motion: FloatArray,
) -> None:
    """Drive others in the AV's place along stored episodes with a cut-in, from the end of the step of its onset.

    ``start`` (n, 2) is the AV's position (m) and speed (m/s) then, NaN where it has kept its speed until there. ``end``
    (n, D) receives the step after which each of ``drivers`` (D,) has run into BV, `NO_CRASH` or `WAS_AHEAD`, and
    ``motion`` (D, steps + 1, 2) its position (m) and speed (m/s) in the last of the episodes; (0, 0, 0) is not filled.
    ``path`` is room to work in, and holds BV's motion of the last episode, as if nobody had hit it.
    """
    most = environment.numbers.max_steps
    for i in range(stored.cut_step.size):
        cut, lead = stored.cut_step[i], stored.script.lead[i]
        known, after = recall(i, stored, path), onset_of(cut, lead) + 1
        walk(stored.state[i], stored.seed, stored.episode[i], known, cut + 1, False, environment, path)
        leave_stored(i, most, stored, environment, path)
        if not math.isnan(start[i, 0]):
            path.x[after, AV], path.v[after, AV] = start[i]
        if motion.size > 0:
            path.slowest[:] = -math.inf  # nobody is let off before the end because nothing can happen any more
        for d in range(drivers.size):
            late = drivers[d].delay_steps
            for until in range(after if motion.size > 0 else most, most + 1):
                take_over(0, d, drivers, late, False, cut, lead, environment, path)
                follow(1, drivers, cut, lead, until, path)
                if motion.size > 0:
                    motion[d, until, 0], motion[d, until, 1] = path.follower[0].x, path.follower[0].v
                end[i, d] = path.follower[0].end
                if end[i, d] != NO_CRASH:
                    break


class Retracing:
    """Retraces shards of one campaign."""

    def __init__(self, resolved: Resolved) -> None:
        campaign = resolved.campaign
        self._reason: str | None = None
        if campaign.world.engine == "twin":
            self._reason = "the episodes were simulated in the twin itself"
        elif campaign.av.acts_before_cut_in:
            self._reason = "the AV acted before the cut-in, and nothing on record says how"
        self._seed, self._environment = campaign.seed, resolved.environment
        # After an onset the AV may act: where it is then, nothing on record says of one that is not built in.
        self._at_cut_in = _AT_ONSET if resolved.environment.lateral.present else _AT_CUT_IN
        self._driver = resolved.av
        self._scratch = empty_trajectory(resolved.environment)

    def check(self, episodes: pa.Table) -> int:
        """Retrace the rows of an episodes table; returns how many, all of them equal.

        Raises `WorldDisagreementError`: the twin arrives at something else; the first such episode is named.
        """
        if self._reason is not None:
            return 0
        stored = stored_paths(episodes, self._seed)
        n = int(episodes.num_rows)
        twin = np.zeros(n, RETRACED_DTYPE)
        environment, scratch = unboxed(self._environment), unboxed(self._scratch)
        retrace(unboxed(stored), environment, self._driver, scratch, twin)
        differing = _differences(episodes, stored, twin, self._at_cut_in, self._driver.size > 0)
        for column, (wrong, in_sumo, in_twin) in differing.items():
            if wrong.any():
                row = int(np.argmax(wrong))
                where = f"episode {stored.episode[row]}, {column}"
                expected = f"{in_twin[row]}, to the last bit: the twin retraced its maneuvers"
                mend = "Please report this episode: its campaign.yaml and index reproduce it."
                raise WorldDisagreementError(where, f"{in_sumo[row]} in SUMO", expected, mend)
        return n

    def summary(self, n: int) -> dict[str, Any]:
        """What manifest and estimates say: ``n`` episodes retraced, or why none could be."""
        if self._reason is not None:
            return {"reason": self._reason}
        compared = [*self._at_cut_in, "outcome without a cut-in", "n_steps"]
        if self._driver.size > 0:
            compared += ["outcome", "crash_time_s", "impact_speed_mps"]
        return {"n_episodes": n, "n_equal": n, "compared": compared}


_AT_CUT_IN, _AT_ONSET = ("cut_in_r2_m", "cut_in_r2dot_mps"), ("onset_r2_m", "onset_r2dot_mps")
_Difference = tuple[BoolArray, np.ndarray, np.ndarray]
"""Which rows differ, what is stored, and what the twin says."""


def _differences(
    episodes: pa.Table, stored: StoredPaths, twin: RecordArray, at_cut_in: tuple[str, str], built_in: bool
) -> dict[str, _Difference]:
    """Per column what is to be equal."""
    outcome = np.asarray(pc.index_in(episodes.column("outcome").cast(pa.string()), pa.array(OUTCOMES))).astype(np.int64)
    names = *at_cut_in, "impact_speed_mps", "crash_time_s"
    columns = (episodes.column(name).to_numpy() for name in names)  # NaN for null
    r2, r2dot, impact, time = (np.ascontiguousarray(column, np.float64) for column in columns)
    unknown = (outcome == FAILED) | ((stored.cut_step >= 0) & (not built_in))
    expected = np.where(unknown, np.where(twin["outcome"] == RUNNING, outcome, twin["outcome"]), twin["outcome"])
    crash = (outcome == CRASH) & built_in
    before = (outcome == FAILED) & (stored.cut_step < 0)  # it may have failed between the onset and the cut-in
    at = np.where(outcome == CRASH, stored.n_steps * STEP_S, np.nan)
    words = np.array([*OUTCOMES, "neither crash nor end"])
    maneuvers = (twin["outcome"] == FAILED, words[outcome], np.full(len(outcome), "maneuvers that lead there"))
    return {
        "lv_maneuvers, bv_maneuvers": maneuvers,
        at_cut_in[0]: (_unlike(r2, twin["onset_r2"]) & ~before, r2, twin["onset_r2"]),
        at_cut_in[1]: (_unlike(r2dot, twin["onset_r2dot"]) & ~before, r2dot, twin["onset_r2dot"]),
        "outcome": (outcome != expected, words[outcome], words[expected]),
        "n_steps": (stored.n_steps != twin["n_steps"], stored.n_steps, twin["n_steps"]),
        "crash_time_s": (_unlike(time, at), time, at),
        "impact_speed_mps": (_unlike(impact, twin["impact"]) & crash, impact, twin["impact"]),
    }


def _unlike(a: FloatArray, b: FloatArray) -> BoolArray:
    """Where two arrays differ in a bit; undefined numbers are alike."""
    unlike: BoolArray = (a.view(np.int64) != b.view(np.int64)) & ~(np.isnan(a) & np.isnan(b))
    return unlike
