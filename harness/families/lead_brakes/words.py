"""What pages say of lead braking."""

from __future__ import annotations

import numpy as np

from harness.families.following.words import words_of_following
from harness.families.words import Shown

WORDS = words_of_following(
    called="lead brakes",
    event="braking",
    test="braking of the vehicle ahead by 3 m/s² or more",
    since="the onset",
    kicker="How often an automated vehicle (AV) collides with the vehicle ahead (LV) when that brakes, on a motorway",
    same="vehicles ahead that brake",
    none="Nobody braked.",
    strikes="LV",
    who="LV the one ahead, which brakes",
    shows=("LV", "brakes"),
    happens=("LV", "brakes"),
    then="brakes, for a time or to a standstill",
    depend="how hard, how long and how abruptly the vehicle ahead brakes",
    unlikely="These are brakings of 3 m/s² or more, one in each test.",
)
HEADWAY = Shown(
    "headway at the onset", "s", ("Headway at", "onset"),
    # The AV may stand.
    lambda tests: tests["event_gap_m"] / np.maximum(tests["lead_speed_mps"] - tests["event_rate_mps"], 1.0),
    beyond=1.2, cell=0.1,
)  # fmt: skip
PEAK = Shown(
    "peak deceleration", "m/s²", ("Peak", "deceleration"),
    lambda tests: tests["peak_mps2"], beyond=1.2, cell=0.2, edges=np.arange(0.2, 15.1, 0.4),
)  # fmt: skip
HELD_AT_MOST_S = 6.0
HELD = Shown(
    "held for (at the right end: longer, or to standstill)", "s", ("Held",),
    lambda tests: np.minimum(tests["held_s"], HELD_AT_MOST_S - 1e-3),
    beyond=1.0, cell=0.5, edges=np.arange(0.0, HELD_AT_MOST_S + 0.1, 0.5),
)  # fmt: skip
