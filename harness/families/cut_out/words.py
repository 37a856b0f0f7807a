"""What pages say of cut-outs."""

from __future__ import annotations

from harness.families.words import Shown, Words

WORDS = Words(
    called="cut-out",
    event="cut-out",
    events="cut-outs",
    since="the lane was clear",
    kicker="How often an automated vehicle (AV) collides with a slower vehicle (SV) that the one ahead (LV) reveals "
    "when it leaves the lane, on a motorway",
    same="vehicles that others reveal",
    such=" of such following",
    none="Nobody left the lane.",
    strikes="In every crash the AV strikes SV from behind.",
    who="LV the one ahead, which leaves the lane, SV the slower one that it reveals",
    shows=("LV", "leaves the lane"),
    happens=("LV", "has left it"),
    tests=lambda _: (
        "the vehicle follows another one on a straight road, at the distance that it chooses; after 30 s the one "
        "ahead leaves the lane and reveals a slower one"
    ),
    rests=lambda *_: (
        "how slow the vehicle is that is revealed, and how late, which is assumed; it is per cut-out, and how many "
        "there are in an hour of driving is assumed, too"
    ),
    unlikely="Cut-outs that ask for little braking of anybody are not among them.",
    milder="leaving.scope_mps2: 0.5",
)
CLOSING = Shown(
    "closing speed of the one that leaves",
    "m/s",
    ("Closing", "speed"),
    lambda of: of["closing_mps"],
    beyond=1.15,
    cell=1.0,
)
TTC = Shown(
    "its time to collision when it has left",
    "s",
    ("TTC when", "clear"),
    lambda of: of["ttc_when_clear_s"],
    beyond=1.2,
    cell=0.25,
)
