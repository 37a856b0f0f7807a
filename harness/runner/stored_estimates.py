"""Estimate a run from the records in its folder."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import replace
from functools import partial
from itertools import chain
from pathlib import Path
from typing import Any

from harness.campaign.campaign import Campaign
from harness.campaign.files import load_campaign
from harness.errors import HarnessError, RunFolderError
from harness.estimators import ESTIMATORS, CampaignFacts, estimate_blocks
from harness.estimators.block import Block
from harness.estimators.from_records import EPISODE_COLUMNS, MOMENT_COLUMNS, SHELL_COLUMNS, block_from_tables
from harness.estimators.one_pass import SPACING
from harness.importance.build import importance_names, mixture_weights
from harness.pool.replay import PATH_COLUMNS, SurrogateReplay
from harness.pool.storage import cached_pool, read_pool
from harness.records.folder import SHELLS, concatenated, no_episodes, read_json, read_manifest, require_schema
from harness.records.reader import read_shard, stored_columns
from harness.records.stored_manifest import StoredShells
from harness.resolved import resolve
from harness.runner.stored_shards import GatheredBlocks
from harness.strata import ShellDesign
from harness.threads import made_ahead
from harness.vocabulary import EstimatorName

MOST_UNASKED = 50_000
"""Tests that are replayed without being asked to, for the alarm: some 30 µs each."""
MOST_GROUPED = 5_000
"""Tests of small shards that are read as one."""
_FINISH = "Run `harness run` with --resume, which makes missing shards."

_Shards = Sequence[Mapping[str, Any]]


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
    surrogates = surrogates_of(campaign, stored_columns(folder, manifest), pool)
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
        no_surrogates=surrogates if isinstance(surrogates, str) else "",
    )
    blocks = stored_blocks(
        folder,
        moments="scv" in (estimators or ESTIMATORS),
        surrogates=None if isinstance(surrogates, str) else surrogates,
        n_asked=MOST_UNASKED if pool is None else int(manifest["n_episodes"]),
    )
    return estimate_blocks(blocks, facts, estimators=estimators)


def stored_blocks(
    folder: Path, *, moments: bool, surrogates: SurrogateReplay | None = None, n_asked: int = 0
) -> Iterator[Block]:
    """Blocks of the tests that are reported, in index order from 0; a gap or too few of them is an error.

    Parameters
    ----------
    folder : Path
        Run folder.
    moments : bool
        Whether to read the ratios of control steps, which `scv` needs, where there are any on record.
    surrogates : SurrogateReplay, optional
        Surrogates to be asked about the shards that begin within the first ``n_asked`` tests.

    Raises
    ------
    HarnessError
        If the folder is not a run, or its records are damaged or incomplete.
    """
    campaign = load_campaign(folder / "campaign.yaml", check_files=False)
    manifest = read_manifest(folder)
    n_counted, reported_from = int(manifest["n_episodes"]), int(manifest.get("reported_from") or 0)
    if n_counted == 0:
        raise no_episodes(folder)
    method, alpha = campaign.testing.method, mixture_weights(campaign)
    shells = read_shells(folder) if method == "shells" else None
    needed = [*EPISODE_COLUMNS, *(SHELL_COLUMNS if shells else ())]
    ratios = list(MOMENT_COLUMNS) if moments and method == "step_mixture" else []
    gathered = None if ratios or shells else GatheredBlocks(folder, campaign)

    def read(group: _Shards, asking: SurrogateReplay | None = None) -> Block:
        columns = dict.fromkeys([*needed, *(asking.columns if asking else ())])
        stored = [read_shard(folder, shard, episode_columns=list(columns), moment_columns=ratios) for shard in group]
        episodes = concatenated([table for table, _ in stored], folder)
        kept = [table for _, table in stored if table is not None]
        steps = concatenated(kept, folder) if kept else None
        block = block_from_tables(episodes, steps, method=method, alpha=alpha, shells=shells)
        if asking is None:
            return block
        return replace(block, surrogates_crash=asking.crashes(episodes), known_rates=asking.known)

    def taken(group: _Shards) -> Block:
        return (gathered.take_together(group) if gathered else None) or read(group)

    groups = list(_groups(manifest["shards"], n_asked))
    n_asked_groups = 0 if surrogates is None else sum(group[0]["first_episode"] < n_asked for group in groups)
    n = 0
    for block in chain(
        made_ahead(partial(read, asking=surrogates), groups[:n_asked_groups]),
        made_ahead(taken, groups[n_asked_groups:], 1),  # only one may take from gathered parts
    ):
        if block.first_episode != n:
            raise _incomplete(folder, f"a shard that begins at episode {block.first_episode}", f"episode {n}")
        counted = block.take(slice(max(reported_from - n, 0), n_counted - n))
        n = counted.first_episode + len(counted)
        if len(counted):
            yield replace(counted, first_episode=counted.first_episode - reported_from) if reported_from else counted
        if n == n_counted:
            return
    raise _incomplete(folder, f"{n} episodes on record", f"{n_counted} (manifest.json)")


def _groups(shards: _Shards, edge: int) -> Iterator[_Shards]:
    """Consecutive shards to be read as one: small ones cost more to hand over than to use.

    A group brings as many tests as `one_pass` waits for until it looks again, or `MOST_GROUPED`, or ends at the
    ``edge``, where shards begin that are read otherwise.
    """
    n, begin = 0, 0
    group: list[Mapping[str, Any]] = []
    for shard in shards:
        group.append(shard)
        n += shard["n_episodes"]
        if n >= min(begin * SPACING, begin + MOST_GROUPED) or begin < edge <= n:
            yield group
            group, begin = [], n
    if group:
        yield group


def read_shells(folder: Path) -> ShellDesign:
    """Strata of a shells campaign; a `RunFolderError` where the file is missing, damaged, or of a too early version."""
    content = read_json(folder / SHELLS, mend=_FINISH)
    if "n_inside" in content and "statements" not in content:
        version = read_manifest(folder).get("versions", {}).get("harness", "that made it")
        raise RunFolderError(
            str(folder / SHELLS),
            found="shells of an earlier version, without statements and reference drivers",
            expected="a run of this version: its tests say what those rest on",
            mend=f"Run the campaign again into a new folder, or estimate this one with version {version}.",
        )
    require_schema(content, StoredShells, folder / SHELLS, mend=_FINISH)
    return ShellDesign.from_json(content)


def _incomplete(folder: Path, found: str, expected: str) -> RunFolderError:
    return RunFolderError(str(folder), found=found, expected=expected, mend=_FINISH)


def surrogates_of(campaign: Campaign, columns: set[str], file: Path | None = None) -> SurrogateReplay | str:
    """The surrogates that can be asked about a run that has stored these ``columns``, or the reason why none can.

    They are those of a pool's ``file``, or of the campaign's own pool if it has been built.

    Raises
    ------
    HarnessError
        The pool that was asked for is damaged or of another environment.
    """
    if reason := _refusal(campaign, columns):
        return reason
    resolved = resolve(campaign)
    if file is not None:
        return SurrogateReplay(resolved, read_pool(file))
    try:
        if (pool := cached_pool(resolved)) is not None:
            return SurrogateReplay(resolved, pool)
    except HarnessError as error:
        return f"the pool of cut-ins cannot be used: {error}"
    return "the pool of cut-ins has not been built here; `harness pool DIR/campaign.yaml` builds it (about 15 s)"


def _refusal(campaign: Campaign, columns: set[str]) -> str | None:
    """Why no surrogate can take the place of the AV in these records; None if one can."""
    if campaign.testing.method == "shells":
        return "needs weighted tests: those drawn from shells have used the surrogates' outcomes already"
    if campaign.av.acts_before_cut_in:
        return (
            "needs an AV that keeps its speed until the cut-in (av.before_cut_in: hold_speed): this one acted before "
            "it, and where it was when BV cut in depends on that"
        )
    if missing := [name for name in PATH_COLUMNS if name not in columns]:
        return f"needs the columns {', '.join(missing)} of the episodes table, which these records do not have"
    return None
