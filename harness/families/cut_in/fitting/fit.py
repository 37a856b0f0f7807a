"""Traffic fitted to trajectories: all laws, the environment that they make, and replicates of it.

A replicate is what other trajectories of the same kind would have given: clusters (recordings, or vehicles where there
are few) are drawn with replacement, and each law moves by the influence of those drawn more or less often than once
(one-step bootstrap: θ + Σ (w_c - 1) influence_c). With few clusters, moves are widened to those of Student's t. Lane
changes in front of a vehicle that closes in are counts: accepted shares are drawn as gamma(k + 1/2) over exposure.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from harness.campaign.models import Places, validated
from harness.campaign.sections import EnvironmentSettings
from harness.errors import CampaignError, TrajectoryError
from harness.families.cut_in.family import CUT_IN
from harness.families.cut_in.fitting.hazard import FREE_TTC_S, TTC_EDGES_S, Acceptance, Hazard, fit_hazard
from harness.families.cut_in.fitting.laws import LAWS, FittedLaw, ObservedTraffic, fit_rate
from harness.families.cut_in.loading import load_environment, require_sound_laws
from harness.families.cut_in.parameters import EnvironmentParameters
from harness.families.cut_in.sections import HAZARD_OF, REPLACED
from harness.progress import Progress
from harness.vocabulary import FloatArray

HEAVIEST_TAILS = (None, 5.0, 8.0, 12.0, 30.0, 100.0)
"""Degrees of freedom of R1dot: fitted (None), then tried until LV's speed is one that SUMO's lanes allow."""
DIGITS = 6
MOST_DRAWS = 5
"""At most this many times the replicates asked for are drawn, as tests cannot be drawn from some."""


@dataclass(frozen=True, eq=False)
class Fit:
    """Fitted traffic: ``environment`` is the result, ``laws`` has the hazard's, too.

    Numbers that are not fitted are those of ``base``, an environment called ``base_name``; ``kept`` says why a law is
    kept from it, by its subject.
    """

    traffic: ObservedTraffic
    base: EnvironmentParameters
    base_name: str
    laws: dict[str, FittedLaw]
    kept: dict[str, str]
    hazard: Hazard
    acceptance: Acceptance
    environment: EnvironmentParameters


def fit_traffic(
    traffic: ObservedTraffic, base: EnvironmentParameters, base_name: str, where: str, progress: Progress
) -> Fit:
    """Fit all laws.

    Raises `TrajectoryError`: no hazard can be fitted, or tests cannot be drawn from the laws; ``where`` names the
    files.
    """
    numbers = base.values()
    progress.stage("fitting laws", len(LAWS) + 1)
    if (hazard := fit_hazard(traffic)) is None:
        words = f"too few lane changes without a vehicle that closes in within {FREE_TTC_S:g} s to fit their hazard"
        raise TrajectoryError(where, words, "20 or more", "Add recordings.")
    found = {}
    for name, (law_of, _) in LAWS.items():
        progress.advance(1)
        found[name] = law_of(traffic, numbers)
    progress.advance(1)
    acceptance = Acceptance.of(traffic, hazard)
    why = "too few data, or the law does not fit them"
    for df in HEAVIEST_TAILS:
        if df is not None:
            found["rate"] = fit_rate(traffic, numbers | {"initial_state__r1dot_df": df}, kept="r1dot_df")
        laws = {name: law for name, law in found.items() if law is not None} | {"hazard": hazard.law}
        try:
            environment = _environment(base, laws, hazard.knots, acceptance, where)
            require_sound_laws(load_environment(EnvironmentSettings(), environment), where)
        except CampaignError as error:
            problem = error
            continue
        kept = {LAWS[name][1]: why for name, law in found.items() if law is None}
        if df is not None:
            kept["degrees of freedom of R1dot"] = f"{df:g}: with heavier tails LV would exceed 100 m/s"
        return Fit(traffic, base, base_name, laws, kept, hazard, acceptance, environment)
    words = f"laws that tests cannot be drawn from: {problem.where}, {problem.found}"
    mend = f"The data do not look like motorway traffic; see docs/fit.md. {problem.mend}"
    raise TrajectoryError(where, words, problem.expected, mend)


def _rounded(value: float) -> float:
    return float(f"{value:.{DIGITS}g}")


def _environment(
    base: EnvironmentParameters, laws: dict[str, FittedLaw], knots: Sequence[FloatArray], seen: Acceptance, where: str
) -> EnvironmentParameters:
    """The base with fitted numbers, and with tables in place of the formulas that they replace."""
    content: dict[str, Any] = base.model_dump(exclude_none=True)
    for names in REPLACED.values():
        for name in names:
            content["cut_in"].pop(name, None)
    tables: dict[str, Any] = {"hazard_table": {}, "acceptance_steps": {}}
    for name, at in zip(HAZARD_OF, knots, strict=True):
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
    shares = zip(seen.shares.tolist(), seen.std_errors.tolist(), strict=True)
    steps = [{"value": _rounded(share), "source": "fitted", "se": _rounded(se)} for share, se in shares]
    steps[-1] = {"value": 1.0, "source": "assumed", "note": "the hazard is fitted where nobody closes in"}
    counted = {"events": seen.events.tolist(), "exposure": list(map(_rounded, seen.exposure.tolist()))}
    tables["acceptance_steps"] = {"ttc_s": edges, "share": steps, **counted}
    return validated({**content, **tables}, EnvironmentParameters, Places(where, {}))


def replicates(fit: Fit, n: int, seed: int, progress: Progress) -> dict[str, FloatArray]:
    """Numbers that vary, by their flat names, in n replicates (n,) from which tests can be drawn.

    Raises `TrajectoryError`: there are too few of these.
    """
    random = np.random.default_rng(seed)
    settings, good = EnvironmentSettings(), []
    progress.stage("replicates", n)
    for _ in range(MOST_DRAWS):
        drawn = _draw(fit, n, random)
        for row in zip(*drawn.values(), strict=True):
            if CUT_IN.traffic_with(settings, fit.environment, dict(zip(drawn, row, strict=True))) is None:
                continue
            good.append(row)
            progress.advance(1)
            if len(good) == n:
                return dict(zip(drawn, np.array(good).T, strict=True))
    found = f"{len(good)} of {MOST_DRAWS * n} replicates that tests can be drawn from"
    raise TrajectoryError("replicates", found, f"{n}", "Add recordings, or ask for fewer --replicates.")


def _draw(fit: Fit, n: int, random: np.random.Generator) -> dict[str, list[float]]:
    """Rows, by the names of their numbers, some of which tests cannot be drawn from."""
    n_clusters = int(fit.traffic.cluster.max()) + 1
    times = random.multinomial(n_clusters, np.full(n_clusters, 1.0 / n_clusters), n) - 1.0
    times *= np.sqrt(n_clusters / random.chisquare(max(n_clusters - 1, 1), n))[:, None]
    drawn: dict[str, list[float]] = {}
    for name, law in fit.laws.items():
        theta, noise = law.maximum.theta, law.maximum.noise
        moved = theta + times @ law.maximum.influence + random.standard_normal((n, noise.shape[1])) @ noise.T
        values = law.values(moved)
        drawn |= {key: values[:, i].tolist() for i, key in enumerate(law.names) if law.std_error[key] > 0.0}
        if name == "hazard":
            shares = fit.acceptance.drawn(moved, random)
            drawn |= {f"acceptance_steps__share__{j}": shares[:, j].tolist() for j in range(TTC_EDGES_S.size)}
    return drawn
