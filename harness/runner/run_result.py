"""What a run leaves, and whether an earlier one has left it already."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from harness.campaign.campaign import Campaign
from harness.campaign.files import dump_campaign
from harness.errors import EXIT_BUDGET_SPENT, EXIT_DONE, EXIT_REFUTED
from harness.estimators.stopping import Rule, Verdict
from harness.records.folder import NO_RUN, read_json
from harness.records.gathered import Fingerprint, Gathered, fingerprint
from harness.resolved import Resolved
from harness.runner.manifest import versions
from harness.stopped_by import StoppedBy, ending

EXIT_OF: Mapping[Verdict, int] = {"accepted": EXIT_DONE, "rejected": EXIT_REFUTED, "undecided": EXIT_BUDGET_SPENT}
_SHARD = ("index", "first_episode", "n_episodes", "files")
ESTIMATES, REPORT = "estimates.json", "report.html"


@dataclass(frozen=True)
class RunResult:
    """What a finished campaign left.

    Attributes
    ----------
    folder : Path
    report : Path
        The page ``report.html``.
    estimates : dict
        Content of ``estimates.json``.
    stopped_by : {"rhw", "accept", "contradicted", "two_phase", "episodes", "pool", "pool_error"}
        See `harness.stopped_by`.
    ending : str
        When it ended and which condition decided, in a sentence.
    exit_code : int
        0, or 4 when the budget or the pool was spent before the asked precision or decision, or 5 where the crash rate
        is above the limit that was to be kept.
    """

    folder: Path
    report: Path
    estimates: dict[str, Any]
    stopped_by: StoppedBy
    ending: str
    exit_code: int


def exit_code(campaign: Campaign, stopped_by: StoppedBy, verdict: Verdict | None) -> int:
    """See `RunResult`."""
    if verdict is not None:
        return EXIT_OF[verdict]
    missed = campaign.stop.rhw is not None and stopped_by not in ("rhw", "two_phase")
    return EXIT_BUDGET_SPENT if missed else EXIT_DONE


def conclusion(campaign: Campaign, rule: Rule, n_episodes: int, reported_from: int) -> tuple[StoppedBy, str]:
    """Why a campaign ended after so many tests; those from ``reported_from`` on are reported. In a sentence."""
    by: StoppedBy
    if 0 < reported_from < n_episodes < campaign.stop.episodes:
        by = "two_phase"
    elif rule.reached:
        by = "rhw" if rule.decision is None else "accept"
    elif rule.decision is not None and rule.decision.is_final:
        by = "contradicted"
    elif rule.pool_error_above_target:  # whatever else is spent: more of it would not help
        by = "pool_error"
    else:
        by = "episodes" if n_episodes >= campaign.stop.episodes else "pool"
    asked = campaign.stop.rhw is not None or rule.decision is not None
    return by, ending(by, n_episodes, rule.waited_for, precision_asked=asked)


def results_of(folder: Path) -> dict[str, Fingerprint | None]:
    """Size and checksum of what was made of the tests."""
    return {name: fingerprint(folder / name) for name in (ESTIMATES, REPORT)}


def earlier_result(folder: Path, resolved: Resolved, earlier: Mapping[str, Any]) -> RunResult | None:
    """What a finished run of the same campaign left, by the same versions, if no file of it has changed since.

    ``earlier`` is its manifest. Where tests are not gathered, as those from shells, the answer is None.
    """
    campaign, decision = resolved.campaign, earlier.get("decision")
    if earlier.get("status") != "done" or not earlier.get("results") or earlier.get("versions") != versions():
        return None
    now = {name: None if found is None else list(found) for name, found in results_of(folder).items()}
    file, text = folder / "campaign.yaml", dump_campaign(campaign).encode()
    if now != earlier["results"] or None in now.values() or not (file.is_file() and file.read_bytes() == text):
        return None
    gathered = Gathered(folder, same_sources=True)
    if not all(gathered.find(*(shard[key] for key in _SHARD)) for shard in earlier["shards"]):
        return None
    verdict = None if decision is None else decision["verdict"]
    return RunResult(
        folder,
        folder / REPORT,
        read_json(folder / ESTIMATES, mend=NO_RUN),
        earlier["stopped_by"],
        earlier["ending"],
        exit_code(campaign, earlier["stopped_by"], verdict),
    )
