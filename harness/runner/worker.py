"""What a worker process does: prepare once, then run one shard after another.

It also repeats a few of the first tests, to say whether the vehicle does the same again. What an episode brings about
follows from the campaign's seed and the episode's index, as long as the AV keeps to its observations and to the random
stream that it is given. Code that draws random numbers of its own, remembers earlier episodes, or shares state between
cells does not; its tests cannot be replayed, and depend on what ran beside them.
"""

from __future__ import annotations

import json
import pickle
from collections import Counter
from collections.abc import Mapping
from dataclasses import asdict, dataclass, field, replace
from multiprocessing.connection import Connection
from pathlib import Path

import numpy as np

from harness.controllers.hosts import Death
from harness.drawing import ShardRequest, Source
from harness.drawing.baseline import BaselineRequest, BaselineResult, read_baseline, run_baseline
from harness.episode.cells import PrescribedTraffic
from harness.episode.loop import EpisodeLoop, Shard, hash_of_index
from harness.estimators.block import Block
from harness.pool.replay import Retracing
from harness.processes import fit_to_travel
from harness.records.folder import encoded
from harness.records.schemas import ShardTables, shard_tables
from harness.resolved import Resolved
from harness.runner.resolve import prepare
from harness.vocabulary import FAILED
from harness.worlds import build_world
from harness.worlds.twin import TwinWorld

REPEATED = b"harness.repeated"
"""Key in the metadata of an episodes file: what repeating showed is there with the shard, or not at all."""
MOST_REPEATED, FEWEST_REPEATED = 10, 2
ONE_OF = 10
"""Ten tests of the first shard, less than 1 % from 1,000 tests on; of a shard below 100 tests a tenth, or two.

Of a vehicle that is random in one of four tests, ten miss all with a probability of 6 %.
"""


Bits = tuple[bytes, bytes, str | None]


@dataclass(frozen=True)
class Repeated:
    """How many tests were run once more, and which of them (campaign indices) came out otherwise."""

    n_episodes: int
    differing: tuple[int, ...]


@dataclass(frozen=True)
class ShardResult:
    """A finished shard: what the stop rule needs of it, how many episodes the twin has retraced, causes of failures.

    ``repeated`` is None where no test was run twice; ``parquet`` are its tables as files, or, where they are on disk
    already, ``files`` their paths by table.
    """

    request: ShardRequest
    block: Block
    n_retraced: int
    failures: Counter[str]
    repeated: Repeated | None
    parquet: dict[str, bytes] = field(default_factory=dict)
    files: dict[str, str] = field(default_factory=dict)


Request = ShardRequest | BaselineRequest
Result = ShardResult | BaselineResult
"""What a worker is asked for, and what it hands back."""


def serve(connection: Connection, resolved: Path, folder: Path, black_box: Path) -> None:
    """Prepare with the first shard, run shards until the parent is gone or has no more.

    The file ``resolved`` holds the campaign. In the run's ``folder`` stand the baseline runs that tests
    follow from, once there are some.
    """
    runner: ShardRunner | None = None
    while True:
        try:
            request, fatal_episodes = connection.recv()
        except (EOFError, OSError):
            break
        try:
            if runner is None:
                runner = ShardRunner(pickle.loads(resolved.read_bytes()), folder, black_box)  # noqa: S301 - our own
            answer: Result | Exception = runner.run(request, fatal_episodes)
        except Exception as error:  # noqa: BLE001 - whatever goes wrong here is the parent's to judge
            answer = fit_to_travel(error)
        try:
            connection.send(answer)
        except OSError:  # the parent was killed: nobody is left to tell
            break
    if runner is not None:
        runner.close()


class ShardRunner:
    """Runs shards of one campaign in one world. It writes nothing: the process that runs the campaign does.

    The file ``black_box`` tells that process in which call of a controller this one died.
    """

    def __init__(self, resolved: Resolved, folder: Path, black_box: Path | None = None) -> None:
        self._fatal_episodes: dict[int, Death] = {}
        self._folder = folder
        self._source = prepare(resolved)
        self._retracing = Retracing(resolved)
        self._begun = False
        world = build_world(resolved.campaign)
        self._loop: EpisodeLoop = self._source.loop(world, black_box=black_box, fatal_episodes=self._fatal_episodes)

    def close(self) -> None:
        """Release the AV's controllers."""
        self._loop.close()

    def run(self, request: Request, fatal_episodes: Mapping[int, Death] | None = None) -> Result:
        """Run a shard; episodes in ``fatal_episodes`` fail before the call that ended a process.

        Raises `WorldDisagreementError`: the twin retraces an episode differently.
        """
        self._fatal_episodes.clear()  # a baseline run may have the number of a test
        self._fatal_episodes.update(fatal_episodes or {})
        source, paths = self._source, self._source.baseline_paths
        if isinstance(request, ShardRequest):
            if paths is not None and not self._begun:
                self._begun = True
                source.begin_after(read_baseline(self._folder, paths, source.resolved.environment))
            return self._tests(request)
        if paths is None:
            raise ValueError("this campaign has no baseline runs")
        return run_baseline(self._loop, paths, source.resolved.environment, request)

    def _tests(self, request: ShardRequest) -> ShardResult:
        campaign, shard = self._source.campaign, self._source.run(self._loop, request)
        keep_traces = campaign.records.traces != "none" or campaign.records.trace_share > 0.0
        tables = shard_tables(shard, campaign.seed, keep_traces=keep_traces)
        # A vehicle must show that it does the same again: built-in models do, and outside programs need not.
        if request.index == 0 and campaign.av.model is None and campaign.av.traci is None:
            metadata = {**(tables.episodes.schema.metadata or {}), REPEATED: json.dumps(asdict(self._repeat(shard)))}
            tables = tables._replace(episodes=tables.episodes.replace_schema_metadata(metadata))
        return replace(finished(self._source, self._retracing, request, tables), parquet=encoded(tables))

    def _repeat(self, shard: Shard) -> Repeated:
        """Run some tests again, alone and after all the others."""
        campaign = self._source.campaign
        # The twin does one episode at little cost; an AV that SUMO moves has to be moved by SUMO again.
        alone = self._loop if campaign.av.sumo is not None else self._loop.beside(TwinWorld(1))
        rows = _rows_to_repeat(shard, campaign.seed, acts_early=campaign.av.acts_before_cut_in)
        differing = []
        for row in rows:
            traffic = PrescribedTraffic._make(column[row : row + 1] for column in shard.traffic)
            again = alone.run(shard.first_episode + row, shard.states[row : row + 1], traffic)
            if bits_of(shard, row) != bits_of(again, 0):
                differing.append(shard.first_episode + row)
        return Repeated(len(rows), tuple(sorted(differing)))


def finished(source: Source, retracing: Retracing, request: ShardRequest, tables: ShardTables) -> ShardResult:
    """What is to be known of a shard's tables, after the twin has retraced them."""
    n_retraced = retracing.check(tables.episodes)
    block = source.block(tables.episodes, tables.moments if source.campaign.stop.estimator == "scv" else None)
    failures = Counter(tables.episodes.column("failure").drop_null().to_pylist())
    return ShardResult(request, block, n_retraced, failures, repeated_of(tables.episodes.schema.metadata))


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


def repeated_of(metadata: Mapping[bytes, bytes] | None) -> Repeated | None:
    """What the metadata of an episodes table say of tests that were run twice; None of all but the first shard's."""
    found = (metadata or {}).get(REPEATED)
    if found is None:
        return None
    content = json.loads(found)
    return Repeated(content["n_episodes"], tuple(content["differing"]))
