"""Crash rates of automated vehicles in naturalistic traffic, from few SUMO tests, with intervals one can trust.

The same as the command line, in a few lines of Python::

    import harness

    campaign = harness.load_campaign("scenarios/smoke.yaml", ["stop.rhw=0.1"])
    result = harness.run(campaign, "runs/smoke", workers=2)
    print(result.estimates["statement"])
    tests = harness.read("runs/smoke").episodes()
    harness.replay("runs/smoke", 17).outcome
"""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Any

from harness.errors import HarnessError

if TYPE_CHECKING:
    from collections.abc import Sequence

    from harness.campaign.campaign import Campaign
    from harness.progress import Progress
    from harness.records.reader import StoredRun
    from harness.runner import AvCheck, Comparison, ReplayResult, RunResult
    from harness.vocabulary import EstimatorName

__all__ = [
    "HarnessError",
    "av_check",
    "compare",
    "estimate",
    "load_campaign",
    "read",
    "replay",
    "run",
    "write_report",
]

# What does the work is imported inside each function, so that `import harness` and `harness --help` answer at once.


def load_campaign(path: str | Path, overrides: Sequence[str] = (), *, av: str | None = None) -> Campaign:
    """Read and validate a campaign; ``overrides`` are ``section.key=value`` each (see `harness.campaign.files`)."""
    from harness.campaign.files import load_campaign as load  # noqa: PLC0415

    return load(path, overrides, av=av)


def run(
    campaign: Campaign,
    out: str | Path,
    *,
    workers: int | None = None,
    resume: bool = False,
    progress: Progress | None = None,
) -> RunResult:
    """Run a campaign into a folder (see `harness.runner.run_campaign`)."""
    from harness.runner import run_campaign  # noqa: PLC0415

    return run_campaign(campaign, Path(out), workers=workers, resume=resume, progress=progress)


def av_check(campaign: Campaign, n_episodes: int = 48) -> AvCheck:
    """Look at a campaign's AV in a few dozen episodes (see `harness.runner.check_av`)."""
    from harness.runner import check_av  # noqa: PLC0415

    return check_av(campaign, n_episodes)


def compare(
    a: Campaign,
    b: Campaign,
    out: str | Path,
    *,
    stored: str | Path | None = None,
    margin: float | None = None,
    workers: int | None = None,
    progress: Progress | None = None,
) -> Comparison:
    """Compare the AVs of two campaigns on common random numbers (see `harness.runner.compare_campaigns`)."""
    from harness.runner import compare_campaigns  # noqa: PLC0415

    run_of_a = None if stored is None else Path(stored)
    return compare_campaigns(a, b, Path(out), workers=workers, progress=progress, stored=run_of_a, margin=margin)


def estimate(
    folder: str | Path, *, estimators: Sequence[EstimatorName] | None = None, confidence: float | None = None
) -> dict[str, Any]:
    """Estimate a stored run again (see `harness.runner.estimate_run`)."""
    from harness.runner import estimate_run  # noqa: PLC0415

    return estimate_run(Path(folder), estimators=estimators, confidence=confidence)


def read(folder: str | Path) -> StoredRun:
    """Tables of a stored run as pandas frames, with units and weights (see `harness.records.reader`)."""
    from harness.records.reader import StoredRun  # noqa: PLC0415

    return StoredRun(Path(folder))


def write_report(folder: str | Path) -> Path:
    """Write ``report.html`` and the plots of a stored run; returns the page's path."""
    # Not called "report": importing the package harness.report, which `run` does, would put that in its place.
    from harness.report import write_report as write  # noqa: PLC0415

    return write(Path(folder))


def replay(folder: str | Path, episode: int, *, gui: bool = False, fcd: str | Path | None = None) -> ReplayResult:
    """Run one episode of a stored run again, bit for bit (see `harness.runner.replay_episode`)."""
    from harness.runner import replay_episode  # noqa: PLC0415

    return replay_episode(Path(folder), episode, gui=gui, fcd=None if fcd is None else Path(fcd))
