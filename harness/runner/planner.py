"""What a campaign tests next, and when it is enough: methods that know all their tests beforehand, and shells."""

from __future__ import annotations

from collections.abc import Iterator

from harness.campaign.models import Campaign
from harness.estimators import StopRule, accumulator
from harness.estimators.block import Block
from harness.pool.shells import PrescribedEpisodes
from harness.runner.shell_planner import ShellPlanner
from harness.runner.worker import ShardSpec


class FixedPlanner:
    """All tests are known beforehand, in one round; a stop rule looks at some of their shards.

    Parameters
    ----------
    campaign : Campaign

    Attributes
    ----------
    rule : StopRule
    """

    def __init__(self, campaign: Campaign) -> None:
        self._campaign = campaign
        stop, method, size = campaign.stop, campaign.testing.method, campaign.run.shard_size
        self.rule = StopRule(stop, method, size, min_crashes=campaign.min_crashes)
        self._sums = accumulator(self.rule.estimator)
        self._n_episodes = 0

    def rounds(self) -> Iterator[Iterator[ShardSpec]]:
        """See `ShellPlanner`; all shards are one round."""
        size, total = self._campaign.run.shard_size, self._campaign.stop.episodes
        firsts = enumerate(range(0, total, size))
        yield (ShardSpec(index, first, min(size, total - first)) for index, first in firsts)

    def add(self, block: Block) -> bool:
        """See `ShellPlanner`."""
        self._sums.add(block)
        self._n_episodes += len(block)
        if not self.rule.due(self._n_episodes):
            return False
        return self.rule.observe(self._n_episodes, self._sums.result(self._campaign.stop.confidence))


Planner = FixedPlanner | ShellPlanner


def planner_of(campaign: Campaign, prescribed: PrescribedEpisodes | None, held: int) -> Planner:
    """The planner of a campaign whose folder holds ``held`` tests already."""
    if prescribed is None:
        return FixedPlanner(campaign)
    return ShellPlanner(campaign, prescribed.design, prescribed.available, held)
