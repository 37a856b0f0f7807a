"""Crash rates of automated vehicles in naturalistic traffic, from few SUMO tests, with intervals one can trust.

The same as the command line, in a few lines of Python::

    import harness

    campaign = harness.load_campaign("scenarios/smoke.yaml", ["stop.rhw=0.1"])
    result = harness.run(campaign, "runs/smoke", workers=2)
    print(result)  # the short answer; result.estimates is all of it
    tests = harness.read("runs/smoke").episodes()
    harness.replay("runs/smoke", 17).outcome
"""

from importlib.metadata import version
from pkgutil import resolve_name
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from harness.campaign.files import load_campaign
    from harness.errors import HarnessError
    from harness.fitting.files import fit_files as fit
    from harness.report.motion import write_motion
    from harness.runner.compare import compare_campaigns as compare
    from harness.runner.look import check_av as av_check
    from harness.runner.other_traffic import estimate_in_other_traffic, sensitivity
    from harness.runner.run import run_campaign as run
    from harness.runner.stored import estimate_families, write_report
    from harness.runner.stored import estimate_run as estimate
    from harness.runner.stored import replay_episode as replay
    from harness.runner.tables import read

__all__ = [
    "HarnessError", "av_check", "compare", "estimate", "estimate_families", "estimate_in_other_traffic", "fit",
    "load_campaign", "read", "replay", "run", "sensitivity", "write_motion", "write_report",
]  # fmt: skip

_PLACES = {
    "HarnessError": "harness.errors:HarnessError",
    "av_check": "harness.runner.look:check_av",
    "compare": "harness.runner.compare:compare_campaigns",
    "estimate": "harness.runner.stored:estimate_run",
    "estimate_families": "harness.runner.stored:estimate_families",
    "estimate_in_other_traffic": "harness.runner.other_traffic:estimate_in_other_traffic",
    "fit": "harness.fitting.files:fit_files",
    "load_campaign": "harness.campaign.files:load_campaign",
    "read": "harness.runner.tables:read",
    "replay": "harness.runner.stored:replay_episode",
    "run": "harness.runner.run:run_campaign",
    "sensitivity": "harness.runner.other_traffic:sensitivity",
    "write_motion": "harness.report.motion:write_motion",
    "write_report": "harness.runner.stored:write_report",  # not "report", as that package is called
}
"""Where each name is; imported when it is asked for, so that ``import harness`` and ``harness --help`` are quick."""


def __getattr__(name: str) -> Any:
    if name == "__version__":
        return version("harness")
    if name not in _PLACES:
        raise AttributeError(f"module 'harness' has no attribute {name!r}")
    return resolve_name(_PLACES[name])


def __dir__() -> list[str]:
    return __all__
