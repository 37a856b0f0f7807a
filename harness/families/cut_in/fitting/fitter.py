"""The fit of cut-ins to trajectories: an environment file, replicates of it, and a page."""

from __future__ import annotations

import math
from collections.abc import Mapping
from pathlib import Path

import pyarrow as pa

from harness.campaign.models import read_model
from harness.campaign.yaml_text import yaml_text
from harness.families.cut_in.fitting.fit import Fit, fit_traffic, replicates
from harness.families.cut_in.fitting.laws import ObservedTraffic
from harness.families.cut_in.fitting.observations import BesideCounts, Observations, observe, require_enough
from harness.families.cut_in.fitting.page import CONFIDENCE, page
from harness.families.cut_in.parameters import SHIPPED_FOLDER, EnvironmentParameters
from harness.files import content_hash
from harness.fitting.files import OF_YAML, environment_text
from harness.fitting.protocol import Asked, Fitted
from harness.fitting.recording import Recording
from harness.fitting.table import places
from harness.records.folder import parquet
from harness.records.replicates import OF_REPLICATES
from harness.report.rows import too_few

OF_PAGE = b"Traffic fitted to trajectories"
BASE = "ndd-overtaking-2"
"""Numbers that are not fitted are taken from it."""


class CutInFitter:
    """See `harness.fitting.protocol.Fitter`."""

    def __init__(self) -> None:
        self._base = read_model(SHIPPED_FOLDER / f"{BASE}.yaml", EnvironmentParameters)
        self._seen = list[Observations]()

    def marks(self, out: Path) -> dict[Path, bytes]:
        replicated = out.with_name(f"{out.stem}.replicates.parquet")
        return {out: OF_YAML, out.with_suffix(".html"): OF_PAGE, replicated: OF_REPLICATES}

    def observe(self, recording: Recording) -> None:
        self._seen.append(observe(recording))

    def fitted(self, asked: Asked, others: Mapping[str, Fitted]) -> Fitted:
        where = places(asked.files)
        tally = require_enough(self._seen, where, asked.read)
        fit = fit_traffic(ObservedTraffic.of(self._seen), self._base, BASE, where, asked.progress)
        rows = replicates(fit, asked.n_replicates, asked.seed, asked.progress)
        noise_mps2 = math.sqrt(math.fsum(each.noise_mps2**2 for each in self._seen) / len(self._seen))
        out, shown, beside = self.marks(asked.out)
        drawn = parquet(pa.table(rows, metadata={OF_REPLICATES: fit.environment.content_hash()}))
        tied = {"replicates": {"file": beside.name, "sha256": content_hash(drawn)}}
        text = f"{_text(fit, tally, asked)}\n{yaml_text(tied)}"
        told = [line for each in others.values() for line in each.told]
        shows = page(fit, tally, noise_mps2, asked, told)
        files = {out: text.encode(), shown: shows.encode(), beside: drawn}
        return Fitted(files, _told(fit, tally, asked.n_replicates), _facts(fit, tally))


def _text(fit: Fit, tally: BesideCounts, asked: Asked) -> str:
    clusters = "recording" if fit.traffic.by_recording else "vehicle, as recordings are few"
    head = [
        f"{fit.traffic.n_recordings} recordings: "
        f"{tally.vehicles:,} vehicles, {tally.driven_s / 3600.0:.2f} h beside the target lane,",
        f"{tally.used} lane changes to it. Standard errors (se) and replicates are by {clusters}.",
        f"Numbers that are not fitted are those of {fit.base_name}. Use lane_change_level 1 with this traffic.",
        *asked.provenance(),
    ]
    return environment_text(head, fit.environment.model_dump(exclude_defaults=True))


def _told(fit: Fit, tally: BesideCounts, n_replicates: int) -> tuple[str, ...]:
    traffic, steps, unseen = fit.traffic, fit.acceptance, fit.environment.unseen
    limited = f"! no lane change seen at {unseen}: rates of crashes that begin there have only an upper limit"
    return (
        f"{traffic.n_recordings:,} recordings, {tally.vehicles:,} vehicles, {tally.driven_s / 3600.0:.2f} h beside the "
        f"target lane; {tally.used:,} lane changes used of {tally.changes:,}",
        f"in front of a vehicle that closes in within 8 s: {int(steps.events[:-1].sum()):,} lane changes; "
        f"{steps.exposure[:-1].sum():.1f} expected if nobody minded it",
        *(f"kept as in {fit.base_name}: {what} ({why})" for what, why in fit.kept.items()),
        *([limited] if unseen else []),
        *(f"! {words}" for words in too_few(n_replicates, CONFIDENCE)),
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
