"""What ``manifest.json`` of a run may hold; it comes checked from `harness.records.folder.read_manifest`.

A key that is not named here is let through: later versions add some. One that is missing, as in older folders, is no
error, but for the three without which nothing can be read.
"""

from __future__ import annotations

from typing import Annotated, Any, Literal

from pydantic import BaseModel, ConfigDict, Field

StoppedBy = Literal["rhw", "accept", "contradicted", "two_phase", "episodes", "pool", "pool_error"]
"""The asked precision, a decision about the limit, a vehicle that does not do what the deciding statement assumes, the
number of tests planned for a precision, the budget, the last cut-in that the pool holds of a shell that needs more, or
the pool's own error, which alone is wider than that."""
Count = Annotated[int, Field(ge=0, lt=2**63)]
ShardPath = Annotated[str, Field(pattern=r"^[a-z]+/[A-Za-z0-9_-]+\.parquet$")]


class Stored(BaseModel):
    """Strict in the types of the keys that it names."""

    model_config = ConfigDict(extra="allow", strict=True, allow_inf_nan=False)


class Files(Stored):
    """Files of a shard, by table."""

    episodes: ShardPath
    moments: ShardPath | None = None
    traces: ShardPath | None = None


class StoredShard(Stored):
    """A contiguous range of episodes, and its files by table."""

    index: Count
    first_episode: Count
    n_episodes: Count
    files: Files


class Retraced(Stored):
    """How many episodes the twin has retraced in which columns, or why none."""

    n_episodes: Count | None = None
    compared: list[str] | None = None
    reason: str | None = None


class Repeated(Stored):
    """What repeating some tests has shown; `harness.runner.repeat.Repeated`."""

    n_episodes: Count
    differing: list[Count]


class StoredBaseline(Stored):
    """Shadow runs of a vehicle that acts before the cut-in."""

    n_runs: Count
    n_failed: Count


class StoredManifest(Stored):
    """The manifest of a run."""

    campaign_hash: str
    n_episodes: Count
    shards: list[StoredShard]
    name: str | None = None
    created: str | None = None
    seed: Count | None = None
    engine: str | None = None
    reproducible: bool | None = None
    versions: dict[str, str] = {}
    cpu: str | None = None
    controller_sha256: str | None = None
    workers: Count | None = None
    status: str | None = None
    stopped_by: StoppedBy | None = None
    wall_time_s: float | None = None
    distance_per_test_m: float | None = None
    ending: str | None = None
    decision: dict[str, Any] | None = None
    retraced: Retraced | None = None
    repeated: Repeated | None = None
    shadow_runs: StoredBaseline | None = None
    reported_from: Count | None = None
