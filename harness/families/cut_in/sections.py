"""Sections of an environment file: numbers with their provenance, each within its limits, and tables of them."""

from __future__ import annotations

import math
from collections.abc import Collection, Mapping
from itertools import pairwise
from typing import Annotated, Any

import numpy as np
from pydantic import AfterValidator, BaseModel, Field, model_validator
from scipy.special import gammainc, gammaincinv

from harness.campaign.sections import Section
from harness.families.cut_in.lateral import LateralMotion, log_normal_speed
from harness.families.cut_in.laws import Wish
from harness.families.numbers import (
    Acceleration,
    Braking,
    Coefficient,
    DegreesOfFreedom,
    Gain,
    Gap,
    LogScale,
    Number,
    Rate,
    Scale,
    Share,
    Speed,
    SpeedsAndGaps,
    Time,
    in_whole_steps,
    ordered,
    within,
)
from harness.numbers import plain
from harness.problems import broken_rule
from harness.vocabulary import FloatArray

SMALLEST_SHARE = 1e-12
"""Smallest share of wished lane changes carried out."""
STEP = "acceptance_steps__share__"
ONE_SIDED = 0.95
"""Quantile of a step's share that no replicate has drawn."""
HAZARD_OF = {"v_mps": "v_log", "r1_m": "r1_log", "r1dot_mps": "r1dot_log"}
"""What the hazard of cut-ins depends on, and the names of its effects."""


class Horizon(Section):
    """Horizon of a test."""

    duration_s: Annotated[Number, within(1.0, 25.0), AfterValidator(in_whole_steps)]
    """At most 25 s: BV's free driving has 256 random numbers for each cut-in, and the road is 4 km long."""


class InitialState(SpeedsAndGaps):
    """Distribution of (v_BV, R1, R1dot, R2, R2dot)."""

    r1dot_df: DegreesOfFreedom
    r1dot_location_mps: Coefficient
    r1dot_location_u: Coefficient
    r1dot_location_w: Coefficient
    r1dot_location_uw: Coefficient
    r1dot_location_uu: Coefficient
    r1dot_log_scale: LogScale
    r1dot_log_scale_u: LogScale
    r1dot_log_scale_w: LogScale
    r1dot_log_scale_ww: LogScale
    r1dot_min_ttc_s: Annotated[Number, within(0.1, 100.0)]
    r2_min_m: Annotated[Number, within(0.1, 300.0)]
    r2_max_m: Gap
    r2dot_min_mps: Rate
    r2dot_max_mps: Rate

    _ranges = ordered(("r2_min_m", "r2_max_m"), ("r2dot_min_mps", "r2dot_max_mps"), equal=True)


class FreeDriving(Section):
    """Accelerations of LV, and of BV after its cut-in."""

    df: DegreesOfFreedom
    location_mps2: Acceleration
    log_scale: LogScale
    log_scale_u: LogScale
    log_scale_uu: LogScale
    brake_logit: LogScale
    brake_logit_u: LogScale
    brake_slope_s2pm: LogScale
    brake_max_mps2: Acceleration


class CarFollowing(Section):
    """Accelerations of BV behind LV."""

    gain_rate_per_s: Gain
    gain_gap_per_s2: Gain
    median_gap_m: Coefficient
    median_gap_v: Coefficient
    median_gap_vv: Coefficient
    standstill_m: Gap
    smallest_gap_m: Scale
    closing_threshold_mps2: Gain
    closing_gain: Gain
    near_gap_m: Gap
    near_mean_max_mps2: Acceleration
    df: DegreesOfFreedom
    log_scale: LogScale
    log_scale_rate: LogScale
    rate_cap_mps: Speed


class FollowingGuard(Section):
    """What keeps BV off LV; part of p."""

    lead_braking_mps2: Braking
    own_braking_mps2: Annotated[Number, within(0.1, 20.0)]
    horizon_s: Annotated[Number, within(0.0, 10.0)]
    margin_m: Gap


class CutInLaw(Section):
    """Hazard of the cut-in; coefficients in whose place there is a table are left out (`REPLACED`)."""

    intercept: Coefficient | None = None
    u: Coefficient | None = None
    log_gap: Coefficient | None = None
    rate: Coefficient | None = None
    rate_squared: Coefficient | None = None
    u_squared: Coefficient | None = None
    rate_scale_mps: Scale | None = None
    rate_clamp_mps: Speed | None = None
    ignore_share: Share | None = None
    accept_ttc_s: Time | None = None
    accept_scale_s: Scale | None = None
    max_probability_1s: Annotated[Number, within(1e-6, 0.5)]


_ACCEPTANCE = ("ignore_share", "accept_ttc_s", "accept_scale_s")
REPLACED = {
    "hazard_table": tuple(name for name in CutInLaw.model_fields if name not in (*_ACCEPTANCE, "max_probability_1s")),
    "acceptance_steps": _ACCEPTANCE,
}
"""Coefficients of ``cut_in`` in whose place a table may stand."""


def _rising(knots: list[Number]) -> list[Number]:
    for before, after in pairwise(each.value for each in knots):
        if not before < after:
            raise broken_rule("", f"{after:g} after {before:g}", "numbers that rise", "Sort them, each once.")
    return knots


