"""How well a driver predicts an AV's crashes: the same stored tests, once with the AV, once with the driver."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import pyarrow as pa

from harness.campaign.campaign import Campaign
from harness.episode.trajectory import Followers
from harness.pool.library import LibraryDriver, library_records
from harness.pool.replay import PATH_COLUMNS, drivers_crash
from harness.records.folder import read_manifest, read_table
from harness.threads import made_ahead
from harness.traffic.loading import load_environment
from harness.vocabulary import BoolArray, FloatArray, IntArray

_COLUMNS = [*PATH_COLUMNS, "outcome", "component", "log_weight"]


@dataclass(frozen=True, eq=False)
class Replayed:
    """Stored tests, failed ones left out, and who crashes in them.

    ``episode`` (n,) is the index in the campaign; ``probability`` (n,) the likelihood ratio, with shells the
    probability of the test's ``stratum`` (n,), which is 0 without; ``av`` (n,) says whether the AV crashed, ``drivers``
    (n, D) whether each driver would have.
    """

    episode: IntArray
    probability: FloatArray
    stratum: IntArray
    av: BoolArray
    drivers: BoolArray

    def apart_from(self, episodes: IntArray) -> Replayed:
        """All tests but some."""
        kept = ~np.isin(self.episode, episodes)
        return Replayed(*(values[kept] for values in vars(self).values()))

    @property
    def weight(self) -> FloatArray:
        """What a crash in each test contributes to the crash rate, shape (n,)."""
        weight: FloatArray = self.probability / np.bincount(self.stratum)[self.stratum]
        return weight


@dataclass(frozen=True)
class Prediction:
    """Crashes of the AV against those of a driver, by number and by weight.

    Crash rates are weighted, per test. ``caught`` is the share of the AV's crash rate in tests in which the driver
    crashes too, None without a crash of the AV; ``false_alarms`` the share of the driver's in tests in which the AV
    does not crash, None without a crash of the driver.
    """

    both: int
    only_av: int
    only_driver: int
    neither: int
    crash_rate: float
    crash_rate_driver: float
    caught: float | None
    false_alarms: float | None


def predict(replayed: Replayed, driver: int) -> Prediction:
    """How well one of the drivers predicts the AV's crashes in these tests."""
    av, other, weight = replayed.av, replayed.drivers[:, driver], replayed.weight
    rate, rate_driver, rate_both = (float(weight[who].sum()) for who in (av, other, av & other))
    return Prediction(
        both=int((av & other).sum()),
        only_av=int((av & ~other).sum()),
        only_driver=int((~av & other).sum()),
        neither=int((~av & ~other).sum()),
        crash_rate=rate,
        crash_rate_driver=rate_driver,
        caught=rate_both / rate if rate > 0.0 else None,
        false_alarms=1.0 - rate_both / rate_driver if rate_driver > 0.0 else None,
    )


def replay_drivers(folder: Path, campaign: Campaign, drivers: Sequence[LibraryDriver]) -> Replayed:
    """Put drivers in the place of the AV in all tests of a run.

    Raises
    ------
    RunFolderError
        Records are missing or damaged.
    """
    environment = load_environment(campaign.environment)
    followers = Followers(library_records(drivers, environment))

    def replayed(shard: dict[str, Any]) -> list[np.ndarray]:
        table = read_table(folder / shard["files"]["episodes"], _COLUMNS)
        outcome = np.array(table.column("outcome").cast(pa.string()).to_pylist())
        component = np.asarray(table.column("component")).astype(np.int64)
        columns = (
            np.asarray(table.column("episode")),
            np.exp(np.asarray(table.column("log_weight"))),
            component if campaign.testing.method == "shells" else np.zeros_like(component),
            outcome == "crash",
            drivers_crash(table, campaign.seed, environment, followers),
        )
        return [values[outcome != "failed"] for values in columns]

    parts = made_ahead(replayed, read_manifest(folder)["shards"])
    return Replayed(*(np.concatenate(column) for column in zip(*parts, strict=True)))
