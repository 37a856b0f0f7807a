"""The numbers of the naturalistic driving environment, each with its provenance, from a schema-validated file."""

from __future__ import annotations

import math
from collections.abc import Mapping
from pathlib import Path
from typing import ClassVar, Literal, Self

import numpy as np
from pydantic import model_validator

from harness.campaign.drivers import MAX_CONFIGURED_SPEED_MPS
from harness.families.cut_in import sections
from harness.families.cut_in.sections import REPLACED, SMALLEST_SHARE, STEP
from harness.families.numbers import FitRange, LeftOpen, ParameterFile
from harness.problems import broken_rule
from harness.vehicles.kinematics import STEP_S, VEHICLE_LENGTH_M
from harness.vocabulary import Record

SHIPPED_FOLDER, DEFAULT = Path(__file__).parent, "ndd-overtaking-2"
FIXED = {"step_s": STEP_S, "vehicle_length_m": VEHICLE_LENGTH_M}
"""What the compiled motion and SUMO's network are made for: no file can change it, but campaigns' hashes contain it."""
NOT_LOOKING = "cut_in__ignore_share"
_NOT_IN_RECORD = ("lateral__", "hazard_table__", "acceptance_steps__")


class EnvironmentParameters(ParameterFile):
    """All numbers of the environment."""

    format: Literal["ndd-overtaking"]
    version: Literal[1]
    scenario: sections.Horizon
    fit_range: FitRange
    initial_state: sections.InitialState
    free_driving: sections.FreeDriving
    car_following: sections.CarFollowing
    guard: sections.FollowingGuard
    cut_in: sections.CutInLaw
    hazard_table: sections.HazardTable | None = None
    acceptance_steps: sections.AcceptanceSteps | None = None
    lateral: sections.Lateral | None = None
    replicates: sections.Replicates | None = None  # type: ignore[misc] # others have none

    @model_validator(mode="after")
    def _one_law_each(self) -> Self:
        """Wish and acceptance have a formula or a table."""
        for table, names in REPLACED.items():
            absent = getattr(self, table) is None
            wrong = [name for name in names if (getattr(self.cut_in, name) is None) == absent]
            if wrong and absent:
                expected = f"all coefficients of the formula, or a section {table}"
                raise broken_rule("cut_in", f"neither {', '.join(wrong)} nor {table}", expected, "Add what is missing.")
            if wrong:
                found = f"{', '.join(wrong)} besides the section {table}"
                raise broken_rule("cut_in", found, "one of both: the table takes their place", "Delete one of both.")
        return self

    @model_validator(mode="after")
    def _av_has_a_speed(self) -> Self:
        """It starts at v_BV - R2dot."""
        slowest = self.fit_range.v_min_mps.value - self.initial_state.r2dot_max_mps.value
        fastest = self.fit_range.v_max_mps.value - self.initial_state.r2dot_min_mps.value
        if slowest < 0.0 or fastest > MAX_CONFIGURED_SPEED_MPS:
            found = f"speeds of the AV (v_BV - R2dot) from {slowest:g} to {fastest:g} m/s"
            mend = "Narrow r2dot_min_mps and r2dot_max_mps, or v_min_mps and v_max_mps of fit_range."
            raise broken_rule("initial_state", found, f"speeds from 0 to {MAX_CONFIGURED_SPEED_MPS:g} m/s", mend)
        return self

    folder: ClassVar[Path] = SHIPPED_FOLDER
    blocks: ClassVar[Mapping[str, tuple[str, ...]]] = {
        "initial state": ("initial_state",),
        "free driving": ("free_driving",),
        "car following": ("car_following", "guard"),
        "cut-in": ("cut_in", "hazard_table", "acceptance_steps"),
        "lead of cut-ins": ("lateral",),
    }

    @property
    def kinds(self) -> sections.AcceptanceSteps | None:
        return self.acceptance_steps

    def left_open(self) -> LeftOpen | None:
        """The stated range of the share of drivers who do not look, or shares of lane changes where none was seen."""
        share, steps = self.cut_in.ignore_share, self.acceptance_steps
        if share is not None and share.range is not None:
            low, high = share.range
            return LeftOpen("", ({NOT_LOOKING: low}, {NOT_LOOKING: high}), share.value, high)
        if steps is not None and steps.without_events:
            least = {f"{STEP}{step}": SMALLEST_SHARE for step in steps.without_events}
            return LeftOpen(self.unseen, (least, steps.as_if_unseen({})))
        return None

    def values(self) -> dict[str, float]:
        """The same without provenance; what is fixed is among them."""
        return {**{f"scenario__{name}": value for name, value in FIXED.items()}, **super().values()}


def parameter_record(parameters: EnvironmentParameters, *, lane_change_level: float, hold_s: float) -> Record:
    """The numbers as kernels read them: ``section__name``, lane-changing ``level``, ``hold_steps``, ``max_steps``.

    Coefficients in whose place there is a table are no numbers: records of all environments are of one type.
    """
    absent = {f"cut_in__{name}": math.nan for names in REPLACED.values() for name in names}
    values = {**absent, **parameters.values(), "level": lane_change_level}
    numbers = {name: value for name, value in values.items() if not name.startswith(_NOT_IN_RECORD)}
    steps = {"hold_steps": round(hold_s / STEP_S), "max_steps": round(numbers["scenario__duration_s"] / STEP_S)}
    dtype = [*((name, "f8") for name in numbers), *((name, "i8") for name in steps)]
    record: Record = np.array([(*numbers.values(), *steps.values())], dtype)[0]
    return record
