"""Run campaigns: shards over worker processes, stopping, resuming, replaying."""

from harness.runner.compare import Comparison, compare_campaigns
from harness.runner.estimate import estimate_run
from harness.runner.look import AvCheck, check_av, plan_campaign
from harness.runner.replay import ReplayResult, replay_episode
from harness.runner.run import RunResult, run_campaign

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
