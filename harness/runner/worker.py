"""What a worker process does: prepare once, then run one shard after another."""

from __future__ import annotations

import json
from collections import Counter
from collections.abc import Mapping
from dataclasses import dataclass, field
from pathlib import Path

import pyarrow as pa

from harness.campaign.models import Campaign
from harness.controllers.black_box import Death
from harness.episode.cells import PrescribedTraffic
from harness.episode.loop import EpisodeLoop, Shard
from harness.estimators.block import Block
from harness.estimators.from_records import block_from_tables
from harness.importance.build import mixture_weights
from harness.pool.shells import Draw, PrescribedEpisodes
from harness.records.folder import encoded
from harness.records.tables import ShardTables, shard_tables
from harness.resolved import Resolved
from harness.runner.prepare import Prepared, build_world, prepare
from harness.runner.repeat import Repeated, chosen_rows, has_to_be_shown, repeat
from harness.runner.retrace import Retracing
from harness.twin import TwinWorld

REPEATED = b"harness.repeated"
"""Key in the metadata of an episodes file."""


@dataclass(frozen=True)
class ShardSpec:
    """A fixed range of episodes; ``draws`` says which cut-ins they are, where they are prescribed."""

    index: int
    first_episode: int
    n_episodes: int
    draws: tuple[Draw, ...] = ()


@dataclass(frozen=True)
class ShardDone:
    """A finished shard: what the stop rule needs of it, how many episodes the twin has retraced, causes of failures.

    ``parquet`` holds its tables until they are written, ``files`` where they are from then on, relative to the folder.
    ``repeated`` is None for a shard none of whose tests were run twice.
    """

    spec: ShardSpec
    block: Block
    files: dict[str, str] = field(default_factory=dict)
    parquet: dict[str, bytes] = field(default_factory=dict)
    stored: bool = False
    n_retraced: int = 0
    failures: Counter[str] = field(default_factory=Counter)
    repeated: Repeated | None = None


class ShardRunner:
    """Runs shards of one campaign in one world. It writes nothing: the process that runs the campaign does.

    Parameters
    ----------
    resolved : Resolved
    black_box : Path, optional
        File that tells the parent in which call of a controller the process died.
    """

    def __init__(self, resolved: Resolved, black_box: Path | None = None) -> None:
        self._doomed: dict[int, Death] = {}
        self._prepared: Prepared = prepare(resolved)
        self._retracing = Retracing(resolved)
        self._loop: EpisodeLoop = self._prepared.loop(
            build_world(resolved.campaign), black_box=black_box, doomed=self._doomed
        )

    def close(self) -> None:
        """Release the AV's controllers."""
        self._loop.close()

    def run(self, spec: ShardSpec, doomed: Mapping[int, Death] | None = None) -> ShardDone:
        """Run a shard; episodes in ``doomed`` fail before the call that ended a process.

        Raises
        ------
        WorldDisagreementError
            The twin retraces an episode differently.
        """
        self._doomed.update(doomed or {})
        campaign = self._prepared.campaign
        shard = self._shard(spec)
        records = campaign.records
        keep_traces = records.traces != "none" or records.trace_share > 0.0
        tables = shard_tables(shard, campaign.seed, keep_traces=keep_traces)
        n_retraced = self._retracing.check(tables.episodes)
        repeated = self._repeat(shard) if spec.index == 0 and has_to_be_shown(campaign) else None
        parquet = encoded(with_repeated(tables, repeated))
        block, causes = shard_block(campaign, tables, self._prepared.prescribed), failure_causes(tables.episodes)
        return ShardDone(spec, block, parquet=parquet, n_retraced=n_retraced, failures=causes, repeated=repeated)

    def _repeat(self, shard: Shard) -> Repeated:
        campaign = self._prepared.campaign
        # The twin does one episode at little cost; an AV that SUMO moves has to be moved by SUMO again.
        alone = self._loop if campaign.av.sumo is not None else self._loop.beside(TwinWorld(1))
        rows = chosen_rows(shard, campaign.seed, acts_early=campaign.av.before_cut_in == "controller")

        def again(row: int) -> Shard:
            traffic = PrescribedTraffic._make(column[row : row + 1] for column in shard.traffic)
            return alone.run(shard.first_episode + row, shard.states[row : row + 1], traffic)

        return repeat(shard, rows, again)

    def _shard(self, spec: ShardSpec) -> Shard:
        prescribed = self._prepared.prescribed
        if prescribed is None:
            return self._loop.run(spec.first_episode, self._prepared.states(spec.first_episode, spec.n_episodes))
        states, traffic, rows = prescribed.episodes(spec.draws)
        shard = self._loop.run(spec.first_episode, states, traffic)
        shard.cut_ins = rows
        return shard


def with_repeated(tables: ShardTables, repeated: Repeated | None) -> ShardTables:
    """The tables, with what repeating showed in the file's own metadata: it is there with the shard, or not at all."""
    if repeated is None:
        return tables
    metadata = {**(tables.episodes.schema.metadata or {}), REPEATED: json.dumps(repeated.to_json())}
    return tables._replace(episodes=tables.episodes.replace_schema_metadata(metadata))


def stored_repeated(episodes: pa.Table) -> Repeated | None:
    """What `with_repeated` has put into a stored table."""
    found = (episodes.schema.metadata or {}).get(REPEATED)
    if found is None:
        return None
    content = json.loads(found)
    return Repeated(content["n_episodes"], tuple(content["differing"]))


def failure_causes(episodes: pa.Table) -> Counter[str]:
    """How often each cause failed an episode."""
    return Counter(episodes.column("failure").drop_null().to_pylist())


def shard_block(campaign: Campaign, tables: ShardTables, prescribed: PrescribedEpisodes | None = None) -> Block:
    """What the stop rule's estimator sees of a shard."""
    moments = tables.moments if campaign.stop.estimator == "scv" else None
    return block_from_tables(
        tables.episodes,
        moments,
        method=campaign.testing.method,
        alpha=mixture_weights(campaign),
        shells=None if prescribed is None else prescribed.design,
    )
