"""Traffic fitted to trajectories: all laws, and the environment that they make."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import numpy as np

from harness.campaign.files import Places, validated
from harness.campaign.sections import EnvironmentSettings
from harness.errors import CampaignError, TrajectoryError
from harness.families.cut_in.loading import load_environment, require_sound_laws
from harness.families.cut_in.parameters import REPLACED, EnvironmentParameters
from harness.fitting.laws import (
    FREE_TTC_S,
    TTC_EDGES_S,
    Acceptance,
    Base,
    FittedLaw,
    Knots,
    Traffic,
    fit_car_following,
    fit_free_driving,
    fit_gap,
    fit_hazard,
    fit_leads,
    fit_rate,
    fit_speed,
    hazard_design,
)
from harness.progress import Progress
from harness.vocabulary import FloatArray

HEAVIEST_TAILS = (None, 5.0, 8.0, 12.0, 30.0, 100.0)
"""Degrees of freedom of R1dot: fitted (None), then tried until LV's speed is one that SUMO's lanes allow."""
DIGITS = 6
_LAWS: dict[str, tuple[Callable[[Traffic, Base], FittedLaw | None], str]] = {
    "speed": (fit_speed, "speeds of BV"),
    "gap": (fit_gap, "gaps to LV"),
    "rate": (fit_rate, "speed differences to LV"),
    "free driving": (fit_free_driving, "accelerations in free driving"),
    "car following": (fit_car_following, "accelerations behind a leader"),
    "lead": (fit_leads, "leads of lane changes"),
}
"""Laws that may be kept from the base."""


@dataclass(frozen=True, eq=False)
class Fit:
    """Fitted traffic.

    Attributes
    ----------
    base : EnvironmentParameters
        Environment from which numbers are kept that are not fitted; ``base_name`` is its name.
    laws : dict of str to FittedLaw
        Fitted laws, the hazard among them.
    kept : dict of str to str
        Why a law is kept from the base, by its subject.
    knots : Knots
        Of the hazard.
    acceptance : Acceptance
        Lane changes by time to collision.
    environment : EnvironmentParameters
        The result.
    """

    traffic: Traffic
    base: EnvironmentParameters
    base_name: str
    laws: dict[str, FittedLaw]
    kept: dict[str, str]
    knots: Knots
    acceptance: Acceptance
    environment: EnvironmentParameters

    def hazard_at(self, rows: Any) -> FloatArray:
        """Rate (1/s) of lane changes with nobody closing in, by state (n,)."""
        return np.exp(hazard_design(self.knots, rows) @ self.laws["hazard"].maximum.theta)


def fit_traffic(traffic: Traffic, base: EnvironmentParameters, base_name: str, where: str, progress: Progress) -> Fit:
    """Fit all laws.

    Raises `TrajectoryError`: no hazard can be fitted, or tests cannot be drawn from the laws; ``where`` names the
    files.
    """
    numbers = base.values()
    settings = EnvironmentSettings()
    progress.stage("fitting laws", len(_LAWS) + 1)
    if (hazard := fit_hazard(traffic)) is None:
        found_words = (
            f"too few lane changes without a vehicle that closes in within {FREE_TTC_S:g} s to fit their hazard"
        )
        raise TrajectoryError(where, found_words, "20 or more", "Add recordings.")
    found = {}
    for name, (law_of, _) in _LAWS.items():
        progress.advance(1)
        found[name] = law_of(traffic, numbers)
    progress.advance(1)
    acceptance = Acceptance.of(traffic, *hazard)
    for df in HEAVIEST_TAILS:
        if df is not None:
            found["rate"] = fit_rate(traffic, numbers, df)
        laws = {name: law for name, law in found.items() if law is not None} | {"hazard": hazard[0]}
        try:
            environment = _environment(base, laws, hazard[1], acceptance, where)
            require_sound_laws(load_environment(settings, environment), where)
        except CampaignError as error:
            problem = error
            continue
        why = "too few data, or the law does not fit them"
        kept = {_LAWS[name][1]: why for name, law in found.items() if law is None}
        if df is not None:
            kept["degrees of freedom of R1dot"] = f"{df:g}: with heavier tails LV would exceed 100 m/s"
        return Fit(traffic, base, base_name, laws, kept, hazard[1], acceptance, environment)
    mend = f"The data do not look like motorway traffic; see docs/fit.md. {problem.mend}"
    raise TrajectoryError(
        where, f"laws that tests cannot be drawn from: {problem.where}, {problem.found}", problem.expected, mend
    )


def _rounded(value: float) -> float:
    return float(f"{value:.{DIGITS}g}")


def _environment(
    base: EnvironmentParameters, laws: dict[str, FittedLaw], knots: Knots, acceptance: Acceptance, where: str
) -> EnvironmentParameters:
    """The base with fitted numbers, and with tables in place of the formulas that they replace."""
    content: dict[str, Any] = base.model_dump(exclude_none=True)
    for names in REPLACED.values():
        for name in names:
            content["cut_in"].pop(name, None)
    tables: dict[str, Any] = {"hazard_table": {}, "acceptance_steps": {}}
    for name, at in zip(("v_mps", "r1_m", "r1dot_mps"), knots, strict=True):
        tables["hazard_table"][name] = [{"value": knot, "source": "derived"} for knot in at.tolist()]
    for law in laws.values():
        for path, value in law.estimate.items():
            section, key, *place = path.split("__")
            se = law.std_error[path]
            number = {"value": _rounded(value), "source": "fitted", "se": _rounded(se)}
            if place and se == 0.0:  # the knot that effects are relative to
                number = {"value": 0.0, "source": "derived"}
            if place:
                tables[section].setdefault(key, []).append(number)
            elif se > 0.0:
                content[section][key] = number
            elif number["value"] != _rounded(content[section][key]["value"]):
                content[section][key] = {"value": number["value"], "source": "assumed"}  # R1dot's tails
    if "lead" in laws:
        content["lateral"]["longest_lead_s"].pop("note", None)  # it is about the share that the base cuts off
    edges = [{"value": edge, "source": "assumed"} for edge in TTC_EDGES_S.tolist()]
    shares = zip(acceptance.shares.tolist(), acceptance.std_errors.tolist(), strict=True)
    steps = [{"value": _rounded(share), "source": "fitted", "se": _rounded(se)} for share, se in shares]
    steps[-1] = {"value": 1.0, "source": "assumed", "note": "the hazard is fitted where nobody closes in"}
    exposure = [_rounded(each) for each in acceptance.exposure.tolist()]
    counted = {"events": acceptance.events.tolist(), "exposure": exposure}
    tables["acceptance_steps"] = {"ttc_s": edges, "share": steps, **counted}
    return validated({**content, **tables}, EnvironmentParameters, Places(where, {}))
