"""What a family prescribes for tests, and the core repeats: the motion of the others, and what goes with it."""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np

from harness.vocabulary import FloatArray, Int8Array, IntArray, UInt64Array

NEVER = 2**62
"""A step that no test has."""


class Script(NamedTuple):
    """What is prescribed of tests (n,) with V vehicles each, the AV last, and O others.

    ``x``, ``v``, ``lane`` (n, V) are positions (m), speeds (m/s) and lanes (0 right, 1 left) at the beginning.
    ``speed`` (n, steps, O) are the speeds of the others at the end of each step, exactly as the world is told, and
    ``lanes`` (n, steps, O) their lanes then; there are no steps if the others are driven in the loop. The event is in
    step ``at`` (n,), -1 for none, and shows itself ``lead`` (n,) steps earlier. ``n_steps`` (n,) is the longest that
    each test may be, ``acts_from`` (n,) the first step in which the AV may act, at most the one after the onset, and
    ``visible_from`` (n, O) the step from which on it sees each of the others. ``headway_s`` (n,) is what people keep on
    the path, NaN if unknown; ``sideways_mps`` (n,) the speed at which a vehicle moves sideways, 0 for none;
    ``set_speed_mps`` (n,) the speed at which the AV would cruise, NaN for its own. ``stratum`` (n,) is what a test was
    drawn from, ``log_weight`` (n,) its log weight, ``log_p_event`` (n,) the log probability of an event on its path,
    NaN if not computed. ``announced_index`` (n,) is the index that the AV is told, -1 for the test's own, and
    ``motion_hash`` (n,) that of how the AV must have moved by the end of the step of the onset, as in its baseline run;
    0 if there was none.
    """

    x: FloatArray
    v: FloatArray
    lane: Int8Array
    speed: FloatArray
    lanes: Int8Array
    at: IntArray
    lead: IntArray
    n_steps: IntArray
    acts_from: IntArray
    visible_from: IntArray
    headway_s: FloatArray
    sideways_mps: FloatArray
    set_speed_mps: FloatArray
    stratum: IntArray
    log_weight: FloatArray
    log_p_event: FloatArray
    announced_index: IntArray
    motion_hash: UInt64Array

    def rows(self, rows: slice) -> Script:
        """The scripts of some tests."""
        return Script._make(np.ascontiguousarray(column[rows]) for column in self)


def natural_script(
    x: FloatArray, v: FloatArray, lane: Int8Array, speed: FloatArray, lanes: Int8Array, at: IntArray, lead: IntArray
) -> Script:
    """A script whose tests weigh 1; see `Script`.

    A test may be as long as its motion, and the AV sees all others and acts from the step after the onset on. A family
    whose tests differ replaces these fields (`_replace`).
    """
    n = len(x)
    return Script(
        *(x, v, lane, speed, lanes, at, lead),
        n_steps=np.full(n, speed.shape[1]),
        acts_from=np.where(at < 0, NEVER, np.maximum(at - lead, 0) + 1),
        visible_from=np.zeros((n, x.shape[1] - 1), np.int64),
        headway_s=np.full(n, math.nan),
        sideways_mps=np.zeros(n),
        set_speed_mps=np.full(n, math.nan),
        stratum=np.full(n, -1),
        log_weight=np.zeros(n),
        log_p_event=np.full(n, math.nan),
        announced_index=np.full(n, -1),
        motion_hash=np.zeros(n, np.uint64),
    )
