"""Run a campaign into a folder: what was asked for, whether it can be had, and then until it is enough."""

from __future__ import annotations

from pathlib import Path

from harness.arguments import AtLeastOne, checked
from harness.campaign.campaign import Campaign
from harness.campaign.files import campaign_of
from harness.progress import Progress
from harness.records.folder import sole_use
from harness.resolved import Resolved, require_ready
from harness.runner.families import Hours, run_families
from harness.runner.kept import require_no_fewer, require_own_folder
from harness.runner.underway import RunResult, begun


@checked("harness.run")
def run_campaign(
    campaign: Campaign | Resolved | str | Path,
    out: str | Path,
    *,
    workers: AtLeastOne | None = None,
    resume: bool = False,
    progress: Progress | None = None,
) -> RunResult | Hours:
    """Run a campaign into a folder; one of several scenarios into a run folder each.

    Parameters
    ----------
    campaign : Campaign, str or Path
        What to run, or the path or the vehicle's name that stands for it (`harness.load_campaign`).
    out : str or Path
        New or empty folder.
    workers : int, optional
        Processes, by default as many as there are cores; their number never changes a result.
    resume : bool
        Whether ``out`` holds this campaign, interrupted, or to go on to a smaller RHW.
    progress : Progress, optional
        Who is told how far it is.

    Raises `HarnessError`: the campaign, the folder or the AV is at fault; nothing that was finished is lost.

    Examples
    --------
    >>> import harness
    >>> fast = ["world.engine=twin", "environment.parameters=ndd-overtaking-1", "testing.method=forced"]
    >>> idm = harness.load_campaign("idm", [*fast, "stop.rhw=null", "stop.episodes=1000"])
    >>> result = harness.run(idm, "runs/idm")
    >>> print(result)  # doctest: +ELLIPSIS
    idm · 1,000 tests in SUMO’s twin, cut-in · ...
      crash rate    1.95 × 10⁻⁷ per test  (0.73 to 7.14) × 10⁻⁷  0.586 per million km
      ...
    >>> result.stopped_by, result.exit_code
    ('episodes', 0)
    """
    out, progress = Path(out), progress or Progress()
    if not isinstance(campaign, Resolved):
        campaign = campaign_of(campaign)
        if campaign.scenarios is not None:
            return run_families(campaign, out, workers=workers, resume=resume, progress=progress)
        campaign = require_ready(campaign)
    resolved = campaign
    with sole_use(out):
        earlier = require_own_folder(out, resolved, resume=resume)
        require_no_fewer(out, earlier["n_episodes"], resolved.campaign.stop.episodes)
        with begun(out, resolved, earlier, workers, progress) as underway:
            underway.drive_before_tests()
            rule = underway.drive_tests()
        require_no_fewer(out, earlier["n_episodes"], underway.run.n_episodes)
        return underway.finish(rule)
