"""A stored run of shells in other traffic: the shells' probabilities there, and crash shares as they were.

Traffic decides how probable an event is. Whether a vehicle crashes on one depends on traffic only through what LV and
BV do afterwards, and through which events a shell has. So crash shares within shells are taken to be the same. The
reference drivers, of which no shell is made, show how far that holds: their rates by the same rule are compared with
those that the pool enumerates. They do not show it for a vehicle that crashes on few events of its shells, as other
traffic may have more of these. It gets upper limits alone, in traffic close by. Traffic with events that no test stands
for is refused.
"""

from __future__ import annotations

import math
from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from pathlib import Path
from typing import Any

import numpy as np

from harness.errors import CampaignError, RunFolderError
from harness.estimators.block import Block
from harness.estimators.likelihood import Level, likelihood_limit
from harness.estimators.shells import SeenShells
from harness.estimators.traffic import LEAST_SHARE, mean_share
from harness.numbers import share
from harness.pool.build import campaign_pool
from harness.pool.moved import FewPaths, OnPaths, environment_with, ranges, ratio_of
from harness.pool.shells import Pool, design_shells, tested_limit
from harness.progress import Progress
from harness.records.folder import CAMPAIGN, read_manifest
from harness.records.reader import read_campaign, require_campaign
from harness.resolved import Resolved, resolve
from harness.runner.stored import stored_blocks
from harness.sampling.shells import stored_design
from harness.strata import ShellDesign
from harness.vocabulary import FloatArray

MOST_BEYOND = 0.01
"""Share of the probability in a shell, as it crashes, that may lie where no event of the old pool does [assumed]."""
SAME_POOL = 0.05
"""How far a pool that another version has built may differ [assumed]."""
MOST_OFF = 0.05
"""How far the rate of a reference driver may come out wrong [assumed; docs/environment.md says what it misses]."""
FAR_OFF = 0.5
"""As `MOST_OFF`, in traffic close by, where each rate is taken to be as wrong as the drivers' [assumed]."""
OPTION = "--environment"
ELSEWHERE = "Run the campaign in that environment, into another folder."


