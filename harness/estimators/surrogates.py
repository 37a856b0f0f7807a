"""Whether surrogates can be asked about a stored run, and who they are."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

from harness.campaign.models import Campaign
from harness.errors import HarnessError
from harness.pool.storage import cached_pool, campaign_pool, read_pool
from harness.pool.surrogate_replay import PATH_COLUMNS, SurrogateReplay
from harness.progress import Progress
from harness.resolved import resolve

MOST_UNASKED = 100_000
"""Tests that are replayed without being asked to, for the alarm: some 30 µs each."""


@dataclass(frozen=True)
class PoolRequest:
    """How far to go for a pool of cut-ins.

    Attributes
    ----------
    file : Path or None
        A pool to be used instead of the campaign's own.
    build : bool
        Whether to build the campaign's own if it is not cached.
    progress : Progress or None
        Follows the building.
    """

    file: Path | None = None
    build: bool = False
    progress: Progress | None = None

    @property
    def explicit(self) -> bool:
        """Whether the replay was asked for."""
        return self.build or self.file is not None


def surrogates_of(campaign: Campaign, columns: set[str], request: PoolRequest) -> SurrogateReplay | str:
    """The surrogates of a campaign's pool, or the reason why they cannot be asked.

    Parameters
    ----------
    campaign : Campaign
    columns : set of str
        Names in the stored episodes table.
    request : PoolRequest

    Raises
    ------
    HarnessError
        The pool that was asked for is damaged or of another environment.
    """
    if reason := refusal(campaign, columns):
        return reason
    try:
        resolved = resolve(campaign)
        if request.file is not None:
            return SurrogateReplay(resolved, read_pool(request.file))
        pool = campaign_pool(resolved, request.progress) if request.build else cached_pool(resolved)
        if pool is not None:
            return SurrogateReplay(resolved, pool)
    except HarnessError as error:
        if request.explicit:
            raise
        return f"the pool of cut-ins cannot be used: {error}"
    return "the pool of cut-ins has not been built here; `harness estimate DIR -e replay` builds it (about 15 s)"


def refusal(campaign: Campaign, columns: set[str]) -> str | None:
    """Why no surrogate can take the place of the AV in these records; None if one can."""
    if campaign.testing.method == "shells":
        return "needs weighted tests: those drawn from shells have used the surrogates' outcomes already"
    if campaign.av.before_cut_in == "controller":
        return (
            "needs an AV that keeps its speed until the cut-in (av.before_cut_in: hold_speed): this one acted before "
            "it, and where it was when BV cut in depends on that"
        )
    if missing := [name for name in PATH_COLUMNS if name not in columns]:
        return f"needs the columns {', '.join(missing)} of the episodes table, which these records do not have"
    return None
