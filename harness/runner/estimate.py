"""Estimate a run from the records in its folder."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

from harness.campaign.files import load_campaign
from harness.drawing import source_of
from harness.drawing.protocol import block_of
from harness.errors import RunFolderError
from harness.estimators.answer import CampaignFacts, estimate_blocks
from harness.estimators.block import Block
from harness.estimators.one_pass import SPACING
from harness.importance.build import importance_names
from harness.processes import made_ahead
from harness.records.folder import concatenated, no_episodes, read_manifest
from harness.records.reader import read_shard
from harness.vocabulary import ESTIMATORS, EstimatorName

MOST_GROUPED = 5_000
"""Tests of small shards that are read as one."""
_FINISH = "Run `harness run` with --resume, which makes missing shards."

_Shards = Sequence[Mapping[str, Any]]


def estimate_run(
    folder: str | Path,
    *,
    estimators: Sequence[EstimatorName] | None = None,
    confidence: float | None = None,
) -> dict[str, Any]:
    """Estimate a stored run from its records; returns the content of ``estimates.json``.

    ``estimators`` are reported beside the method's own, all by default; ``confidence`` is the level of the intervals,
    by default the campaign's.

    Raises `HarnessError`: if the folder is not a run, its records are damaged or incomplete.
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
        retraced=manifest.get("retraced"),
        repeated=manifest.get("repeated"),
        ending=manifest.get("ending"),
        decision=manifest.get("decision"),
    )
    blocks = stored_blocks(folder, moments="scv" in (estimators or ESTIMATORS))
    return estimate_blocks(blocks, facts, estimators=estimators)


def stored_blocks(folder: Path, *, moments: bool) -> Iterator[Block]:
    """Blocks of the tests that are reported, in index order from 0; a gap or too few of them is an error.

    With ``moments`` ratios of control steps are read, which `scv` needs, where there are any on record.

    Raises `HarnessError`: if the folder is not a run, or its records are damaged or incomplete.
    """
    campaign = load_campaign(folder / "campaign.yaml", check_files=False)
    manifest = read_manifest(folder)
    n_counted, reported_from = int(manifest["n_episodes"]), int(manifest.get("reported_from") or 0)
    if n_counted == 0:
        raise no_episodes(folder)
    source = source_of(campaign)
    design, needed = source.stored_design(folder), list(source.columns)
    ratios = list(source.moment_columns) if moments else []

    def read(group: _Shards) -> Block:
        stored = [read_shard(folder, shard, episode_columns=needed, moment_columns=ratios) for shard in group]
        episodes = concatenated([table for table, _ in stored], folder)
        kept = [table for _, table in stored if table is not None]
        steps = concatenated(kept, folder) if kept else None
        return block_of(campaign, episodes, steps, design)

    n = 0
    for block in made_ahead(read, _groups(manifest["shards"])):
        if block.first_episode != n:
            raise _incomplete(folder, f"a shard that begins at episode {block.first_episode}", f"episode {n}")
        counted = block.take(slice(max(reported_from - n, 0), n_counted - n))
        n = counted.first_episode + len(counted)
        if len(counted):
            yield replace(counted, first_episode=counted.first_episode - reported_from) if reported_from else counted
        if n == n_counted:
            return
    raise _incomplete(folder, f"{n} episodes on record", f"{n_counted} (manifest.json)")


def _groups(shards: _Shards) -> Iterator[_Shards]:
    """Consecutive shards to be read as one: small ones cost more to hand over than to use.

    A group brings as many tests as `one_pass` waits for until it looks again, or `MOST_GROUPED`.
    """
    n, begin = 0, 0
    group: list[Mapping[str, Any]] = []
    for shard in shards:
        group.append(shard)
        n += shard["n_episodes"]
        if n >= min(begin * SPACING, begin + MOST_GROUPED):
            yield group
            group, begin = [], n
    if group:
        yield group


def _incomplete(folder: Path, found: str, expected: str) -> RunFolderError:
    return RunFolderError(str(folder), found, expected, _FINISH)