@dataclass(frozen=True, eq=False)
class StoredShells:
    """A stored run of shells, and some ``traffic`` that it is to answer for.

    It was run in the traffic ``here``, from its ``pool``, with the strata ``tested``; ``manifest`` and ``blocks`` are
    the run's. ``design`` are the same strata with their probabilities in ``traffic``.
    """

    folder: Path
    manifest: Mapping[str, Any]
    blocks: Sequence[Block]
    here: Resolved
    tested: ShellDesign
    pool: Pool
    traffic: Resolved
    design: ShellDesign

    @classmethod
    def of(cls, folder: str | Path, progress: Progress, option: str = OPTION) -> StoredShells:
        """Raises `HarnessError`: the folder is no run of shells, or its pool cannot be made again."""
        folder = Path(folder)
        manifest = read_manifest(folder)
        campaign = read_campaign(folder, manifest, check_files=True)
        if not campaign.sampling.strata or campaign.has_baseline_runs:
            acts = "a vehicle that acts before the event: its events follow from its own runs"
            found = acts if campaign.sampling.strata else f"tests by {campaign.testing.method}"
            expected = "tests of shells, of a vehicle that holds its speed until the event"
            raise CampaignError(option, found, expected, ELSEWHERE)
        here = resolve(campaign)
        require_campaign(folder / CAMPAIGN, here.content_hash, manifest)
        design, pool = stored_design(folder), campaign_pool(here, progress)
        rebuilt = design_shells(pool, tested_limit(campaign))
        if design.strata != rebuilt.strata or not np.allclose(design.p, rebuilt.p, rtol=SAME_POOL):
            expected = f"shells as those of pool {pool.key}"
            mend = "Use the version of the harness (manifest.json) and the surrogate library that it was made with."
            raise RunFolderError(str(folder), f"tests of pool {design.pool}", expected, mend)
        blocks = list(stored_blocks(folder, moments=False))
        return cls(folder, manifest, blocks, here, design, pool, here, design)

    @cached_property
    def seen(self) -> SeenShells:
        """Its tests, counted."""
        return SeenShells.of_blocks(self.blocks)

    @property
    def mean_share(self) -> float:
        """See `harness.estimators.traffic.mean_share`."""
        return mean_share(self.tested.p, self.seen.tally.share)

    @property
    def holds(self) -> bool:
        """Whether shares may be taken to stay the same."""
        return self.mean_share >= LEAST_SHARE

    def rate(self, p: FloatArray) -> float:
        """Crash rate where strata have probabilities ``p`` (S,); its upper limit where no test crashed."""
        tally = self.seen.tally
        return float(p @ tally.share) if tally.crashes.any() else self.limit(p)

    def limit(self, p: FloatArray, *, at_worst: bool = False) -> float:
        """Upper limit of the rate; ``at_worst`` counts all tests as crashes of strata where less than half crashed."""
        worst = self.seen.tally.failed_as_crashes()
        few = at_worst & (worst.crashes > 0) & (worst.crashes < LEAST_SHARE * worst.tests)
        crashes = np.where(few, worst.tests, worst.crashes)
        return likelihood_limit(p, crashes, worst.tests, Level.two_sided(0.9), 1.0)

    @property
    def is_same(self) -> bool:
        """Whether the traffic is that of the tests."""
        return self.design is self.tested

    def block(self, block: Block) -> Block:
        """Tests with their weights in ``traffic``, where each path's events change as those of all paths together."""
        if self.is_same:
            return block
        times = ratio_of(self.design.cell_p, self.tested.cell_p, of_nothing=0.0)
        columns = {**block.columns, "cell_mass": block.cell_mass * times}
        with np.errstate(divide="ignore"):
            log_weight = np.log(self.design.p[block.stratum])
        return replace(block, columns=columns, drawn=replace(block.drawn, shells=self.design), log_weight=log_weight)

    def reference_error(self) -> float:
        """Largest relative error of a reference driver's rate, if that follows from its shares of the strata."""
        by_shares, rate = self.design.p @ reference_shares(self.tested), self.design.reference_rate
        return float(np.max(np.abs(by_shares[rate > 0.0] / rate[rate > 0.0] - 1.0), initial=0.0))

    def nearby(self, rows: Iterable[Mapping[str, float]], progress: Progress) -> Iterator[Nearby | None]:
        """For each row of other numbers: the same traffic with these, by few paths; None where they give no laws.

        Of a vehicle whose shares may change with the traffic, the factor is that of its upper limit.
        """
        environments = [environment_with(self.traffic, row) for row in rows]
        valid = [environment for environment in environments if environment is not None]
        progress.stage("other traffic", len(valid))
        p, shares = self.design.p, reference_shares(self.tested)
        paths = FewPaths(self.traffic, self.pool, self.tested, tested_limit(self.here.campaign), progress)
        (base,) = paths.of([self.traffic.environment])
        on_paths = paths.of(valid)
        crash_share = self.seen.tally.share if self.seen.tally.crashes.any() else np.ones_like(p)

        def moved(other: OnPaths) -> Nearby:
            new_p = p * ratio_of(other.p, base.p)
            references = ratio_of(other.references, base.references)
            crashing = new_p * crash_share
            # The pool's events are a sample: some of the same traffic lie beyond it, too, and do not count.
            share_there, share_here = (ratio_of(each.beyond, each.p, of_nothing=0.0) for each in (other, base))
            more_beyond = np.maximum(share_there - share_here, 0.0)
            with np.errstate(divide="ignore", over="ignore", invalid="ignore"):
                off = np.expm1(np.abs(np.log(ratio_of(new_p @ shares, p @ shares) / references)))
                beyond = float(crashing @ more_beyond / crashing.sum() + other.untested / other.p.sum())
            rate = self.rate(new_p) / self.rate(p)
            if not self.holds:
                rate = self.limit(new_p, at_worst=True) / self.limit(p)
            events = float(new_p.sum() / p.sum())
            return Nearby(new_p, events, rate, references, float(np.max(off, initial=0.0)), beyond)

        for environment in environments:
            yield None if environment is None else moved(next(on_paths))


@dataclass(frozen=True)
class Nearby:
    """Traffic with other numbers: probabilities of the strata ``p`` (S,), and factors by which rates change with them.

    ``rate`` is the vehicle's factor; ``references`` (R,) are the drivers', as enumerated, and ``off`` is how far those
    by their shares are off at most. ``beyond`` is the share of crashes in events unlike any tested. Events are
    ``events`` times as probable.
    """

    p: FloatArray
    events: float
    rate: float
    references: FloatArray
    off: float
    beyond: float

    @property
    def ratio(self) -> float:
        """Factor by which the vehicle's rate over the first reference driver's changes."""
        return self.rate / float(self.references[0]) if self.references[:1].any() else math.nan

    def per_event(self) -> Nearby:
        """Factors of rates per event, for when the number of events per hour does not change."""
        return replace(self, rate=self.rate / self.events, references=self.references / self.events)

    @property
    def refused(self) -> bool:
        """Whether the tests do not hold for it; NaN, as where a driver never crashes there, counts as that."""
        return not (self.off <= FAR_OFF and self.beyond <= MOST_BEYOND)


