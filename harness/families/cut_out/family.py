"""The vehicle ahead leaves the lane and reveals a slower one: how much slower, how late, and how fast it leaves."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import Annotated, Any, Literal, Self

import numpy as np
import pyarrow as pa
from pydantic import model_validator
from scipy.special import ndtr, ndtri

from harness import elementary
from harness.campaign.sections import Section
from harness.families.cut_out.words import CLOSING, TTC, WORDS
from harness.families.following.approach import FollowingTraffic
from harness.families.following.family import START_FACTS, FollowingFamily
from harness.families.following.parameters import FollowingParameters, grid_of
from harness.families.numbers import Number, Share, ordered, within
from harness.families.protocol import Column
from harness.families.script import NEVER
from harness.problems import broken_rule
from harness.vehicles.following import seen_after
from harness.vehicles.kinematics import STEP_S
from harness.vocabulary import FloatArray, RecordArray

TTC_EDGES_S = np.array([0.5, 0.75, 1, 1.25, 1.5, 1.75, 2, 2.25, 2.5, 2.75, 3, 3.5, 4, 4.5, 5, 6, 7, 8, 10, 12])
N_DROPS = 12
N_LATERAL = 7
_Ttc = Annotated[Number, within(0.1, 60.0)]


class Leaving(Section):
    """Law of the revealed vehicle's speed, of the time to collision with it when the lane is clear, and of leaving."""

    drop_mean: Annotated[Number, within(0.001, 1.0)]
    standing_share: Share
    ttc_median_s: _Ttc
    ttc_log_sd: Annotated[Number, within(0.01, 3.0)]
    careless_share: Share
    careless_least_s: _Ttc
    careless_most_s: _Ttc
    lateral_median_mps: Annotated[Number, within(0.05, 20.0)]
    lateral_log_sd: Annotated[Number, within(0.01, 3.0)]
    clear_m: Annotated[Number, within(0.1, 5.0)]
    visible_from_m: Annotated[Number, within(0.0, 5.0)]
    scope_mps2: Annotated[Number, within(0.0, 10.0)]
    scope_headway_s: Annotated[Number, within(0.0, 5.0)]

    _ranges = ordered(("careless_least_s", "careless_most_s"), equal=False)

    def lateral_mps(self) -> FloatArray:
        """Lateral speeds (m/s) at which the vehicle leaves, of equal probability."""
        quantiles = (np.arange(N_LATERAL) + 0.5) / N_LATERAL
        return np.asarray(self.lateral_median_mps.value * elementary.exp(self.lateral_log_sd.value * ndtri(quantiles)))


class CutOutParameters(FollowingParameters):
    """All numbers of the family."""

    format: Literal["cut-out"]
    version: Literal[1]
    leaving: Leaving

    folder, blocks = Path(__file__).parent, {**FollowingParameters.blocks, "cut-out": ("leaving",)}

    @model_validator(mode="after")
    def _happens_in_tests(self) -> Self:
        law, after_s = self.leaving, self.approach.after_s.value
        if law.careless_least_s.value >= TTC_EDGES_S[-1] or law.careless_most_s.value <= TTC_EDGES_S[0]:
            found = f"careless drivers from {law.careless_least_s.value:g} to {law.careless_most_s.value:g} s"
            expected = f"some between {TTC_EDGES_S[0]:g} and {TTC_EDGES_S[-1]:g} s, where events are"
            raise broken_rule("leaving.careless_least_s", found, expected, "Move one of both ends.")
        if (slowest_s := law.clear_m.value / law.lateral_mps().min()) > after_s:
            found, expected = f"a lane that is left in {slowest_s:.3g} s", f"at most {after_s:g} s (approach.after_s)"
            raise broken_rule("leaving.lateral_median_mps", found, expected, "Let all leave faster, or look longer.")
        return self

    def grid(self) -> tuple[RecordArray, FloatArray]:
        """Speeds exponentially below the leader's, or standing; log-normal or careless times; log-normal leaving."""
        law = self.leaving
        edges, mean, standing = np.linspace(0.0, 1.0, N_DROPS + 1), law.drop_mean.value, law.standing_share.value
        below = -elementary.expm1(-edges / mean) / -elementary.expm1(-1.0 / mean)
        ratio = np.append(1.0 - 0.5 * (edges[:-1] + edges[1:]), 0.0)
        of_ratio = np.append((1.0 - standing) * np.diff(below), standing)
        upto = ndtr((elementary.log(TTC_EDGES_S[1:-1]) - elementary.log(law.ttc_median_s.value)) / law.ttc_log_sd.value)
        careful = np.diff(np.concatenate([[0.0], upto, [1.0]]))  # what lies beyond is in the outermost bins
        least, most = law.careless_least_s.value, law.careless_most_s.value
        careless = np.diff(np.clip((TTC_EDGES_S - least) / (most - least), 0.0, 1.0))
        share = law.careless_share.value
        of_ttc = (1.0 - share) * careful + share * careless / careless.sum()
        ttc_s, lateral = 0.5 * (TTC_EDGES_S[:-1] + TTC_EDGES_S[1:]), np.full(N_LATERAL, 1.0 / N_LATERAL)
        return grid_of(ratio=(ratio, of_ratio), ttc_s=(ttc_s, of_ttc), lateral_mps=(law.lateral_mps(), lateral))


class CutOut(FollowingFamily):
    """See `harness.families.following.family`."""

    name = "cut_out"
    vehicles = ("LV", "SV", "AV")
    principal, ahead = 1, 0
    columns = (
        *START_FACTS,
        Column("revealed_speed_mps", pa.float64(), "m/s", "speed of the vehicle that is revealed"),
        Column("closing_mps", pa.float64(), "m/s", "speed of the one ahead less that"),
        Column("ttc_when_clear_s", pa.float64(), "s", "of the one ahead, when it has left the lane"),
        Column("lateral_speed_mps", pa.float64(), "m/s", "at which it leaves"),
        Column("visible_s", pa.float64(), "s", "from when the revealed one is seen to the lane being clear"),
    )
    ladders = {False: "ladder-cut-out-1"}
    default_parameters = "cut-out-1"
    fitter = "harness.families.cut_out.fitting:CutOutFitter"
    crosses, words = 0, WORDS
    maps = ((CLOSING, TTC._replace(edges=TTC_EDGES_S)),)
    stride = 10
    model = CutOutParameters

    def told(self, facts: Mapping[str, Any]) -> str:
        speed = facts["revealed_speed_mps"]
        other = f"one at {speed:.1f} m/s, {facts['closing_mps']:.1f} m/s slower" if speed > 0.0 else "one that stands"
        return f"at {facts['lateral_speed_mps']:.1f} m/s sideways, and reveals {other}"

    def facts_of(self, traffic: FollowingTraffic, events: RecordArray, speed_mps: FloatArray) -> dict[str, FloatArray]:
        clear_m, visible_m = (float(traffic.numbers[name]) for name in ("clear_m", "visible_from_m"))
        lateral = events["lateral_mps"]
        clear = [0 if np.isnan(w) else seen_after(clear_m, w, NEVER) for w in lateral]
        visible = [c - seen_after(visible_m, w, c) if c else 0 for c, w in zip(clear, lateral, strict=True)]
        return {
            "revealed_speed_mps": events["ratio"] * speed_mps,
            "closing_mps": (1.0 - events["ratio"]) * speed_mps,
            "ttc_when_clear_s": events["ttc_s"],
            "lateral_speed_mps": events["lateral_mps"],
            "visible_s": STEP_S * np.array(visible, np.float64),
        }


CUT_OUT = CutOut()
