"""What the laws of traffic are fitted to, taken from the trajectories of one recording."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from harness.vocabulary import RecordArray


def _dtype(*names: str) -> np.dtype[np.void]:
    return np.dtype([("vehicle", np.int64), *((name, np.float64) for name in names)])


FREE = _dtype("v_mps", "acceleration_mps2")
FOLLOWING = _dtype("v_mps", "r1_m", "r1dot_mps", "acceleration_mps2")
INITIAL = _dtype("v_mps", "r1_m", "r1dot_mps")
AT_RISK = np.dtype(
    [*_dtype("duration_s", "v_mps", "r1_m", "r1dot_mps", "r2_m", "r2dot_mps", "ttc_s").descr, ("changes", np.bool_)]
)
LEADS = _dtype("lead_s", "lateral_speed_mps")


@dataclass(frozen=True)
class Observations:
    """Observations of one recording, within the fit range, of vehicles in lanes beside a target lane.

    Gaps are bumper to bumper (m), rates leader minus follower (m/s); ``vehicle`` numbers the vehicles of the recording.

    Attributes
    ----------
    recording : str
        Its name, for messages and as cluster.
    free : RecordArray
        `FREE`: accelerations of one second of vehicles without a leader within the fit range.
    following : RecordArray
        `FOLLOWING`: state behind the leader, and acceleration of the second that begins there.
    initial : RecordArray
        `INITIAL`: one state behind a leader per vehicle and 20 s.
    at_risk : RecordArray
        `AT_RISK`: one row per second behind a leader with nobody alongside in the target lane; ``duration_s`` is the
        time that it stands for. ``ttc_s`` is R2/-R2dot, infinite where nobody is behind or closes in; R2 and R2dot are
        then infinite and 0 where nobody is behind. A row that ``changes`` is the state of a crossing to the target
        lane.
    leads : RecordArray
        `LEADS`: time from onset of lateral motion to crossing, and lateral speed at it; empty without lateral
        positions.
    """

    recording: str
    free: RecordArray
    following: RecordArray
    initial: RecordArray
    at_risk: RecordArray
    leads: RecordArray
