"""The content of ``estimates.json``: every estimate of a run, its diagnostics and one plain sentence."""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from harness.campaign.loading import load_campaign
from harness.campaign.models import Campaign, EstimatorName
from harness.errors import RunFolderError
from harness.estimators.block import Block
from harness.estimators.estimate import Estimate, Unavailable, finite_json
from harness.estimators.from_records import (
    EPISODE_COLUMNS,
    MARTINGALE_COLUMN,
    MOMENT_COLUMNS,
    SHELL_COLUMNS,
    block_from_tables,
)
from harness.estimators.one_pass import ESTIMATORS, PassResult, one_pass
from harness.estimators.statement import (
    SCOPE,
    alarm_cautions,
    conditional_statement,
    failed_statement,
    per_distance,
    repeated_statement,
    statement,
    warned,
)
from harness.estimators.surrogates import MOST_UNASKED, PoolRequest, surrogates_of
from harness.estimators.threads import read_ahead
from harness.importance.build import importance_names, mixture_weights, needs_tables
from harness.pool.shells import ShellDesign
from harness.pool.surrogate_replay import PATH_COLUMNS, SurrogateReplay
from harness.progress import Progress
from harness.records.folder import SHELLS, no_episodes, read_json, read_manifest, require_schema
from harness.records.reader import read_shards, stored_columns
from harness.records.stored_manifest import StoredShells

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
    retraced : dict
        What the run says about the twin retracing its episodes.
    repeated : dict
        What the run says about tests that it ran twice.
    ending : str or None
        When the run ended and which condition decided, in a sentence; None while it goes on.
    no_surrogates : str
        Why surrogates were not asked about the tests, where they were not.
    no_replay : str or None
        Why there is no estimate from replayed surrogates; None where there may be one.
    """

    name: str
    content_hash: str
    lane_change_level: float
    confidence: float = 0.9
    distance_per_test_m: float | None = None
    importance_names: tuple[str, ...] = ()
    retraced: dict[str, Any] | None = None
    repeated: dict[str, Any] | None = None
    ending: str | None = None
    no_surrogates: str = "the blocks do not say what surrogates would have done"
    no_replay: str | None = None


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
    asked = estimators or ESTIMATORS
    refused: dict[EstimatorName, Unavailable] = {}
    if "replay" in asked and facts.no_replay is not None:
        refused["replay"] = Unavailable(facts.no_replay)
    done = one_pass(blocks, [name for name in asked if name not in refused], confidence=facts.confidence)
    best = done.headline_estimate
    estimates = {done.headline: best, **done.estimates, **refused}
    distance_km = None if facts.distance_per_test_m is None else facts.distance_per_test_m / 1000.0
    alarm = _alarm(done, facts)
    statements = _statements(estimates, facts, distance_km, alarm_cautions(alarm))
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
        "diagnostics": {**done.diagnostics.result(facts.importance_names), "alarm": alarm},
        "convergence": done.convergence,
        "statement": statements[done.headline],
        "statements": statements,
        "conditional_statement": conditional_statement(best),
        "scope": SCOPE,
        "ending": facts.ending,
    }
    cleaned: dict[str, Any] = finite_json(content)
    return cleaned


def _statements(
    estimates: Mapping[EstimatorName, Estimate | Unavailable],
    facts: CampaignFacts,
    distance_km: float | None,
    alarm: Sequence[str],
) -> dict[str, str]:
    """What each estimator says, what it must be warned of first; of one without a value, why."""
    return {
        name: warned(alarm, statement(found, facts.lane_change_level, distance_km))
        + failed_statement(found)
        + repeated_statement(facts.repeated)
        if isinstance(found, Estimate)
        else f"No crash rate from these records: {found.reason.rstrip('.')}."
        for name, found in estimates.items()
    }


def _alarm(done: PassResult, facts: CampaignFacts) -> dict[str, Any]:
    """Whether traffic, twin and pool belong together: what the run has retraced, and the surrogates' crash rates."""
    alarm = done.diagnostics.alarm
    rates = alarm.result() if alarm.asked else {"reason": facts.no_surrogates}
    retraced = facts.retraced or {"reason": "the run did not retrace its episodes"}
    return {"raised": bool(rates.get("raised")), "retraced": retraced, "surrogate_crash_rates": rates}


