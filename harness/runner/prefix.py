"""The contiguous prefix of finished shards: what it adds up to, and whether it is enough."""

from __future__ import annotations

from collections import Counter

from harness.campaign.models import Campaign
from harness.errors import TooManyFailedError
from harness.estimators import accumulator
from harness.estimators.both_ways import BothWays
from harness.runner.repeat import Repeated
from harness.runner.rounds import Rule
from harness.runner.shards import SMALLEST_FAILED_SAMPLE
from harness.runner.worker import ShardDone, ShardSpec


class Prefix:
    """Finished shards in order, from the first on.

    Attributes
    ----------
    sums : BothWays
        Of the estimator whose precision is watched.
    repeated : Repeated or None
        What repeating some of the first tests has shown, once it is known.
    """

    def __init__(self, campaign: Campaign, rule: Rule) -> None:
        self._campaign, self._rule = campaign, rule
        self.sums: BothWays = accumulator(rule.estimator)
        self.specs: list[ShardSpec] = []
        self.files: list[dict[str, str]] = []
        self.n_episodes = self.n_crashes = self.n_failed = self.n_retraced = 0
        self.repeated: Repeated | None = None
        self._causes: Counter[str] = Counter()

    @property
    def figures(self) -> dict[str, int | float]:
        """What a progress bar shows: crashes, and what the stop rule saw at its last look.

        Only what a rule asks for is called ``rhw``: a bar reckons from it when the campaign will stop.
        """
        watched = "half_width" if self._campaign.stop.rhw is None else "rhw"
        figures: dict[str, int | float] = {"crashes": self.n_crashes, watched: self._rule.rhw}
        weighted = self._campaign.testing.method in ("forced", "episode_mixture")
        return figures | ({"heaviest": self._rule.heaviest} if weighted else {})

    @property
    def reached(self) -> bool:
        """Whether the asked precision was reached."""
        return self._rule.reached

    @property
    def waited_for(self) -> tuple[str, ...]:
        """Conditions that were missing when the stop rule last said no."""
        return self._rule.waited_for

    @property
    def pool_too_rough(self) -> bool:
        """Whether no number of tests can bring the asked precision."""
        return self._rule.pool_too_rough

    def add(self, done: ShardDone) -> bool:
        """Append a shard; True when the campaign is to stop.

        Raises
        ------
        TooManyFailedError
            More episodes failed than the campaign allows.
        """
        self.specs.append(done.spec)
        self.files.append(done.files)
        self.sums.add(done.block)
        self.n_episodes += done.spec.n_episodes
        self.n_retraced += done.n_retraced
        self.n_crashes += int(done.block.crash.sum())
        self.n_failed += int(done.block.failed.sum())
        self._causes += done.failures
        self.repeated = self.repeated or done.repeated
        if self.n_episodes >= SMALLEST_FAILED_SAMPLE:
            self.require_few_failed()
        if not self._rule.due(self.n_episodes):
            return False
        estimate = self.sums.result(self._campaign.stop.confidence)
        return self._rule.observe(self.n_episodes, estimate)

    def require_few_failed(self) -> None:
        """Refuse an answer from tests of which too many failed.

        Raises
        ------
        TooManyFailedError
            More episodes failed than the campaign allows.
        """
        most = self._campaign.run.max_failed_share
        if self.n_failed > most * self.n_episodes:
            cause = "".join(f", {n} of them with: {why}" for why, n in self._causes.most_common(1))
            raise TooManyFailedError(
                "run.max_failed_share",
                found=f"{self.n_failed} of {self.n_episodes} episodes failed{cause}",
                expected=f"a share of at most {most:g}",
                mend="Mend the AV (`harness av-check` looks at it in seconds), or raise the share to go on. All causes "
                "are in the column 'failure' of the episodes table.",
            )
