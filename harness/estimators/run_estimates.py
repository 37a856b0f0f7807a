"""The content of ``estimates.json``: every estimate of a run, its diagnostics and one plain sentence."""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from harness.campaign.loading import load_campaign
from harness.campaign.models import Campaign, EstimatorName
from harness.errors import RunFolderError
from harness.estimators.block import Block
from harness.estimators.estimate import finite_json
from harness.estimators.from_records import EPISODE_COLUMNS, MOMENT_COLUMNS, SHELL_COLUMNS, block_from_tables
from harness.estimators.one_pass import ESTIMATORS, one_pass
from harness.estimators.statement import SCOPE, conditional_statement, per_distance, statement
from harness.estimators.threads import read_ahead
from harness.importance.build import importance_names, mixture_weights
from harness.pool.shells import ShellDesign
from harness.records.folder import SHELLS, read_json, read_manifest
from harness.records.reader import read_shards

_FINISH = "Run `harness run` with --resume, which makes missing shards."


@dataclass(frozen=True)
class CampaignFacts:
    """What estimates must say about the campaign that they belong to.

    Attributes
    ----------
    distance_per_test_m : float or None
        Mean distance that the AV drives in a naturalistic test; None if unknown, and then nothing is said per km.
    importance_names : tuple of str
        Names of the importance functions, in order.
    """

    name: str
    content_hash: str
    lane_change_level: float
    confidence: float = 0.9
    distance_per_test_m: float | None = None
    importance_names: tuple[str, ...] = ()


def estimate_blocks(
    blocks: Iterable[Block], facts: CampaignFacts, *, estimators: Sequence[EstimatorName] | None = None
) -> dict[str, Any]:
    """Estimates of blocks that cover a campaign's episodes, as JSON content.

    Parameters
    ----------
    blocks : iterable of Block
        Contiguous and in index order.
    facts : CampaignFacts
    estimators : sequence of str, optional
        Which to report beside the method's own; all by default.
    """
    done = one_pass(blocks, estimators or ESTIMATORS, confidence=facts.confidence)
    best = done.headline_estimate
    estimates = {done.headline: best, **done.estimates}
    distance_km = None if facts.distance_per_test_m is None else facts.distance_per_test_m / 1000.0
    content: dict[str, Any] = {
        "campaign": facts.name,
        "campaign_hash": facts.content_hash,
        "lane_change_level": facts.lane_change_level,
        "confidence": facts.confidence,
        "n_episodes": best.n_episodes,
        "n_crashes": best.n_crashes,
        "headline": done.headline,
        "distance_per_test_km": distance_km,
        "crash_rate_per_1e6_km": None if distance_km is None else per_distance(best, distance_km),
        "estimates": {name: estimate.to_json() for name, estimate in estimates.items()},
        "diagnostics": done.diagnostics.result(facts.importance_names),
        "convergence": done.convergence,
        "statement": statement(best, facts.lane_change_level, distance_km),
        "conditional_statement": conditional_statement(best),
        "scope": SCOPE,
    }
    cleaned: dict[str, Any] = finite_json(content)
    return cleaned


def estimate_run(
    folder: Path, *, estimators: Sequence[EstimatorName] | None = None, confidence: float | None = None
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

    Returns
    -------
    dict
        Content of ``estimates.json``.

    Raises
    ------
    HarnessError
        If the folder is not a run, or its records are damaged or incomplete.
    """
    folder = Path(folder)
    manifest = read_manifest(folder)
    campaign = load_campaign(folder / "campaign.yaml", check_files=False)
    distance = manifest.get("distance_per_test_m")
    facts = CampaignFacts(
        name=campaign.name,
        content_hash=str(manifest["campaign_hash"]),
        lane_change_level=campaign.environment.lane_change_level,
        confidence=campaign.stop.confidence if confidence is None else confidence,
        distance_per_test_m=None if distance is None else float(distance),
        importance_names=importance_names(campaign),
    )
    wants_moments = campaign.testing.method == "step_mixture" and "scv" in (estimators or ESTIMATORS)
    blocks = _stored_blocks(folder, campaign, manifest, wants_moments=wants_moments)
    return estimate_blocks(read_ahead(blocks), facts, estimators=estimators)


def _stored_blocks(
    folder: Path, campaign: Campaign, manifest: dict[str, Any], *, wants_moments: bool
) -> Iterator[Block]:
    """Blocks of the episodes that count, in index order; a gap or too few of them is an error."""
    n, n_counted, cap = 0, int(manifest["n_episodes"]), manifest.get("weight_cap")
    columns = list(MOMENT_COLUMNS) if wants_moments else []
    shells = read_shells(folder) if campaign.testing.method == "shells" else None
    wanted = [*EPISODE_COLUMNS, *(SHELL_COLUMNS if shells else ())]
    for episodes, moments in read_shards(folder, episode_columns=wanted, moment_columns=columns):
        block = block_from_tables(
            episodes,
            moments,
            method=campaign.testing.method,
            alpha=mixture_weights(campaign),
            weight_cap=cap,
            shells=shells,
        )
        if block.first_episode != n:
            raise _incomplete(folder, f"a shard that begins at episode {block.first_episode}", f"episode {n}")
        counted = block.take(slice(0, n_counted - n))
        n += len(counted)
        yield counted
        if n == n_counted:
            return
    raise _incomplete(folder, f"{n} episodes on record", f"{n_counted} (manifest.json)")


def read_shells(folder: Path) -> ShellDesign:
    """Strata of a shells campaign.

    Raises
    ------
    RunFolderError
        The file is missing or damaged.
    """
    path = folder / SHELLS
    try:
        return ShellDesign.from_json(read_json(path, mend=_FINISH))
    except (KeyError, TypeError, ValueError) as error:
        found = f"no complete description of shells ({error})"
        raise RunFolderError(str(path), found=found, expected="what the run has written", mend=_FINISH) from error


def _incomplete(folder: Path, found: str, expected: str) -> RunFolderError:
    return RunFolderError(str(folder), found=found, expected=expected, mend=_FINISH)