def moved_to(tested: StoredShells, there: Resolved, name: str, progress: Progress) -> StoredShells:
    """The run as it answers for the traffic ``there``; a `CampaignError` where its tests say nothing of it."""
    if there.family.digest(there.environment) == tested.pool.environment:
        return replace(tested, traffic=there)
    was, now = ("take time" if each.scenario.shows else "are one step" for each in (tested.here, there))
    if was != now:  # nobody sees events of one step coming: surrogates, and so shells, are others
        expected = f"traffic as that of the tests, in which they {was}"
        raise CampaignError(OPTION, f"{name}, in which events {now}", expected, ELSEWHERE)
    require_shares(tested)
    progress.stage("pool of the other traffic", None)
    pool = campaign_pool(there, progress, order=tested.pool.names)
    design = moved_design(tested.tested, design_shells(pool, tested_limit(tested.here.campaign)), name)
    moved = replace(tested, traffic=there, design=design)
    off, beyond = moved.reference_error(), _share_beyond(tested, pool)
    if beyond > MOST_BEYOND or off > MOST_OFF:
        found = f"traffic where {share(beyond)} of the crashes are in events unlike any that was tested"
        if beyond <= MOST_BEYOND:
            found = f"traffic for which the rate of a reference driver would come out wrong by {share(off)}"
        expected = f"at most {share(MOST_BEYOND)} and {share(MOST_OFF)}: crash shares within shells must stay the same"
        raise CampaignError(OPTION, found, expected, ELSEWHERE)
    return moved


def require_shares(tested: StoredShells) -> None:
    """Raise a `CampaignError` where shares may not be taken to stay the same."""
    if tested.holds:
        return
    found = f"a vehicle that crashes on few ({share(tested.mean_share)}) of the events of its shells"
    expected = f"at least {share(LEAST_SHARE)}, as which events these are may change with the traffic"
    mend = "Run it in the other traffic (environment.parameters), or add a driver that is close to it (pool.library)."
    raise CampaignError(str(tested.folder), found, expected, mend)


def moved_design(tested: ShellDesign, new: ShellDesign, environment: str) -> ShellDesign:
    """The strata ``tested`` with the probabilities of a ``new`` design; `CampaignError` if one was never tested.

    A cell of the new one goes to that of the same stratum and reference drivers, else to the first of the stratum.
    """
    cells = _cells(tested)
    cell_p = np.zeros(len(cells))
    for (stratum, drivers), p in zip(_cells(new), new.cell_p.tolist(), strict=True):
        alike = [(r != drivers, cell) for cell, (s, r) in enumerate(cells) if s == stratum]
        if not alike:
            found = f"{environment}, whose shell {stratum} was never tested (probability {p:.3g})"
            raise CampaignError(OPTION, found, f"shells among {', '.join(tested.strata)}", ELSEWHERE)
        cell_p[min(alike)[1]] += p
    names = ("pool", "n_paths", "p_event", "p_unreachable", "reference_rate", "reference_square")
    return replace(tested, cell_p=cell_p, **{name: getattr(new, name) for name in names})


def _cells(design: ShellDesign) -> list[tuple[str, int]]:
    """Stratum's name and bits of the reference drivers that crash, of each cell."""
    names = [design.strata[s] for s in design.cell_stratum]
    return list(zip(names, design.cell_references, strict=True))


def reference_shares(design: ShellDesign) -> FloatArray:
    """Share of each stratum on which each reference driver crashes, shape (S, R)."""
    crashes_too = np.array([design.crashes_too(r) for r in range(len(design.references))])
    crashing = design.joined.T @ (design.cell_p * crashes_too.reshape(-1, design.cell_p.size)).T
    return ratio_of(crashing, np.broadcast_to(design.p[:, None], crashing.shape), of_nothing=0.0)


def _share_beyond(tested: StoredShells, new: Pool) -> float:
    """Share of crashes in events of the ``new`` pool whose facts lie beyond all of the same shell in the tested one."""
    old, outside = tested.pool, np.zeros(new.shell.size, np.bool_)
    for name, (low, high) in ranges(old).items():
        outside |= (new.events.facts[name] < low[new.shell]) | (new.events.facts[name] > high[new.shell])
    beyond = {name: float(outside[rows].mean()) for s, name in enumerate(old.names) if (rows := new.shell == s).any()}
    shares: FloatArray = np.array([beyond.get(name, 0.0) for name in tested.design.strata])
    crash_rate = tested.design.p * tested.seen.tally.share
    return float(crash_rate @ shares / crash_rate.sum()) if crash_rate.any() else float(shares.max(initial=0.0))
