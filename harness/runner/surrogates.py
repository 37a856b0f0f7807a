"""Whether surrogates can be asked about a stored run, and who they are."""

from __future__ import annotations

from pathlib import Path

from harness.campaign.models import Campaign
from harness.errors import HarnessError
from harness.pool.storage import cached_pool, read_pool
from harness.pool.surrogate_replay import PATH_COLUMNS, SurrogateReplay
from harness.resolved import resolve

MOST_UNASKED = 100_000
"""Tests that are replayed without being asked to, for the alarm: some 30 µs each."""


def surrogates_of(campaign: Campaign, columns: set[str], file: Path | None = None) -> SurrogateReplay | str:
    """The surrogates of a campaign's pool, or the reason why they cannot be asked.

    Parameters
    ----------
    campaign : Campaign
    columns : set of str
        Names in the stored episodes table.
    file : Path, optional
        A pool to be used instead of the campaign's own, which is used only if it has been built.

    Raises
    ------
    HarnessError
        The pool that was asked for is damaged or of another environment.
    """
    if reason := refusal(campaign, columns):
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
