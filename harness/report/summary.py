"""What the report tells: a run folder's files, read and checked, and one pass over its episodes.

Whatever reads raises a `RunFolderError` that names a file which is missing, damaged, or of another run.
"""

from __future__ import annotations

import math
import os
import shlex
from collections import Counter
from collections.abc import Mapping
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path
from typing import Any

import numpy as np
import pyarrow as pa
import pyarrow.compute as pc
from pydantic import TypeAdapter, ValidationError

from harness.campaign.campaign import Campaign
from harness.errors import RunFolderError
from harness.estimators.answer import STORED_ESTIMATES, Estimates
from harness.estimators.block import outcome_places
from harness.estimators.estimate import Estimate
from harness.estimators.shells import ShellDetails
from harness.families import family_named
from harness.families.protocol import Environment, Family
from harness.records.folder import SHELLS, read_as, read_manifest
from harness.records.reader import ShownTests, by_kind, read_campaign, read_traces, traffic_of
from harness.sampling.shells import stored_design
from harness.strata import ShellDesign, weight_of_a_test
from harness.vehicles.kinematics import STEP_S
from harness.vocabulary import CRASH, FAILED, OUTCOMES, TIMEOUT, FloatArray


@dataclass(frozen=True)
class ShownShells(ShellDetails):
    """What the headline estimate of a shells run says about them."""

    rate: float
    design: ShellDesign

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
    """A finished run; ``design`` is None if its tests are not of shells, ``traffic`` if that cannot be driven in."""

    path: Path
    campaign: Campaign
    manifest: dict[str, Any]
    estimates: Estimates
    design: ShellDesign | None
    tests: ShownTests
    traffic: Environment | None

    @property
    def family(self) -> Family:
        """What its tests are of."""
        return family_named(self.campaign.scenario)

    @cached_property
    def shells(self) -> ShownShells | None:
        """What its shells say, if its tests are of any."""
        return None if self.design is None else _shells(self.path, self.estimates.best, self.design)

    def traces(self, episodes: set[int]) -> pa.Table | None:
        """Their stored motion; None where none of them was traced."""
        return read_traces(self.path, self.manifest["parts"], episodes)

    def crashes(self, episodes: set[int]) -> pa.Table:
        """What scenes need of crashes, in index order."""
        return self.tests.crashes.filter(pc.field("episode").isin(sorted(episodes)))


def typed(path: Path) -> str:
    """A folder as commands on its page name it: relative to the working directory, or by its bare name.

    An absolute path would tell everybody whom the page is mailed to where somebody keeps their files.
    """
    here, absolute = Path.cwd(), Path(os.path.abspath(path))  # noqa: PTH100 - resolve() would follow links
    return shlex.quote(str(absolute.relative_to(here)) if absolute.is_relative_to(here) else absolute.name)


def read_run_folder(path: Path, content: dict[str, Any] | None = None) -> RunFolder:
    """Read campaign, manifest, tests and, where they are not ``content``, estimates of a run."""
    manifest = read_manifest(path)
    estimates = STORED_ESTIMATES.validate_python(content or read_estimates(path, manifest))
    campaign = read_campaign(path, manifest)
    tests = ShownTests.stored(path, manifest, family_named(campaign.scenario))
    design = stored_design(path) if campaign.sampling.strata else None
    return RunFolder(path, campaign, manifest, estimates, design, tests, traffic_of(campaign, manifest))


def read_estimates(folder: Path, manifest: Mapping[str, Any]) -> Estimates:
    """``estimates.json`` of a run; a `RunFolderError` where it is missing, damaged, or of other tests."""
    path, again = folder / "estimates.json", f"Make it with `harness estimate {folder} --write`."
    if not manifest["n_episodes"]:
        again = "No test is finished: run `harness run` with --resume."
    estimates = read_as(Estimates, path, mend=again)
    found = f"estimates of {estimates.n_episodes:,} tests of campaign {estimates.campaign_hash}"
    expected = f"estimates of {manifest['n_episodes']:,} tests of campaign {manifest['campaign_hash']}"
    if found != expected:
        raise RunFolderError(str(path), found, f"{expected} (manifest.json)", again)
    if not isinstance(estimates.estimates.get(estimates.headline), Estimate):
        found = f"headline {estimates.headline!r}, of which there is no estimate"
        raise RunFolderError(str(path), found, f"one of {sorted(estimates.estimates)}", again)
    return estimates


