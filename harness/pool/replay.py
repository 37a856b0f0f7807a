"""Stored episodes once more, without SUMO: what the twin says about them, and which surrogates would have crashed.

An episode's initial state and maneuvers determine LV's and BV's motion to the last bit, and the AV keeps its speed
until the cut-in. So the twin can retrace what a world has done, and put any surrogate in the AV's place. Where the AV's
crash ended the episode early, BV's free driving goes on under p with the episode's own random numbers: the weight of
the episode is that of its control steps, whatever comes after them.
"""

from __future__ import annotations

from typing import NamedTuple

from harness.arrays import FloatArray, Int8Array, IntArray, Record, RecordArray
from harness.compiled import compiled_inline, compiled_threads
from harness.environment.driving import Environment, draw_free_driving
from harness.episode.begin import place
from harness.maneuvers import CUT_IN, acceleration
from harness.outcomes import AV, BV, BV_LV_CONTACT, CRASH, FAILED, LV, PASSED, RUNNING, TIMEOUT
from harness.pool.enumeration import NO_CRASH, Path, crash_step, follow
from harness.random_stream import BV_FREE_DRAWS, uniform
from harness.vehicles.kinematics import CONTACT_M, gap, next_position, next_speed
from harness.vehicles.reaction import reaction_steps


class StoredPaths(NamedTuple):
    """Consecutive stored episodes, ``first …`` of a campaign with seed ``seed``.

    ``state`` (n, 5) are initial states; ``n_steps``, ``cut_step`` (n,) steps simulated and that of the cut-in, -1
    without one. ``lv``, ``bv`` are the maneuver indices of all episodes one after another, those of row i at
    ``begin[i] … begin[i + 1] - 1``; 31 in ``bv`` marks the cut-in.
    """

    seed: int
    first: int
    state: FloatArray
    n_steps: IntArray
    cut_step: IntArray
    lv: Int8Array
    lv_begin: IntArray
    bv: Int8Array
    bv_begin: IntArray


class Twin(NamedTuple):
    """What the twin says of stored episodes, one array entry (n,) each.

    ``outcome``: how the episode ends, `RUNNING` where only the AV knows. ``n_steps``: when. ``cut_r2``, ``cut_r2dot``:
    R2 (m) and R2dot (m/s) at the cut-in, NaN without one. ``impact``: v_AV - v_BV (m/s) at a crash, else NaN.
    """

    outcome: IntArray
    n_steps: IntArray
    cut_r2: FloatArray
    cut_r2dot: FloatArray
    impact: FloatArray


@compiled_inline
def approach(i: int, end: int, hold_steps: int, stored: StoredPaths, path: Path) -> tuple[int, int]:
    """LV's and BV's stored motion to step ``end`` or a decision without cut-in; how it is decided, and the step."""
    place(stored.state[i], path.x, path.v)
    x_lv, x_bv, x_av = path.x[LV], path.x[BV], path.x[AV]
    v_lv, v_bv, v_av = path.v[LV], path.v[BV], path.v[AV]
    a_lv = a_bv = 0.0
    path.x_bv[0], path.v_bv[0], path.x_av[0] = x_bv, v_bv, x_av
    for step in range(end):
        if step % hold_steps == 0:
            lv, bv = stored.lv_begin[i] + step // hold_steps, stored.bv_begin[i] + step // hold_steps
            if lv >= stored.lv_begin[i + 1] or bv >= stored.bv_begin[i + 1]:
                return FAILED, step
            a_lv, a_bv = acceleration(stored.lv[lv]), acceleration(stored.bv[bv])
        after_lv, after_bv = next_speed(v_lv, a_lv), next_speed(v_bv, a_bv)
        x_lv = next_position(x_lv, v_lv, after_lv)
        x_bv = next_position(x_bv, v_bv, after_bv)
        x_av = next_position(x_av, v_av, v_av)
        v_lv, v_bv = after_lv, after_bv
        path.x_bv[step + 1], path.v_bv[step + 1], path.x_av[step + 1] = x_bv, v_bv, x_av
        if gap(x_lv, x_bv) < CONTACT_M:
            return BV_LV_CONTACT, step + 1
        if gap(x_bv, x_av) <= 0.0:
            return PASSED, step + 1
    return RUNNING, end


