"""What a run folder holds, read and checked before anything is drawn from it.

Whatever reads raises a `RunFolderError` that names a file which is missing, damaged, or of another run.
"""

from __future__ import annotations

import math
import os
import shlex
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import pyarrow as pa
from pydantic import TypeAdapter, ValidationError

from harness.campaign.campaign import Campaign
from harness.campaign.files import load_campaign
from harness.errors import CampaignError, RunFolderError
from harness.estimators.shells import ShellDetails, Within
from harness.records.folder import MANIFEST, NO_RUN, concatenated, read_json, read_manifest, require_schema
from harness.records.reader import read_shards
from harness.records.stored_manifest import Count, Stored, StoredManifest
from harness.strata import ASSUMPTION_FREE
from harness.vocabulary import FloatArray

ROWS_TOGETHER = 5_000
"""Of small shards: each batch costs a millisecond."""


class ShownManifest(StoredManifest):
    """A manifest with what the page shows of every run."""

    created: str
    versions: dict[str, str]
    seed: Count


class StoredEstimate(Stored):
    """What the page reads of an estimate, or the reason why there is none."""

    crash_rate: float | None
    reason: str | None = None
    ci_low: float | None = None
    ci_high: float | None = None
    upper_bound: float | None = None
    rhw: float | None = None
    n_episodes: int | None = None
    n_crashes: int | None = None
    n_effective: float | None = None
    largest_weight_share: float | None = None
    weight_cap: float | None = None
    method: str | None = None
    warnings: list[str] = []
    details: dict[str, Any] = {}


class StoredPoint(Stored):
    """The headline estimate of the first ``n`` tests."""

    n: float
    crash_rate: float | None
    ci_low: float | None
    ci_high: float | None
    rhw: float | None


class StoredEstimates(Stored):
    """What the page reads of ``estimates.json``."""

    campaign: str
    campaign_hash: str
    lane_change_level: float
    confidence: float
    headline: str
    estimates: dict[str, StoredEstimate]
    statement: str
    decision: dict[str, Any] | None = None
    reference_statements: list[str] = []
    boundary_statements: dict[str, str] = {}
    n_episodes: int | None = None
    distance_per_test_km: float | None = None
    diagnostics: dict[str, Any] | None = None
    convergence: list[StoredPoint] | None = None


@dataclass(frozen=True)
class ShownShells(ShellDetails):
    """What the headline estimate of a shells run says about them."""

    rate: float

    @property
    def widest(self) -> Within:
        """The statement with the widest boundary."""
        return self.statements[-1]

    @property
    def n_inside(self) -> int:
        """Number of shells within the widest boundary, which come first."""
        return self.widest.n_shells

    def narrowest(self, place: int) -> str:
        """Which boundary a shell is inside of, the narrowest one."""
        names = (f"inside {each.name}" for each in self.statements if place < each.n_shells)
        return next(names, "outside")

    @property
    def has_outside(self) -> bool:
        """Whether there are cut-ins beyond the boundary."""
        return self.n_inside < len(self.shells)

    @property
    def pool_half_width(self) -> float:
        """What the pool's own error leaves open of the rate."""
        return self.rhw_from_pool * self.rate

    def share_of_uncertainty(self, half_width: float) -> float:
        """Share in the sum of squared half-widths, which is what makes the interval of the rate."""
        squares = math.fsum(shell.half_width**2 for shell in self.shells) + self.pool_half_width**2
        return half_width**2 / squares if squares > 0.0 else math.nan


