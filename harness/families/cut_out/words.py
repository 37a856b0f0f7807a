"""What pages say of cut-outs."""

from __future__ import annotations

from harness.families.following.words import words_of_following
from harness.families.words import Shown

WORDS = words_of_following(
    called="cut-out",
    event="cut-out",
    test="cut-out, most often a harmless one",
    since="the lane was clear",
    kicker="How often an automated vehicle (AV) collides with a slower vehicle (SV) that the one ahead (LV) reveals "
    "when it leaves the lane, on a motorway",
    same="vehicles that others reveal",
    none="Nobody left the lane.",
    strikes="SV",
    who="LV the one ahead, which leaves the lane, SV the slower one that it reveals",
    shows=("LV", "leaves the lane"),
    happens=("LV", "has left the lane"),
    late=("the one ahead (LV) had left the lane", "lv_lateral_m > 0", "LV’s getLateralLanePosition > 0"),
    then="leaves the lane and reveals a slower one",
    depend="how slow the vehicle is that is revealed, and how late",
    unlikely="Cut-outs that ask for little braking of anybody are not among them.",
)
CLOSING = Shown(
    "closing speed of LV on SV", "m/s", ("Closing", "speed"),
    lambda tests: tests["closing_mps"], beyond=1.15, cell=1.0,
)  # fmt: skip
TTC = Shown(
    "time to collision when the lane is clear", "s", ("TTC when", "clear"),
    lambda tests: tests["ttc_when_clear_s"], beyond=1.2, cell=0.25,
)  # fmt: skip
