"""Numbers of traffic in which the AV follows a vehicle: where a test begins, and how the vehicle ahead drives."""

from __future__ import annotations

import math
from collections.abc import Mapping
from typing import Annotated, ClassVar, Self

import numpy as np
from pydantic import AfterValidator, Field, model_validator

from harness.campaign.sections import EXPOSURES, Section
from harness.families.numbers import (
    Acceleration,
    DegreesOfFreedom,
    FitRange,
    LogScale,
    Number,
    ParameterFile,
    Speed,
    SpeedsAndGaps,
    in_whole_steps,
    ordered,
    within,
)
from harness.families.protocol import Exposure
from harness.problems import broken_rule
from harness.vocabulary import FloatArray, RecordArray

ROAD_S = 55.0
"""Longest test: the road is 4 km long, and vehicles drive 40 m/s and more."""
ROUNDED = 0.02
"""Relative difference allowed between a rate and events over hours, as both are rounded [assumed]."""
EVENT_DTYPE = np.dtype(
    [
        ("peak_mps2", np.float64),  # how hard the vehicle ahead brakes
        ("held_s", np.float64),  # and how long with that; infinite: until it stands
        ("jerk_mps3", np.float64),
        ("ratio", np.float64),  # speed of the vehicle that is revealed over that of the one ahead, NaN: none is
        ("ttc_s", np.float64),  # to that vehicle, of the one ahead when it has left the lane
        ("lateral_mps", np.float64),  # at which it leaves
    ]
)
"""One event: the vehicle ahead brakes, or leaves the lane."""
NO_EVENT = np.array((0.0, 0.0, np.inf, np.nan, np.nan, np.nan), EVENT_DTYPE)


def grid_of(**laws: tuple[FloatArray, FloatArray]) -> tuple[RecordArray, FloatArray]:
    """Events (E,) and their probabilities, from independent ``laws`` of their fields: values and probabilities each."""
    grid: RecordArray = np.full([values.size for values, _ in laws.values()], NO_EVENT, EVENT_DTYPE)
    share: FloatArray = np.ones(1)
    for axis, (name, (values, probabilities)) in enumerate(laws.items()):
        later_axes = tuple(range(1, len(laws) - axis))
        grid[name] = np.expand_dims(values, later_axes)
        share = share * np.expand_dims(probabilities, later_axes)
    return grid.ravel(), share.ravel()


class LeaderDriving(Section):
    """How the vehicle ahead drives before the event, each second anew."""

    df: DegreesOfFreedom
    location_mps2: Acceleration
    log_scale: LogScale
    log_scale_u: LogScale
    log_scale_uu: LogScale
    lowest_mps2: Acceleration
    highest_mps2: Acceleration

    _range = ordered(("lowest_mps2", "highest_mps2"), equal=False)


class Approach(Section):
    """How the AV comes to the event."""

    duration_s: Annotated[Number, within(1.0, ROAD_S), AfterValidator(in_whole_steps)]
    headway_s: Annotated[Number, within(0.2, 10.0)]
    after_s: Annotated[Number, within(1.0, ROAD_S), AfterValidator(in_whole_steps)]
    set_speed_mps: Speed


class Counted(Section):
    """How many events there are in an hour of driving; ``events`` in ``hours`` if they were counted."""

    per_hour: Annotated[Number, within(*EXPOSURES)]
    events: Annotated[int, Field(ge=1)] | None = None
    hours: Annotated[float, Field(gt=0.0)] | None = None

    @model_validator(mode="after")
    def _rate_is_that_of_the_count(self) -> Self:
        if self.events is None and self.hours is None:
            return self
        rate = (self.events or 0) / (self.hours or math.inf)
        if not math.isclose(rate, self.per_hour.value, rel_tol=ROUNDED):
            found = f"{self.per_hour.value:g}, beside events {self.events} in hours {self.hours}"
            mend = "Correct it, or leave out both if none were counted."
            raise broken_rule("per_hour", found, "events / hours", mend)
        return self


class FollowingParameters(ParameterFile):
    """All numbers of such a family; `grid` gives its events with their probabilities."""

    fit_range: FitRange
    initial_state: SpeedsAndGaps
    free_driving: LeaderDriving
    approach: Approach
    exposure: Counted

    replicates: ClassVar[None] = None
    blocks: ClassVar[Mapping[str, tuple[str, ...]]] = {
        "speed and headway": ("initial_state",),
        "approach": ("approach", "free_driving"),
    }

    @model_validator(mode="after")
    def _fits_the_road(self) -> Self:
        if (seconds := self.approach.duration_s.value + self.approach.after_s.value) > ROAD_S:
            found = f"tests of {seconds:g} s (duration_s and after_s)"
            raise broken_rule("approach", found, f"at most {ROAD_S:g} s: the road is 4 km long", "Shorten one of both.")
        return self

    def grid(self) -> tuple[RecordArray, FloatArray]:
        """Events (E,), `EVENT_DTYPE`, and their probabilities (E,), which sum to 1."""
        raise NotImplementedError

    def counted(self) -> Exposure:
        """Events per hour, whether or not they are in scope."""
        number, events, hours = self.exposure.per_hour, self.exposure.events, self.exposure.hours
        low, high = number.range or (number.value, number.value)
        counted = None if events is None or hours is None else (events, hours)
        return Exposure(number.value, low, high, counted, number.note or number.source)