@dataclass(frozen=True)
class RunFolder:
    """A finished run: its campaign, manifest and estimates; ``shells`` is None where tests were drawn otherwise.

    ``typed`` is how commands on the page name it.
    """

    path: Path
    campaign: Campaign
    manifest: dict[str, Any]
    estimates: StoredEstimates
    shells: ShownShells | None
    typed: str

    @property
    def n_episodes(self) -> int:
        """Number of tests that count: the prefix at which the run stopped."""
        return int(self.manifest["n_episodes"])

    @property
    def headline(self) -> StoredEstimate:
        """The estimate that answers the campaign's question."""
        return self.estimates.estimates[self.estimates.headline]

    @property
    def asked_statement(self) -> str | None:
        """The statement about a boundary that should reach ``stop.rhw``; None for the assumption-free one."""
        testing = self.campaign.testing
        asked = testing.shells.statement if testing.method == "shells" else ASSUMPTION_FREE
        return None if asked == ASSUMPTION_FREE else asked

    def episodes(self, *columns: str) -> Iterator[pa.RecordBatch]:
        """Columns of the tests that count, in index order; small shards come together."""
        counted = self.n_episodes
        together: list[pa.Table] = []
        for table, _ in read_shards(self.path, episode_columns=list(columns), moment_columns=[]):
            together.append(table.slice(0, counted))
            counted -= together[-1].num_rows
            if sum(part.num_rows for part in together) >= ROWS_TOGETHER:
                yield from concatenated(together, self.path).to_batches()
                together = []
        if together:
            yield from concatenated(together, self.path).to_batches()


def floats(column: pa.Array) -> FloatArray:
    """A column of numbers as an array, NaN where it is null."""
    return np.asarray(column.cast(pa.float64()).to_numpy(zero_copy_only=False), dtype=np.float64)


def typed_folder(folder: Path) -> str:
    """Return the folder as it is typed in a shell: relative to the working directory, or its bare name.

    The bare name stands for a folder that is not below the working directory. An absolute path would say where somebody
    keeps their files to everybody whom the page is mailed to.
    """
    here = Path.cwd()
    unlinked = Path(os.path.abspath(folder))  # noqa: PTH100 - resolve() would leave by a link what was typed below `here`
    for path in (unlinked, folder.resolve()):
        if path.is_relative_to(here):
            return shlex.quote(path.relative_to(here).as_posix())
    return shlex.quote(folder.resolve().name)


def read_run_folder(path: Path, *, typed: str | None = None) -> RunFolder:
    """Read campaign, manifest and estimates of a run; ``typed`` see `RunFolder`."""
    manifest = read_manifest(path)
    require_schema(manifest, ShownManifest, path / MANIFEST, mend=NO_RUN)
    estimates = _read_estimates(path, manifest["campaign_hash"])
    shells = _shells(path, estimates.estimates[estimates.headline])
    campaign = _read_campaign(path / "campaign.yaml")
    return RunFolder(path, campaign, manifest, estimates, shells, typed or typed_folder(path))


def _read_campaign(path: Path) -> Campaign:
    try:
        return load_campaign(path, check_files=False)
    except CampaignError as error:
        raise RunFolderError(
            str(path),
            found=error.found if error.where == str(path) else f"{error.found} ({error.where})",
            expected="a campaign with all its sections, as the run has written it",
            mend="Restore the file, or run the campaign again.",
        ) from error


def _read_estimates(folder: Path, campaign_hash: str) -> StoredEstimates:
    path, again = folder / "estimates.json", f"Make it again with `harness estimate {folder} --write`."
    content = read_json(path, mend=again)
    require_schema(content, StoredEstimates, path, mend=again)
    estimates = StoredEstimates.model_validate(content)
    if estimates.campaign_hash != campaign_hash:
        raise RunFolderError(
            str(path),
            found=f"estimates of campaign {estimates.campaign_hash}",
            expected=f"those of campaign {campaign_hash} (manifest.json)",
            mend=again,
        )
    if estimates.headline not in estimates.estimates:
        raise RunFolderError(
            str(path),
            found=f"headline {estimates.headline!r}, which is not among the estimates",
            expected=f"one of {sorted(estimates.estimates)}",
            mend=again,
        )
    return estimates


def _shells(folder: Path, headline: StoredEstimate) -> ShownShells | None:
    if "shells" not in headline.details:
        return None
    try:
        return TypeAdapter(ShownShells).validate_python({**headline.details, "rate": headline.crash_rate})
    except ValidationError as error:
        wrong = error.errors(include_url=False)[0]
        raise RunFolderError(
            str(folder / "estimates.json"),
            found=f"no complete description of shells ({'.'.join(map(str, wrong['loc']))}: {wrong['msg']})",
            expected="what `harness estimate` writes for a run with testing.method shells",
            mend=f"Make it again with `harness estimate {folder} --write`.",
        ) from error
