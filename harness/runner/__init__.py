"""Run campaigns: shards over worker processes, stopping, resuming, replaying."""

from harness.runner.av_check import AvCheck, check_av
from harness.runner.campaign_run import run_campaign
from harness.runner.compare import Comparison, compare_campaigns
from harness.runner.plan import plan_campaign
from harness.runner.replay import ReplayResult, replay_episode
from harness.runner.run_result import RunResult
from harness.runner.stored_estimates import estimate_run

__all__ = [
    "AvCheck",
    "Comparison",
    "ReplayResult",
    "RunResult",
    "check_av",
    "compare_campaigns",
    "estimate_run",
    "plan_campaign",
    "replay_episode",
    "run_campaign",
]
