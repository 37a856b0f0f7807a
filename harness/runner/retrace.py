"""The twin retraces what SUMO has driven, episode by episode, and must arrive at the same bits.

Initial state and maneuvers determine LV's and BV's motion, and the AV keeps its speed until the cut-in. So R2 and R2dot
at the cut-in, and every end without one, follow from what is on record; for a built-in AV the crash too, with its time
and impact speed. It takes a few microseconds per episode, where SUMO takes hundreds.
"""

from __future__ import annotations

from typing import Any

import numpy as np
import pyarrow as pa

from harness.episode.path import empty_trajectory
from harness.errors import WorldDisagreementError
from harness.pool.replay import Retraced, StoredPaths, retrace, stored_paths
from harness.resolved import Resolved
from harness.unboxed import unboxed
from harness.vehicles.kinematics import STEP_S
from harness.vocabulary import CRASH, FAILED, OUTCOMES, RUNNING, BoolArray, FloatArray, IntArray


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
        self._room = empty_trajectory(resolved.environment)

    def check(self, episodes: pa.Table) -> int:
        """Retrace the rows of an episodes table; returns how many, all of them equal.

        Raises
        ------
        WorldDisagreementError
            The twin arrives at something else; the first such episode is named.
        """
        if self._reason is not None:
            return 0
        stored = stored_paths(episodes, self._seed)
        n = int(episodes.num_rows)
        twin = Retraced(np.zeros(n, np.int64), np.zeros(n, np.int64), np.zeros(n), np.zeros(n), np.zeros(n))
        environment, room = unboxed(self._environment), unboxed(self._room)
        retrace(unboxed(stored), environment, self._driver, room, unboxed(twin))
        differing = _differences(episodes, stored, twin, self._at_cut_in, self._driver.size > 0)
        for column, (wrong, in_sumo, in_twin) in differing.items():
            if wrong.any():
                row = int(np.argmax(wrong))
                where = f"episode {stored.first + row}, {column}"
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
    episodes: pa.Table, stored: StoredPaths, twin: Retraced, at_cut_in: tuple[str, str], built_in: bool
) -> dict[str, _Difference]:
    """Per column what is to be equal."""
    outcome = _outcomes(episodes)
    r2, r2dot, impact, time = (_floats(episodes, name) for name in (*at_cut_in, "impact_speed_mps", "crash_time_s"))
    unknown = (outcome == FAILED) | ((stored.cut_step >= 0) & (not built_in))
    expected = np.where(unknown, np.where(twin.outcome == RUNNING, outcome, twin.outcome), twin.outcome)
    crash = (outcome == CRASH) & built_in
    before = (outcome == FAILED) & (stored.cut_step < 0)  # it may have failed between the onset and the cut-in
    at = np.where(outcome == CRASH, stored.n_steps * STEP_S, np.nan)
    names = np.array([*OUTCOMES, "neither crash nor end"])
    maneuvers = (twin.outcome == FAILED, names[outcome], np.full(len(outcome), "maneuvers that lead there"))
    return {
        "lv_maneuvers, bv_maneuvers": maneuvers,
        at_cut_in[0]: (_unlike(r2, twin.onset_r2) & ~before, r2, twin.onset_r2),
        at_cut_in[1]: (_unlike(r2dot, twin.onset_r2dot) & ~before, r2dot, twin.onset_r2dot),
        "outcome": (outcome != expected, names[outcome], names[expected]),
        "n_steps": (stored.n_steps != twin.n_steps, stored.n_steps, twin.n_steps),
        "crash_time_s": (_unlike(time, at), time, at),
        "impact_speed_mps": (_unlike(impact, twin.impact) & crash, impact, twin.impact),
    }


def _unlike(a: FloatArray, b: FloatArray) -> BoolArray:
    """Where two arrays differ in a bit; undefined numbers are alike."""
    unlike: BoolArray = (a.view(np.int64) != b.view(np.int64)) & ~(np.isnan(a) & np.isnan(b))
    return unlike


def _floats(episodes: pa.Table, name: str) -> FloatArray:
    """A column with NaN for null."""
    values: FloatArray = episodes.column(name).to_numpy().astype(np.float64)
    return np.ascontiguousarray(values)


def _outcomes(episodes: pa.Table) -> IntArray:
    whole = episodes.column("outcome").unify_dictionaries().combine_chunks()
    codes = np.array([OUTCOMES.index(name) for name in whole.dictionary.to_pylist()], np.int64)
    found: IntArray = codes[whole.indices.to_numpy()]
    return found
