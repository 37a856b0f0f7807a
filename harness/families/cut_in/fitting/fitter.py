"""The fit of cut-ins to trajectories: all laws, the environment that they make, replicates of it, and a page.

A replicate is what other trajectories of the same kind would have given: clusters (recordings, or vehicles where there
are few) are drawn with replacement, and each law moves by the influence of those drawn more or less often than once
(one-step bootstrap: θ + Σ (w_c - 1) influence_c). With few clusters, moves are widened to those of Student's t. Lane
changes in front of a vehicle that closes in are counts: accepted shares are drawn as gamma(k + 1/2) over exposure.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np
import pyarrow as pa

from harness.campaign.models import Places, read_model, validated
from harness.campaign.sections import EnvironmentSettings
from harness.campaign.yaml_text import yaml_text
from harness.errors import CampaignError, TrajectoryError
from harness.families.cut_in.family import CUT_IN, EXPOSURE
from harness.families.cut_in.fitting.hazard import FREE_TTC_S, TTC_EDGES_S, Acceptance, fit_hazard
from harness.families.cut_in.fitting.laws import BASE, LAWS, FittedLaw, ObservedTraffic, fit_rate
from harness.families.cut_in.fitting.observations import BesideCounts, Observations, observe, require_enough
from harness.families.cut_in.fitting.page import CONFIDENCE, Fit, page
from harness.families.cut_in.loading import load_environment, require_sound_laws
from harness.families.cut_in.parameters import SHIPPED_FOLDER, EnvironmentParameters
from harness.families.cut_in.sections import HAZARD_OF, REPLACED
from harness.files import content_hash
from harness.fitting.files import OF_YAML, environment_text
from harness.fitting.protocol import FitRequest, Fitted
from harness.fitting.recording import Recording
from harness.fitting.table import places
from harness.progress import Progress
from harness.records.folder import parquet
from harness.records.reader import OF_REPLICATES
from harness.report.rows import too_few
from harness.vocabulary import FloatArray

OF_PAGE = b"Traffic fitted to trajectories"
HEAVIEST_TAILS = (None, 5.0, 8.0, 12.0, 30.0, 100.0)
"""Degrees of freedom of R1dot: fitted (None), then tried until LV's speed is one that SUMO's lanes allow."""
DIGITS = 6
MOST_NOISE_MPS2 = 0.05
"""Noise of accelerations above which the user is warned [assumed]; they scatter by some 0.25 m/s²."""
MOST_DRAWS = 5
"""At most this many times the replicates asked for are drawn, as tests cannot be drawn from some."""


def fit_traffic(traffic: ObservedTraffic, where: str, progress: Progress) -> Fit:
    """Fit all laws; ``where`` names the files.

    Raises `TrajectoryError`: no hazard can be fitted, or tests cannot be drawn from the laws.
    """
    base = read_model(SHIPPED_FOLDER / f"{BASE}.yaml", EnvironmentParameters)
    numbers = base.values()
    progress.stage("fitting laws", len(LAWS) + 1)
    if (hazard := fit_hazard(traffic)) is None:
        words = f"too few lane changes without a vehicle that closes in within {FREE_TTC_S:g} s to fit their hazard"
        raise TrajectoryError(where, words, "20 or more", "Add recordings.")
    fitted = {}
    for name, (law_of, _) in LAWS.items():
        progress.advance(1)
        fitted[name] = law_of(traffic, numbers)
    progress.advance(1)
    acceptance = Acceptance.of(traffic, hazard)
    why = "too few data, or the law does not fit them"
    for df in HEAVIEST_TAILS:
        if df is not None:
            fitted["rate"] = fit_rate(traffic, numbers | {"initial_state__r1dot_df": df}, kept="r1dot_df")
        laws = {name: law for name, law in fitted.items() if law is not None} | {"hazard": hazard.law}
        try:
            environment = _environment(base, laws, hazard.knots, acceptance, where)
            require_sound_laws(load_environment(EnvironmentSettings(), environment), where)
        except CampaignError as error:
            problem = error
            continue
        kept = {LAWS[name][1]: why for name, law in fitted.items() if law is None}
        if df is not None:
            kept["degrees of freedom of R1dot"] = f"{df:g}: with heavier tails LV would exceed 100 m/s"
        return Fit(traffic, base, laws, kept, hazard, acceptance, environment)
    words = f"laws that tests cannot be drawn from, unlike those of motorways: {problem.where}, {problem.found}"
    refused = TrajectoryError(where, words, problem.expected, "See docs/fit.md.")
    why = "It follows from the data: see docs/fit.md."  # no file to correct
    refused.problems = tuple(TrajectoryError(each.where, each.found, each.expected, why) for each in problem.problems)
    raise refused


def _rounded(value: float) -> float:
    return float(f"{value:.{DIGITS}g}")


def _environment(
    base: EnvironmentParameters,
    laws: dict[str, FittedLaw],
    knots: Sequence[FloatArray],
    acceptance: Acceptance,
    where: str,
) -> EnvironmentParameters:
    """The base with fitted numbers, and with tables in place of the formulas that they replace."""
    content: dict[str, Any] = base.model_dump(exclude_none=True)
    for names in REPLACED.values():
        for name in names:
            content["cut_in"].pop(name, None)
    tables: dict[str, Any] = {"hazard_table": {}, "acceptance_steps": {}}
    for name, axis_knots in zip(HAZARD_OF, knots, strict=True):
        tables["hazard_table"][name] = [{"value": knot, "source": "derived"} for knot in axis_knots.tolist()]
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
    counted = {"events": acceptance.events.tolist(), "exposure": list(map(_rounded, acceptance.exposure.tolist()))}
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
        draws = _draw(fit, n, random)
        for row in zip(*draws.values(), strict=True):
            if CUT_IN.traffic_with(settings, fit.environment, dict(zip(draws, row, strict=True))) is None:
                continue
            good.append(row)
            progress.advance(1)
            if len(good) == n:
                return dict(zip(draws, np.array(good).T, strict=True))
    found = f"{len(good)} of {MOST_DRAWS * n} replicates that tests can be drawn from"
    raise TrajectoryError("replicates", found, f"{n}", "Add recordings, or ask for fewer --replicates.")


def _draw(fit: Fit, n: int, random: np.random.Generator) -> dict[str, list[float]]:
    """Numbers of n replicates (n,) by name; from some of them tests cannot be drawn."""
    n_clusters = int(fit.traffic.cluster.max()) + 1
    times = random.multinomial(n_clusters, np.full(n_clusters, 1.0 / n_clusters), n) - 1.0
    times *= np.sqrt(n_clusters / random.chisquare(max(n_clusters - 1, 1), n))[:, None]
    draws: dict[str, list[float]] = {}
    for name, law in fit.laws.items():
        theta, noise = law.maximum.theta, law.maximum.noise
        coefficients = theta + times @ law.maximum.influence + random.standard_normal((n, noise.shape[1])) @ noise.T
        values = law.values(coefficients)
        draws |= {key: values[:, i].tolist() for i, key in enumerate(law.names) if law.std_error[key] > 0.0}
        if name == "hazard":
            shares = fit.acceptance.drawn(coefficients, random)
            draws |= {f"acceptance_steps__share__{j}": shares[:, j].tolist() for j in range(TTC_EDGES_S.size)}
    return draws


# -- what is written --


class CutInFitter:
    """See `harness.fitting.protocol.Fitter`."""

    def __init__(self) -> None:
        self._seen = list[Observations]()

    def marks(self, out: Path) -> dict[Path, bytes]:
        replicated = out.with_name(f"{out.stem}.replicates.parquet")
        return {out: OF_YAML, out.with_suffix(".html"): OF_PAGE, replicated: OF_REPLICATES}

    def observe(self, recording: Recording) -> None:
        self._seen.append(observe(recording))

    def fitted(self, request: FitRequest, others: Mapping[str, Fitted]) -> Fitted:
        where = places(request.files)
        tally = require_enough(self._seen, where, request.read)
        fit = fit_traffic(ObservedTraffic.of(self._seen), where, request.progress)
        rows = replicates(fit, request.n_replicates, request.seed, request.progress)
        noise_mps2 = math.sqrt(math.fsum(each.noise_mps2**2 for each in self._seen) / len(self._seen))
        out, html, replicates_file = self.marks(request.out)
        table = parquet(pa.table(rows, metadata={OF_REPLICATES: fit.environment.content_hash()}))
        reference = {"replicates": {"file": replicates_file.name, "sha256": content_hash(table)}}
        text = f"{_text(fit, tally, request)}\n{yaml_text(reference)}"
        lines = [line for each in others.values() for line in each.told]
        text_of_page = page(fit, tally, noise_mps2, request, lines)
        files = {out: text.encode(), html: text_of_page.encode(), replicates_file: table}
        return Fitted(files, _told(fit, tally, request, noise_mps2), _facts(fit, tally))


def _text(fit: Fit, tally: BesideCounts, request: FitRequest) -> str:
    clusters = "recording" if fit.traffic.by_recording else "vehicle, as recordings are few"
    head = [
        f"{fit.traffic.n_recordings} recordings: "
        f"{tally.vehicles:,} vehicles, {tally.driven_s / 3600.0:.2f} h beside the target lane,",
        f"{tally.used} lane changes to it. Standard errors (se) and replicates are by {clusters}.",
        f"Numbers that are not fitted are those of {BASE}. Use lane_change_level 1 with this traffic.",
        *request.provenance(),
    ]
    return environment_text(head, fit.environment.model_dump(exclude_defaults=True))


def _told(fit: Fit, tally: BesideCounts, request: FitRequest, noise_mps2: float) -> tuple[str, ...]:
    traffic, steps, unseen = fit.traffic, fit.acceptance, fit.environment.unseen
    side = "left" if request.read.mirror else "right"
    noisy = f"! noise of {noise_mps2:.2g} m/s² in accelerations: the scatter of the fitted ones is off by as much"
    turned = (
        f"! in {tally.turned} directions of recordings vehicles close in on the other side: are lanes numbered alike?"
    )
    limited = f"! no lane change seen at {unseen}: rates of crashes that begin there have only an upper limit"
    return (
        f"{traffic.n_recordings:,} recording{'s' * (traffic.n_recordings != 1)}, {tally.vehicles:,} vehicles, "
        f"{tally.driven_s / 3600.0:.2f} h beside the target lane; {tally.used:,} lane changes to the {side} used of "
        f"{tally.changes:,}",
        f"in front of a vehicle that closes in within 8 s: {int(steps.events[:-1].sum()):,} lane changes; "
        f"{steps.exposure[:-1].sum():.1f} expected if nobody minded it",
        *(f"kept as in {BASE}: {subject} ({why})" for subject, why in fit.kept.items()),
        f"cut_in: exposure is not fitted: kept is {EXPOSURE.per_hour:g} per hour, counted in other trajectories",
        *([noisy] if noise_mps2 > MOST_NOISE_MPS2 else []),
        *([turned] if tally.turned else []),
        *([limited] if unseen else []),
        *(f"! {words}" for words in too_few(request.n_replicates, CONFIDENCE)),
    )


def _facts(fit: Fit, tally: BesideCounts) -> dict[str, object]:
    steps, traffic = fit.acceptance, fit.traffic
    counted = {"events": steps.events.tolist(), "exposure": steps.exposure.tolist()}
    return {
        "recordings": traffic.n_recordings,
        "vehicles": tally.vehicles,
        "hours": tally.driven_s / 3600.0,
        "lane_changes": tally.used,
        "resampled": "recordings" if traffic.by_recording else "vehicles",
        "acceptance": counted | {"share": steps.shares.tolist()},
        "kept": fit.kept,
    }
