"""Tests that are run again, to see whether the vehicle does the same: every bit of their results is compared.

A test's results follow from the campaign's seed and the test's index, as long as the AV uses nothing but its
observations and the random stream that it is given. Code that draws random numbers of its own, remembers earlier tests,
shares state between cells, or asks a clock or its process does not; its tests cannot be replayed, and depend on what
ran beside them.
"""

from __future__ import annotations

from collections.abc import Sequence
from contextlib import closing
from typing import NamedTuple

import numpy as np

from harness.campaign.campaign import Campaign
from harness.campaign.vehicle import AutomatedVehicle
from harness.controllers.clock import Clock
from harness.controllers.find import AvEndedProcessError, build_host, has_foreign_code, run_apart
from harness.errors import CampaignError
from harness.loop.loop import EpisodeLoop, RecordPolicy, Scenario, Shard, hash_of_index
from harness.loop.repeat import Traffic
from harness.records.folder import Repeated
from harness.sampling.protocol import ShardRequest, Source
from harness.vocabulary import CRASH, FAILED
from harness.worlds.twin import TwinWorld

MOST_REPEATED, FEWEST_REPEATED = 10, 2
ONE_OF = 10
"""A tenth of a shard's tests are repeated, two at least and ten at most, half of them crashes if it has any: there a
rare fault shows. Of a vehicle that is random in one of four tests, ten tests show nothing with a probability of 6 %."""

Bits = tuple[bytes, bytes, str | None]
DrawnTests = tuple[int, Traffic]
"""Consecutive tests: the first one's index, and what the others do in them."""


class Again(NamedTuple):
    """Results of tests, in order, and the places in the vehicle's code where it has looked at a clock."""

    bits: list[Bits]
    clock_read_at: list[str]


def bits_of(shard: Shard, row: int) -> Bits:
    """Everything that a test has left: its record, its motion if that was kept, and why it failed if it did."""
    trace = shard.traces.get(row)
    record = shard.episode[row].tobytes()
    return record, b"" if trace is None else trace.tobytes(), shard.failures.get(row)


def run_elsewhere(source: Source, tests: Sequence[DrawnTests], n_cells: int = 1, *, held: bool = False) -> Again:
    """Run tests one after the other in a fresh process, by a clock of its own (`harness.controllers.clock`)."""
    av = source.campaign.av
    return run_apart(av, _run_here, av, source.scenario, source.records(), tests, n_cells, held)


def _run_here(
    av: AutomatedVehicle, scenario: Scenario, keep: RecordPolicy, tests: Sequence[DrawnTests], n_cells: int, held: bool
) -> Again:
    clock, bits = Clock(held=held), list[Bits]()
    with clock.shown():
        host = build_host(av, n_cells=n_cells, seed=scenario.seed, names=scenario.shown)
        with closing(EpisodeLoop(TwinWorld(n_cells, scenario.vehicles), scenario, keep, host)) as loop:
            for first, traffic in tests:
                shard = loop.run(first, traffic)
                bits += [bits_of(shard, row) for row in range(len(traffic))]
    return Again(bits, clock.read_at)


def is_repeated(request: ShardRequest) -> bool:
    """Whether tests of a shard are run twice: in the first, and whenever the number of tests has grown fourfold."""
    first, end = request.first_episode, request.first_episode + request.n_episodes
    return (end.bit_length() + 1) // 2 > (first.bit_length() + 1) // 2


def repeat(loop: EpisodeLoop, source: Source, shard: Shard) -> Repeated:
    """Run some tests of a loop's shard again, one at a time: a user's code in a fresh process, others in the loop."""
    rows = _rows_to_repeat(shard, source.campaign)
    tests = [(shard.first_episode + row, shard.traffic.rows(slice(row, row + 1))) for row in rows]
    if has_foreign_code(source.campaign.av):
        again = _each_elsewhere(source, tests)
    else:
        again = [bits_of(loop.run(*test), 0) for test in tests]
    pairs = zip(rows, again, strict=True)
    return Repeated(len(rows), sorted(shard.first_episode + row for row, bits in pairs if bits != bits_of(shard, row)))


def _each_elsewhere(source: Source, tests: list[DrawnTests]) -> list[Bits | None]:
    """Bits of each test; None where it ends its process, or its controller cannot be made once more."""
    try:
        return [*run_elsewhere(source, tests).bits]
    except (AvEndedProcessError, CampaignError, OSError):
        half = len(tests) // 2
        return [None] if not half else _each_elsewhere(source, tests[:half]) + _each_elsewhere(source, tests[half:])


def _rows_to_repeat(shard: Shard, campaign: Campaign) -> list[int]:
    """Rows of the tests to repeat, by a hash of their index among those in which the AV had to act."""
    episode = shard.episode
    acted = (episode["outcome"] != FAILED) & (campaign.av.acts_before_event | (episode["event_step"] >= 0))
    rows = np.flatnonzero(acted)
    rows = rows[np.argsort(hash_of_index(campaign.seed, shard.first_episode + rows), kind="stable")]
    n = min(MOST_REPEATED, max(FEWEST_REPEATED, episode.size // ONE_OF))
    crashed = rows[episode["outcome"][rows] == CRASH][: n // 2]
    return [*map(int, crashed), *map(int, rows[~np.isin(rows, crashed)])][:n]
