"""What pages say of cut-ins."""

from __future__ import annotations

from types import MappingProxyType

from harness.campaign.drivers import Surrogate
from harness.families.cut_in.laws import Environment
from harness.families.words import GAP, Words


def _tests(shows: bool) -> str:
    takes = "takes time" if shows else "takes no time"
    return f"a car cuts in ahead of the vehicle that overtakes it on a straight road, by a lane change that {takes}"


def _rests(traffic: Environment | None, level: str) -> str:
    often = (
        "how often drivers cut in ahead of vehicles that are closing in, which this traffic has from data"
        if traffic is not None and len(traffic.accepted)
        else "the share of drivers who cut in without looking behind, which is assumed"
    )
    return f"the level of lane changing ({level} here) and with {often}"


WORDS = Words(
    called="cut-in",
    test="overtaking, mostly without a cut-in",
    event="cut-in",
    events="cut-ins",
    since="BV entered the lane",
    kicker="How often an automated vehicle (AV) collides with a car that cuts in (BV, the background vehicle) behind a "
    "leading one (LV), on a motorway",
    same="cars that cut in",
    such=" overtaking",
    none="Nobody cut in.",
    strikes="In every crash the AV strikes BV from behind.",
    who="BV the one that cuts in, LV the one ahead of it",
    shows=("BV", "comes over"),
    happens=("BV", "enters the lane"),
    unlikely="It is small because most naturalistic tests end without a cut-in, and so without a crash.",
    tests=_tests,
    rests=_rests,
    late=("the other car (BV) was in its lane", "bv_lateral_m > 0", "BV’s getLateralLanePosition < 0"),
)
AT_OVERLAP = GAP._replace(words="gap at the overlap", head=("Gap at", "overlap"))
STAND_INS = MappingProxyType(
    {
        "r157-cc": ("a careful and competent driver", Surrogate(model="r157-cc")),
        "brakes-8": (
            "braking as soon as it sees BV come over, at up to 8 m/s²",
            Surrogate.model_validate({"model": "idm", "parameters": {"min_acceleration_mps2": -8.0}}),
        ),
    }
)