@compiled_inline
def leave_stored(i: int, end: int, hold_steps: int, stored: StoredPaths, environment: Environment, path: Path) -> bool:
    """BV's motion from its cut-in to step ``end``: as stored, then under p; False if no cut-in is stored where it was.

    The path up to the cut-in must have been walked.
    """
    cut = stored.cut_step[i]
    mark = stored.bv_begin[i] + cut // hold_steps + 1
    stop = stored.bv_begin[i + 1]
    if mark >= stop or stored.bv[mark] != CUT_IN:
        return False
    x, v = path.x_bv[cut], path.v_bv[cut]
    a = acceleration(stored.bv[mark - 1])
    draws = 0
    for step in range(cut, end):
        if step > cut and (step - cut - 1) % hold_steps == 0:
            draws += 1
            if mark + draws < stop:
                a = acceleration(stored.bv[mark + draws])
            else:
                u = uniform(stored.seed, stored.first + i, BV_FREE_DRAWS, draws - 1)
                a = acceleration(draw_free_driving(u, v, environment))
        v_after = next_speed(v, a)
        x = next_position(x, v, v_after)
        v = v_after
        path.x_after[step + 1], path.v_after[step + 1] = x, v
    return True


@compiled_inline
def retrace_episode(
    i: int, stored: StoredPaths, environment: Environment, driver: RecordArray, path: Path, twin: Twin
) -> None:
    """Fill row ``i`` of ``twin``."""
    n = environment.numbers[0]
    cut, end = stored.cut_step[i], min(stored.n_steps[i], n.max_steps)
    twin.cut_r2[i] = twin.cut_r2dot[i] = twin.impact[i] = float("nan")
    twin.outcome[i], twin.n_steps[i] = approach(i, end if cut < 0 else min(cut, end), n.hold_steps, stored, path)
    if twin.outcome[i] != RUNNING:
        return
    if cut < 0:
        if end == n.max_steps:
            twin.outcome[i] = TIMEOUT
        return
    twin.n_steps[i] = end
    x, v = path.x_av[cut], path.v[AV]
    twin.cut_r2[i], twin.cut_r2dot[i] = gap(path.x_bv[cut], x), path.v_bv[cut] - v
    if not leave_stored(i, end, n.hold_steps, stored, environment, path):
        twin.outcome[i] = FAILED
        return
    if driver.size > 0:
        late = reaction_steps(driver[0], stored.seed, stored.first + i)
        crash, speed = follow(driver[0], late, x, v, cut, path, end)
        if crash != NO_CRASH:
            twin.outcome[i], twin.n_steps[i] = CRASH, crash
            twin.impact[i] = speed - path.v_after[crash]
        elif end == n.max_steps:
            twin.outcome[i] = TIMEOUT


@compiled_threads
def retrace(stored: StoredPaths, environment: Environment, driver: RecordArray, path: Path, twin: Twin) -> None:
    """What the twin says of every stored episode.

    Parameters
    ----------
    stored : StoredPaths
        Of an AV that keeps its speed until the cut-in.
    environment : Environment
    driver : structured ndarray, shape (1,) or (0,)
        A built-in AV; nothing is known about another one after the cut-in.
    path : Path
        Room to work in.
    twin : Twin
        Receives the answer.
    """
    for i in range(stored.cut_step.size):
        retrace_episode(i, stored, environment, driver, path, twin)


@compiled_inline
def who_crashes(x: float, v: float, cut: int, max_steps: int, drivers: RecordArray, envelope: int, path: Path) -> int:
    """One bit for each driver that runs into BV; ``x`` (m), ``v`` (m/s) are the AV's at the cut-in."""
    if envelope >= 0 and _crashes(drivers[envelope], x, v, cut, max_steps, path) == 0:
        return 0
    found = 0
    for d in range(drivers.size):
        if d == envelope or _crashes(drivers[d], x, v, cut, max_steps, path) == 1:
            found |= 1 << d
    return found


@compiled_inline
def _crashes(driver: Record, x: float, v: float, cut: int, max_steps: int, path: Path) -> int:
    return 1 if crash_step(driver, driver.delay_steps, x, v, cut, path, max_steps) != NO_CRASH else 0


@compiled_threads
def replay_surrogates(
    stored: StoredPaths, environment: Environment, drivers: RecordArray, envelope: int, path: Path, crashes: IntArray
) -> int:
    """Which surrogates would have crashed in each stored episode.

    Parameters
    ----------
    stored : StoredPaths
        Of an AV that keeps its speed until the cut-in.
    drivers : structured ndarray, shape (D,)
        At most 62 of them, without inattention.
    envelope : int
        The driver that crashes wherever another one does; -1 for none.
    path : Path
        Room to work in.
    crashes : ndarray of int64, shape (n,)
        Receives one bit per driver; none without a cut-in.

    Returns
    -------
    int
        Row of the first episode whose maneuvers do not fit its steps, or -1.
    """
    n = environment.numbers[0]
    for i in range(stored.cut_step.size):
        crashes[i] = 0
        cut = stored.cut_step[i]
        if cut < 0:
            continue
        decided, _ = approach(i, cut, n.hold_steps, stored, path)
        if decided != RUNNING or not leave_stored(i, n.max_steps, n.hold_steps, stored, environment, path):
            return i
        crashes[i] = who_crashes(path.x_av[cut], path.v[AV], cut, n.max_steps, drivers, envelope, path)
    return -1