def _shells(folder: Path, headline: Estimate, design: ShellDesign) -> ShownShells:
    try:
        of_run = {"rate": headline.crash_rate, "design": design}
        shells = TypeAdapter(ShownShells).validate_python({**headline.details, **of_run})
    except ValidationError as error:
        wrong = error.errors(include_url=False)[0]
        found = f"no complete description of shells ({'.'.join(map(str, wrong['loc']))}: {wrong['msg']})"
        expected = "what `harness estimate` writes for a run with testing.method shells"
        mend = f"Make it again with `harness estimate {folder} --write`."
        raise RunFolderError(str(folder / "estimates.json"), found, expected, mend) from error
    if shells.p_event != design.p_event:
        found, expected = (f"events of probability {p:.6g} per test" for p in (design.p_event, shells.p_event))
        mend = "Delete it, and run `harness run` with --resume, which makes what is missing."
        raise RunFolderError(str(folder / SHELLS), found, f"{expected} (estimates.json)", mend)
    return shells


@dataclass(frozen=True, eq=False)
class RunSummary:
    """Counts and weights of a run's tests, and the columns of those that plots need.

    ``count``, ``weight`` (5,) are episodes and sums of weights per outcome, in the order of `OUTCOMES`; ``causes``
    count failed episodes by kind of cause. A weight is what a test adds to the estimate: its likelihood ratio or, of
    tests from shells, p_s/n_s; failed tests have none. ``rows`` (m,) are ``outcome``, ``weight`` and the numbers of
    `ShownTests`, NaN where there is none. With ``all_weights_one`` no maneuver was drawn from an importance function.
    """

    count: FloatArray
    weight: FloatArray
    causes: Counter[str]
    rows: dict[str, FloatArray]
    all_weights_one: bool
    from_shells: bool

    @property
    def n_episodes(self) -> int:
        """Number of tests, failed ones included."""
        return int(self.count.sum())

    @property
    def n_crashes(self) -> int:
        """Number of sampled crashes."""
        return int(self.count[CRASH])

    @property
    def crashes(self) -> dict[str, FloatArray]:
        """`rows` of the crashes alone, and when they were: ``event_s`` and ``response_s`` (s)."""
        crashes = {name: column[self.rows["outcome"] == CRASH] for name, column in self.rows.items()}
        event_s = STEP_S * crashes["event_step"]
        return {**crashes, "event_s": event_s, "response_s": crashes["crash_time_s"] - event_s}

    def per_test(self, weight: float) -> float:
        """How often per naturalistic test something happens whose weights add up to ``weight``."""
        return weight if self.from_shells else weight / max(self.n_episodes, 1)


def floats(column: pa.Array) -> FloatArray:
    """A column of numbers as an array, NaN where it is null."""
    return np.asarray(column.cast(pa.float64()).to_numpy(zero_copy_only=False), dtype=np.float64)


def summarise(run: RunFolder) -> RunSummary:
    """Count and weigh the tests of a run; a `RunFolderError` where one has an unknown outcome."""
    tests, where = run.tests, str(run.path / "episodes")
    places = outcome_places(pa.chunked_array([[*tests.outcomes]]), where)
    count: FloatArray = np.bincount(places, [*tests.outcomes.values()], len(OUTCOMES)).astype(np.float64)
    names = [name for name in tests.rows.column_names if name != "outcome"]
    rows = {name: floats(tests.rows[name]) for name in names}
    outcome = outcome_places(tests.rows["outcome"], where).astype(np.int64)
    left_out: FloatArray = count - np.bincount(outcome, minlength=len(OUTCOMES))  # those weigh 1 each
    if (least_mps := run.campaign.crash.counts_above_mps) > 0.0:  # no harder is none here, as in the estimates
        outcome[(outcome == CRASH) & (rows["impact_speed_mps"] <= least_mps)] = TIMEOUT
    count = left_out + np.bincount(outcome, minlength=len(OUTCOMES))
    rows["outcome"] = outcome.astype(np.float64)
    if run.shells is None:
        weight = np.exp(rows["log_weight"])
    else:
        p, n = np.array([(shell.p, shell.n_episodes) for shell in run.shells.shells]).T
        weight = weight_of_a_test(p, n.astype(np.int64))[rows["component"].astype(np.int64)]
    rows["weight"] = np.where(outcome == FAILED, 0.0, weight)
    weight = left_out + np.bincount(outcome, weights=rows["weight"], minlength=len(OUTCOMES))
    weight[FAILED] = 0.0
    all_one = not rows["log_weight"][outcome != FAILED].any()
    return RunSummary(count, weight, by_kind(tests.causes), rows, all_one, run.shells is not None)
