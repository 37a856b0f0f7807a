"""The contiguous prefix of finished shards: which they are, and whether too many of their tests failed."""

from __future__ import annotations

from collections import Counter

from harness.campaign.models import Campaign
from harness.errors import TooManyFailedError
from harness.runner.repeat import Repeated
from harness.runner.shards import SMALLEST_FAILED_SAMPLE
from harness.runner.worker import ShardDone, ShardSpec


class Prefix:
    """Finished shards in order, from the first on.

    Attributes
    ----------
    repeated : Repeated or None
        What repeating some of the first tests has shown, once it is known.
    """

    def __init__(self, campaign: Campaign) -> None:
        self._campaign = campaign
        self.specs: list[ShardSpec] = []
        self.files: list[dict[str, str]] = []
        self.n_episodes = self.n_crashes = self.n_failed = self.n_retraced = 0
        self.repeated: Repeated | None = None
        self._causes: Counter[str] = Counter()

    def add(self, done: ShardDone) -> None:
        """Append a shard.

        Raises
        ------
        TooManyFailedError
            More episodes failed than the campaign allows.
        """
        self.specs.append(done.spec)
        self.files.append(done.files)
        self.n_episodes += done.spec.n_episodes
        self.n_retraced += done.n_retraced
        self.n_crashes += int(done.block.crash.sum())
        self.n_failed += int(done.block.failed.sum())
        self._causes += done.failures
        self.repeated = self.repeated or done.repeated
        if self.n_episodes >= SMALLEST_FAILED_SAMPLE:
            self.require_few_failed()

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
