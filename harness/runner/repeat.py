"""A run repeats a few of its own tests, and says whether the vehicle did the same again.

What an episode brings about follows from the campaign's seed and the episode's index, as long as the AV keeps to its
observations and to the random stream that it is given. Code that draws random numbers of its own, remembers earlier
episodes, or shares state between cells does not; its tests cannot be replayed, and depend on what ran beside them.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import asdict, dataclass
from typing import Any

import numpy as np

from harness.arrays import IntArray
from harness.campaign.models import Campaign
from harness.episode.loop import Shard, hash_of_index
from harness.outcomes import FAILED

MOST_REPEATED, FEWEST_REPEATED = 10, 2
ONE_OF = 10
"""Ten tests of the first shard, less than 1 % from 1,000 tests on; of a shard below 100 tests a tenth, or two.

Of a vehicle that is random in one of four tests, ten miss all with a probability of 6 %.
"""


@dataclass(frozen=True)
class Repeated:
    """How many tests were run once more, and which of them (campaign indices) came out otherwise."""

    n_episodes: int
    differing: tuple[int, ...]

    def to_json(self) -> dict[str, Any]:
        """As the manifest has it."""
        return {**asdict(self), "differing": list(self.differing)}


def has_to_be_shown(campaign: Campaign) -> bool:
    """Whether a vehicle must show that it does the same again: built-in models do, and outside programs need not."""
    return campaign.av.model is None and campaign.av.traci is None


def chosen_rows(shard: Shard, seed: int, *, acts_early: bool) -> list[int]:
    """Rows of a shard's tests to be repeated: by a hash of their index, among those in which the AV had to act."""
    episode = shard.results.episode
    acted = (episode["outcome"] != FAILED) & (acts_early | (episode["cut_in_step"] >= 0))
    rows: IntArray = np.flatnonzero(acted)
    order = np.argsort(hash_of_index(seed, shard.first_episode + rows), kind="stable")
    n = min(MOST_REPEATED, max(FEWEST_REPEATED, episode.size // ONE_OF))
    return [int(row) for row in rows[order[:n]]]


def repeat(shard: Shard, rows: list[int], again: Callable[[int], Shard]) -> Repeated:
    """Compare tests with what ``again`` makes of a row, alone and after all the others."""
    differing = [row for row in rows if bits_of(shard, row) != bits_of(again(row), 0)]
    return Repeated(len(rows), tuple(sorted(shard.first_episode + row for row in differing)))


def bits_of(shard: Shard, row: int) -> tuple[bytes, bytes, str | None]:
    """Everything that a test has left: its record, its motion where that was kept, and why it failed if it did."""
    trace = shard.traces.get(row)
    record = shard.results.episode[row].tobytes()
    return record, b"" if trace is None else trace.tobytes(), shard.failures.get(row)
