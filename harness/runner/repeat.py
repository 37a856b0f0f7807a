"""A few of the first tests once more, to say whether the vehicle does the same again.

What an episode brings about follows from the campaign's seed and the episode's index, as long as the AV keeps to its
observations and to the random stream that it is given. Code that draws random numbers of its own, remembers earlier
episodes, or shares state between cells does not; its tests cannot be replayed, and depend on what ran beside them.
"""

from __future__ import annotations

import json
from dataclasses import asdict

import numpy as np
import pyarrow as pa

from harness.campaign.campaign import Campaign
from harness.episode.cells import PrescribedTraffic
from harness.episode.loop import EpisodeLoop, Shard, hash_of_index
from harness.records.folder import Repeated
from harness.vocabulary import FAILED
from harness.worlds.twin import TwinWorld

REPEATED = b"harness.repeated"
"""Key in the metadata of an episodes file: what repeating showed is there with the shard, or not at all."""
MOST_REPEATED, FEWEST_REPEATED = 10, 2
ONE_OF = 10
"""Ten tests of the first shard, less than 1 % from 1,000 tests on; of a shard below 100 tests a tenth, or two.

Of a vehicle that is random in one of four tests, ten miss all with a probability of 6 %.
"""

Bits = tuple[bytes, bytes, str | None]


def repeat(loop: EpisodeLoop, campaign: Campaign, shard: Shard) -> Repeated:
    """Run some tests of a loop's shard again, alone and after all the others."""
    # The twin does one episode at little cost; an AV that SUMO moves has to be moved by SUMO again.
    alone = loop if campaign.av.sumo is not None else loop.beside(TwinWorld(1))
    rows = _rows_to_repeat(shard, campaign.seed, acts_early=campaign.av.acts_before_cut_in)
    differing = []
    for row in rows:
        traffic = PrescribedTraffic._make(column[row : row + 1] for column in shard.traffic)
        again = alone.run(shard.first_episode + row, shard.states[row : row + 1], traffic)
        if bits_of(shard, row) != bits_of(again, 0):
            differing.append(shard.first_episode + row)
    return Repeated(len(rows), sorted(differing))


def _rows_to_repeat(shard: Shard, seed: int, *, acts_early: bool) -> list[int]:
    """Rows by a hash of their index, among those in which the AV had to act."""
    episode = shard.results.episode
    acted = (episode["outcome"] != FAILED) & (acts_early | (episode["cut_in_step"] >= 0))
    rows = np.flatnonzero(acted)
    order = np.argsort(hash_of_index(seed, shard.first_episode + rows), kind="stable")
    n = min(MOST_REPEATED, max(FEWEST_REPEATED, episode.size // ONE_OF))
    return [int(row) for row in rows[order[:n]]]


def bits_of(shard: Shard, row: int) -> Bits:
    """Everything that a test has left: its record, its motion where that was kept, and why it failed if it did."""
    trace = shard.traces.get(row)
    record = shard.results.episode[row].tobytes()
    return record, b"" if trace is None else trace.tobytes(), shard.failures.get(row)


def with_repeated(episodes: pa.Table, repeated: Repeated) -> pa.Table:
    """The table of the first shard, with what repeating has shown."""
    return episodes.replace_schema_metadata(
        {**(episodes.schema.metadata or {}), REPEATED: json.dumps(asdict(repeated))}
    )


def repeated_of(episodes: pa.Table) -> Repeated | None:
    """What an episodes table says of tests that were run twice; None of all but the first shard's."""
    found = (episodes.schema.metadata or {}).get(REPEATED)
    return None if found is None else Repeated(**json.loads(found))