_LENGTH = Field(min_length=1, max_length=64)
Knots = Annotated[list[Rate], _LENGTH, AfterValidator(_rising)]
Gaps = Annotated[list[Gap], _LENGTH, AfterValidator(_rising)]
LogHazards = Annotated[list[LogScale], _LENGTH]


def _one_each(*pairs: tuple[str, str], beyond: str = "") -> Any:
    """Validator of a section: the lists of each pair are of the same length; the one ``beyond`` has one number more."""

    def checked(self: BaseModel) -> BaseModel:
        for key, other in pairs:
            numbers, length = getattr(self, key), len(getattr(self, other)) + (key == beyond)
            if numbers is not None and len(numbers) != length:
                expected = f"{length}, one for each of {other}" + " and one beyond" * (key == beyond)
                mend = "Add what is missing, or delete what is too much."
                raise broken_rule(key, f"{len(numbers)} numbers", expected, mend)
        return self

    return model_validator(mode="after")(checked)


class HazardTable(Section):
    """Logarithm of the wish to change lanes (per second): three functions, linear between knots, that are added."""

    v_mps: Knots
    v_log: LogHazards
    r1_m: Gaps
    r1_log: LogHazards
    r1dot_mps: Knots
    r1dot_log: LogHazards

    _one_value_per_knot = _one_each(*((logs, knots) for knots, logs in HAZARD_OF.items()))

    def wish(self) -> Wish:
        """As kernels read it."""
        return Wish(*(np.column_stack([_values(getattr(self, name)) for name in axis]) for axis in HAZARD_OF.items()))


class AcceptanceSteps(Section):
    """Share of wished lane changes carried out, by time to collision with the AV: below each of ``ttc_s``, and above.

    ``events`` were seen in each step, and ``exposure`` of them would have been expected if each wish were carried out.
    """

    ttc_s: Annotated[list[Annotated[Number, within(0.01, 100.0)]], _LENGTH, AfterValidator(_rising)]
    share: list[Annotated[Number, within(SMALLEST_SHARE, 1.0)]]
    events: list[Annotated[int, Field(ge=0)]] | None = None
    exposure: list[Annotated[float, Field(ge=0.0)]] | None = None

    _one_share_per_step = _one_each(("share", "ttc_s"), ("events", "share"), ("exposure", "share"), beyond="share")

    def steps(self) -> FloatArray:
        """Upper ends (s) and shares (n, 2), as kernels read them."""
        return np.column_stack([[*_values(self.ttc_s), math.inf], _values(self.share)])

    @property
    def without_events(self) -> list[int]:
        """Steps in which no lane change was seen, though some were counted."""
        return [step for step, events in enumerate(self.events or ()) if not events and self.exposure is not None]

    def without_half(self) -> dict[int, dict[str, float]]:
        """For each step without an event: values with half its share."""
        return {step: {f"{STEP}{step}": 0.5 * self.share[step].value} for step in self.without_events}

    def as_if_unseen(self, row: Mapping[str, float]) -> dict[str, float]:
        """A replicate (or {} for none) whose shares in steps without events are as high as zero events allow.

        Shares of replicates are drawn as gamma(½) over the exposure, which is right in the mean. In their place come
        the same quantiles of gamma(1), the upper limit by zero events; without a draw the `ONE_SIDED` quantile.
        """
        unseen = dict(row)
        for step in self.without_events:
            name, exposure = f"{STEP}{step}", (self.exposure or ())[step]
            below = float(gammainc(0.5, row[name] * exposure)) if name in row else ONE_SIDED
            unseen[name] = min(float(gammaincinv(1.0, below)) / exposure, 1.0) if exposure > 0.0 else 1.0
        return unseen

    def where(self, steps: Collection[int]) -> str:
        """Times to collision of steps in words, neighbouring steps as one: ``TTC < 2 s``, ``TTC 3 to 5 s``."""
        ends = [0.0, *_values(self.ttc_s), math.inf]
        low = [plain(ends[step]) for step in steps if step - 1 not in steps]
        high = [plain(ends[step + 1]) for step in steps if step + 1 not in steps]
        between = (f"TTC {a} to {b} s" if float(a) else f"TTC < {b} s" for a, b in zip(low, high, strict=True))
        return " and ".join(between).replace("to inf s", "s and more")


def _values(numbers: list[Number]) -> list[float]:
    return [each.value for each in numbers]


class Lateral(Section):
    """How long cut-ins show themselves before BV overlaps: by a log-normal lateral speed, and at most the longest."""

    distance_m: Annotated[Number, within(0.1, 5.0)]
    speed_median_mps: Annotated[Number, within(0.05, 20.0)]
    speed_log_sd: Annotated[Number, within(0.01, 3.0)]
    longest_lead_s: Annotated[Number, within(0.1, 10.0), AfterValidator(in_whole_steps)]

    def motion(self) -> LateralMotion:
        """As kernels read it."""
        median, log_sd, longest = self.speed_median_mps, self.speed_log_sd, self.longest_lead_s
        return log_normal_speed(self.distance_m.value, median.value, log_sd.value, longest.value)


class Replicates(Section):
    """Which environments other data of the same kind would have given: a file beside this one, and its hash."""

    file: Annotated[str, Field(pattern=r"^[^\x00-\x1f]+$", examples=["mine.replicates.parquet"])]
    sha256: str