def estimate_run(
    folder: Path,
    *,
    estimators: Sequence[EstimatorName] | None = None,
    confidence: float | None = None,
    pool: Path | None = None,
    progress: Progress | None = None,
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
        File of a pool to replay surrogates of, instead of the campaign's own. That one is built if ``replay`` is asked
        for by name, and used without being asked for if it is there.
    progress : Progress, optional
        Follows the building of a pool.

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
    columns = stored_columns(folder)
    request = PoolRequest(pool, "replay" in (estimators or ()), progress)
    surrogates = surrogates_of(campaign, columns, request)
    n_replayed = int(manifest["n_episodes"]) if request.explicit else MOST_UNASKED
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
        no_replay=_no_replay(surrogates, int(manifest["n_episodes"]), n_replayed),
    )
    wanted = _Wanted(
        moments=campaign.testing.method == "step_mixture" and "scv" in (estimators or ESTIMATORS),
        n_martingale=_n_martingale(campaign, columns) if "martingale" in (estimators or ESTIMATORS) else 0,
        surrogates=None if isinstance(surrogates, str) else surrogates,
        n_replayed=n_replayed,
    )
    blocks = _stored_blocks(folder, campaign, manifest, wanted)
    return estimate_blocks(read_ahead(blocks), facts, estimators=estimators)


def _no_replay(surrogates: SurrogateReplay | str, n_episodes: int, n_replayed: int) -> str | None:
    if isinstance(surrogates, str):
        return surrogates
    if n_replayed < n_episodes:
        return (
            f"only the first {n_replayed:,} tests are replayed unasked; ask by name: `harness estimate DIR -e replay`"
        )
    return None


def _n_martingale(campaign: Campaign, columns: set[str]) -> int:
    """Surrogates with martingale sums on record."""
    return len(campaign.surrogates) if needs_tables(campaign) and MARTINGALE_COLUMN in columns else 0


@dataclass(frozen=True)
class _Wanted:
    """What is to be read beside what all estimates need; surrogates are asked about ``n_replayed`` tests."""

    moments: bool
    n_martingale: int
    surrogates: SurrogateReplay | None
    n_replayed: int

    @property
    def columns(self) -> list[str]:
        """Of the episodes table, without repetition."""
        martingale = [MARTINGALE_COLUMN] if self.n_martingale else []
        return list(dict.fromkeys([*EPISODE_COLUMNS, *martingale, *(PATH_COLUMNS if self.surrogates else ())]))


def stored_blocks(folder: Path, *, moments: bool) -> Iterator[Block]:
    """Tests of a run as the plain estimators and, with the ratios of its control steps, `scv` read them.

    Parameters
    ----------
    folder : Path
        Run folder with ``manifest.json``, ``campaign.yaml`` and shards.
    moments : bool
        Whether to read the control steps, where there are any on record.

    Raises
    ------
    HarnessError
        As `estimate_run`.
    """
    campaign = load_campaign(folder / "campaign.yaml", check_files=False)
    ratios = moments and campaign.testing.method == "step_mixture"
    wanted = _Wanted(moments=ratios, n_martingale=0, surrogates=None, n_replayed=0)
    yield from _stored_blocks(folder, campaign, read_manifest(folder), wanted)


def _stored_blocks(folder: Path, campaign: Campaign, manifest: dict[str, Any], wanted: _Wanted) -> Iterator[Block]:
    """Blocks of the episodes that count, in index order; a gap or too few of them is an error."""
    n, n_counted = 0, int(manifest["n_episodes"])
    if n_counted == 0:
        raise no_episodes(folder)
    columns = list(MOMENT_COLUMNS) if wanted.moments else []
    shells = read_shells(folder) if campaign.testing.method == "shells" else None
    wanted_columns = [*wanted.columns, *(SHELL_COLUMNS if shells else ())]
    for episodes, moments in read_shards(folder, episode_columns=wanted_columns, moment_columns=columns):
        block = block_from_tables(
            episodes,
            moments,
            method=campaign.testing.method,
            alpha=mixture_weights(campaign),
            shells=shells,
            n_martingale=wanted.n_martingale,
            surrogates=wanted.surrogates if n < wanted.n_replayed else None,
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
    content = read_json(path, mend=_FINISH)
    require_schema(content, StoredShells, path, mend=_FINISH)
    try:
        return ShellDesign.from_json(content)
    except (KeyError, TypeError, ValueError) as error:
        found = f"no complete description of shells ({error})"
        raise RunFolderError(str(path), found=found, expected="what the run has written", mend=_FINISH) from error


def _incomplete(folder: Path, found: str, expected: str) -> RunFolderError:
    return RunFolderError(str(folder), found=found, expected=expected, mend=_FINISH)
