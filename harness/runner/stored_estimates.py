"""Estimate a run from the records in its folder."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import Any

from harness.campaign.loading import load_campaign
from harness.estimators import ESTIMATORS, CampaignFacts, estimate_blocks
from harness.estimators.threads import read_ahead
from harness.importance.build import importance_names
from harness.methods import EstimatorName
from harness.records.folder import read_manifest
from harness.records.reader import stored_columns
from harness.runner.stored_blocks import stored_blocks
from harness.runner.surrogates import MOST_UNASKED, surrogates_of


def estimate_run(
    folder: Path,
    *,
    estimators: Sequence[EstimatorName] | None = None,
    confidence: float | None = None,
    pool: Path | None = None,
) -> dict[str, Any]:
    """Estimate a stored run from its records.

    Parameters
    ----------
    folder : Path
        Run folder with ``manifest.json``, ``campaign.yaml`` and shards.
    estimators : sequence of str, optional
        Which to report beside the method's own; all by default.
    confidence : float, optional
        Level of the intervals; the campaign's by default.
    pool : Path, optional
        File of a pool whose surrogates are asked about every test, for the alarm. By default the campaign's own, if it
        has been built, about the first `MOST_UNASKED` tests.

    Returns
    -------
    dict
        Content of ``estimates.json``.

    Raises
    ------
    HarnessError
        If the folder is not a run, its records are damaged or incomplete, or the pool is of another environment.
    """
    folder = Path(folder)
    manifest = read_manifest(folder)
    campaign = load_campaign(folder / "campaign.yaml", check_files=False)
    distance = manifest.get("distance_per_test_m")
    surrogates = surrogates_of(campaign, stored_columns(folder), pool)
    facts = CampaignFacts(
        name=campaign.name,
        content_hash=str(manifest["campaign_hash"]),
        lane_change_level=campaign.environment.lane_change_level,
        confidence=campaign.stop.confidence if confidence is None else confidence,
        distance_per_test_m=None if distance is None else float(distance),
        importance_names=importance_names(campaign),
        retraced=manifest.get("retraced"),
        repeated=manifest.get("repeated"),
        ending=manifest.get("ending"),
        no_surrogates=surrogates if isinstance(surrogates, str) else "",
    )
    blocks = stored_blocks(
        folder,
        moments="scv" in (estimators or ESTIMATORS),
        surrogates=None if isinstance(surrogates, str) else surrogates,
        n_asked=MOST_UNASKED if pool is None else int(manifest["n_episodes"]),
    )
    return estimate_blocks(read_ahead(blocks), facts, estimators=estimators)
