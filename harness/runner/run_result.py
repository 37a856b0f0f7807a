"""What a run leaves."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from harness.campaign.campaign import Campaign
from harness.errors import EXIT_BUDGET_SPENT, EXIT_DONE, EXIT_REFUTED
from harness.estimators.answer import ending
from harness.estimators.stopping import Rule, Verdict
from harness.records.manifest import StoppedBy

EXIT_OF: Mapping[Verdict, int] = {"accepted": EXIT_DONE, "rejected": EXIT_REFUTED, "undecided": EXIT_BUDGET_SPENT}
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
        See `harness.records.manifest.StoppedBy`.
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
    elif rule.look.stopped:
        by = "rhw" if rule.look.decision is None else "accept"
    elif rule.look.decision is not None and rule.look.decision.is_final:
        by = "contradicted"
    elif rule.look.pool_error_above_target:  # whatever else is spent: more of it would not help
        by = "pool_error"
    else:
        by = "episodes" if n_episodes >= campaign.stop.episodes else "pool"
    asked = campaign.stop.rhw is not None or rule.look.decision is not None
    return by, ending(by, n_episodes, rule.look.unmet, precision_asked=asked)
