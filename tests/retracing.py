"""The twin retraces stored episodes from their maneuvers, and must arrive at the same bits.

Initial state and maneuvers determine LV's and BV's motion to the last bit, and the AV keeps its speed until the onset.
So R2 and R2dot there, and every end without a cut-in, follow from what is on record; for a built-in AV the crash too.
"""

import numpy as np
import pyarrow as pa
import pyarrow.compute as pc

from harness.compiled import compiled_inline, compiled_threads, unboxed
from harness.families.cut_in.laws import Environment
from harness.families.cut_in.path import NO_CRASH, WAS_AHEAD, Trajectory, empty_trajectory, follow, state_of, take_over
from harness.families.cut_in.replay import StoredPaths, leave_stored
from harness.resolved import Resolved
from harness.vehicles.kinematics import STEP_S
from harness.vehicles.references import reaction_steps
from harness.vehicles.sideways import onset_of
from harness.vocabulary import CRASH, FAILED, OUTCOMES, PASSED, RUNNING, TIMEOUT, Record, RecordArray
from tests.in_its_place import approach, approach_cut_in, stored_paths

RETRACED_DTYPE = np.dtype(
    [(name, np.int64) for name in ("outcome", "n_steps")]
    + [(name, np.float64) for name in ("onset_r2", "onset_r2dot", "impact")]
)
"""What the twin says of a stored episode: how it ends, `RUNNING` where only the AV knows, and when; R2 (m), R2dot (m/s)
at the cut-in, or at its onset where that comes before, NaN without one; v_AV - v_BV (m/s) at a crash, else NaN."""


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


def retraced(episodes: pa.Table, resolved: Resolved) -> list[str]:
    """Columns of an episodes table of which the twin says something else in any row."""
    stored = stored_paths(episodes, resolved.campaign.seed)
    twin, scratch = np.zeros(episodes.num_rows, RETRACED_DTYPE), empty_trajectory(resolved.environment)
    retrace(unboxed(stored), unboxed(resolved.environment), resolved.av, unboxed(scratch), twin)
    where, built_in = "onset" if resolved.environment.lateral.present else "event", resolved.av.size > 0
    outcome = np.asarray(pc.index_in(episodes.column("outcome").cast(pa.string()), pa.array(OUTCOMES))).astype(np.int64)
    names = f"{where}_gap_m", f"{where}_rate_mps", "impact_speed_mps", "crash_time_s"
    columns = (episodes.column(name).to_numpy() for name in names)  # NaN for null
    r2, r2dot, impact, time = (np.ascontiguousarray(column, np.float64) for column in columns)
    unknown = (twin["outcome"] == RUNNING) & ((outcome == FAILED) | ((stored.cut_step >= 0) & (not built_in)))
    before = (outcome == FAILED) & (stored.cut_step < 0)  # it may have failed between the onset and the cut-in
    differing = {
        "lv_maneuvers, bv_maneuvers": twin["outcome"] == FAILED,
        names[0]: unlike(r2, twin["onset_r2"]) & ~before,
        names[1]: unlike(r2dot, twin["onset_r2dot"]) & ~before,
        "outcome": (outcome != twin["outcome"]) & ~unknown,
        "n_steps": stored.n_steps != twin["n_steps"],
        "crash_time_s": unlike(time, np.where(outcome == CRASH, stored.n_steps * STEP_S, np.nan)),
        "impact_speed_mps": unlike(impact, twin["impact"]) & (outcome == CRASH) & built_in,
    }
    return [name for name, rows in differing.items() if rows.any()]


def unlike(a: np.ndarray, b: np.ndarray) -> np.ndarray:
    """Where two arrays differ in a bit; undefined numbers are alike."""
    return (a.view(np.int64) != b.view(np.int64)) & ~(np.isnan(a) & np.isnan(b))
