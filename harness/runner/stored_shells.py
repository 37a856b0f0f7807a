"""A stored run of shells in other traffic: the shells' probabilities there, and crash shares as they were.

Traffic decides how probable an event is; what a vehicle makes of one, only through what LV and BV do afterwards, and
through which events of a shell there are. Crash shares within shells are taken to be the same. The reference drivers,
of which no shell is made, tell how far that holds: their rates follow by the same rule, and are known besides. Of a
vehicle that crashes on few of the events of its shells they do not: which these are may change. Of such a vehicle
there are upper limits alone, in traffic close by; of traffic with events that no test stands for nothing is said.
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
LEAST_SHARE = 0.5
"""Of the events that crash, in the mean over a rate, from which on shares are taken to stay the same. Where events
take time, rates of drivers with 0.58 or more came out wrong by at most 6 %, with 0.33 by 16 %, with 0.1 by 28 %,
with 0.02 by more than a factor of 3 (`python -m benchmarks.other_traffic`)."""
FAR_OFF = 0.5
"""The same in traffic close by, where each rate is taken to be as wrong as that [assumed]."""
OPTION = "--environment"
ELSEWHERE = "Run the campaign in that environment, into another folder."


@dataclass(frozen=True, eq=False)
class StoredShells:
    """A stored run of shells as it answers for some ``traffic``, by the ``design``: its strata with their p there.

    It was ``tested`` in the traffic ``here`` with the ``pool`` of that; ``manifest`` and ``blocks`` are the run's.
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

    @property
    def limit_mps2(self) -> float:
        """Hardest acceleration that its strata allow for."""
        return tested_limit(self.here.campaign)

    @cached_property
    def seen(self) -> SeenShells:
        """Its tests, counted."""
        return SeenShells.of_blocks(self.blocks)

    @property
    def mean_share(self) -> float:
        """Share of tests that crash, in the mean over what crashes add to the rate; 1 where nothing has crashed."""
        share, p = self.seen.tally.share, self.tested.p
        return float(p @ share**2 / (p @ share)) if share.any() else 1.0

    @property
    def holds(self) -> bool:
        """Whether shares may be taken to stay the same."""
        return self.mean_share >= LEAST_SHARE

    def rate(self, p: FloatArray) -> float:
        """Crash rate where strata have probabilities (S,); its upper limit where no test crashed."""
        tally = self.seen.tally
        return float(p @ tally.share) if tally.crashes.any() else self.limit(p)

    def limit(self, p: FloatArray, *, at_worst: bool = False) -> float:
        """Upper limit of it; ``at_worst`` every event may crash of strata of which a few did."""
        worst = self.seen.tally.failed_as_crashes()
        few = at_worst & (worst.crashes > 0) & (worst.crashes < LEAST_SHARE * worst.tests)
        crashes = np.where(few, worst.tests, worst.crashes)
        return likelihood_limit(p, crashes, worst.tests, Level.two_sided(0.9), 1.0)

    @property
    def is_same(self) -> bool:
        """Whether the traffic is that of the tests."""
        return self.design is self.tested

    def block(self, block: Block) -> Block:
        """Tests as they count there: a path's probability of events is taken to change as that of all paths."""
        if self.is_same:
            return block
        old, new = self.tested.cell_p, self.design.cell_p
        times = np.divide(new, old, out=np.zeros_like(new), where=old > 0.0)
        columns = {**block.columns, "cell_mass": block.cell_mass * times}
        with np.errstate(divide="ignore"):
            log_weight = np.log(self.design.p[block.stratum])
        return replace(block, columns=columns, drawn=replace(block.drawn, shells=self.design), log_weight=log_weight)

    def reference_error(self) -> float:
        """By how much the rate of a reference driver comes out wrong at most, by its shares of strata."""
        told, known = self.design.p @ reference_shares(self.tested), self.design.reference_rate
        return float(np.max(np.abs(told[known > 0.0] / known[known > 0.0] - 1.0), initial=0.0))

    def nearby(self, rows: Iterable[Mapping[str, float]], progress: Progress) -> Iterator[Nearby | None]:
        """The same traffic with other numbers, by few paths; None where they give no laws.

        Of a vehicle whose shares may change with it, the factor is that of its upper limit.
        """
        traffic = [environment_with(self.traffic, row) for row in rows]
        known = [each for each in traffic if each is not None]
        progress.stage("other traffic", len(known))
        p, shares = self.design.p, reference_shares(self.tested)
        paths = FewPaths(self.traffic, self.pool, self.tested, self.limit_mps2, progress)
        (base,), found = paths.of([self.traffic.environment]), paths.of(known)
        crash_share = self.seen.tally.share if self.seen.tally.crashes.any() else np.ones_like(p)

        def moved(to: OnPaths) -> Nearby:
            now, references = p * ratio_of(to.p, base.p), ratio_of(to.references, base.references)
            crashing = now * crash_share
            # Ends of a sample are not those of a law.
            new = _share(to.beyond, to.p) - _share(base.beyond, base.p)
            with np.errstate(divide="ignore", over="ignore", invalid="ignore"):
                off = np.expm1(np.abs(np.log(ratio_of(now @ shares, p @ shares) / references)))
                beyond = float(crashing @ np.maximum(new, 0.0) / crashing.sum() + to.untested / to.p.sum())
            rate = self.rate(now) / self.rate(p)
            if not self.holds:
                rate = self.limit(now, at_worst=True) / self.limit(p)
            return Nearby(now, float(now.sum() / p.sum()), rate, references, float(np.max(off, initial=0.0)), beyond)

        for each in traffic:
            yield None if each is None else moved(next(found))


@dataclass(frozen=True)
class Nearby:
    """Some traffic beside another: probabilities of the strata ``p`` (S,), and by what rates move from there to here.

    ``rate`` is the vehicle's factor, ``references`` (R,) are those of the drivers, which are known, ``off`` by how much
    one of these comes out too high or too low at most, and ``beyond`` the share of the crashes in events unlike any
    tested. Events are ``events`` times as probable.
    """

    p: FloatArray
    events: float
    rate: float
    references: FloatArray
    off: float
    beyond: float

    @property
    def ratio(self) -> float:
        """The factor of the ratio to the first reference driver."""
        return self.rate / float(self.references[0]) if self.references[:1].any() else math.nan

    def per_event(self) -> Nearby:
        """The same of rates per event, as where events per hour stay."""
        return replace(self, rate=self.rate / self.events, references=self.references / self.events)

    @property
    def refused(self) -> bool:
        """Whether the tests do not say it: nothing is said, either, of traffic in which a driver never crashes."""
        return not (self.off <= FAR_OFF and self.beyond <= MOST_BEYOND)


def moved_to(tested: StoredShells, there: Resolved, name: str, progress: Progress) -> StoredShells:
    """The strata with the probabilities of other traffic; refused where the tests say nothing of it."""
    if there.family.digest(there.environment) == tested.pool.environment:
        return replace(tested, traffic=there)
    was, now = ("take time" if each.scenario.shows else "are one step" for each in (tested.here, there))
    if was != now:  # nobody sees those of one step beforehand: shells mean something else there
        expected = f"traffic as that of the tests, in which they {was}"
        raise CampaignError(OPTION, f"{name}, in which events {now}", expected, ELSEWHERE)
    require_shares(tested)
    progress.stage("pool of the other traffic", None)
    elsewhere = campaign_pool(there, progress, order=tested.pool.names)
    design = moved_design(tested.tested, design_shells(elsewhere, tested.limit_mps2), name)
    moved = replace(tested, traffic=there, design=design)
    off, beyond = moved.reference_error(), _share_beyond(tested, elsewhere)
    if beyond > MOST_BEYOND or off > MOST_OFF:
        found = f"traffic where {share(beyond)} of the crashes are in events unlike any that was tested"
        if beyond <= MOST_BEYOND:
            found = f"traffic for which the rate of a reference driver would come out wrong by {share(off)}"
        expected = f"at most {share(MOST_BEYOND)} and {share(MOST_OFF)}: crash shares within shells must stay the same"
        raise CampaignError(OPTION, found, expected, ELSEWHERE)
    return moved


def _share(part: FloatArray, whole: FloatArray) -> FloatArray:
    return np.divide(part, whole, out=np.zeros_like(whole), where=whole > 0.0)


def require_shares(tested: StoredShells) -> None:
    """Raise a `CampaignError` where shares may not be taken to stay the same."""
    if tested.holds:
        return
    found = f"a vehicle that crashes on {share(tested.mean_share)} of the events of the shells that it crashes in"
    expected = f"at least {share(LEAST_SHARE)}: else which these are may change with the traffic"
    mend = "Run it in that environment, or here with a surrogate close to it in the library (pool.library)."
    raise CampaignError(str(tested.folder), found, expected, mend)


def moved_design(tested: ShellDesign, new: ShellDesign, environment: str) -> ShellDesign:
    """The strata ``tested`` with the probabilities of a ``new`` design, by stratum and drivers; refused if unlike."""
    places, unknown = _keys(tested), _keys(new)
    p = np.zeros(len(places))
    for (stratum, drivers), of_cell in zip(unknown, new.cell_p.tolist(), strict=True):
        alike = [(s, r != drivers, i) for i, (s, r) in enumerate(places) if s == stratum]
        if not alike:
            found = f"{environment}, whose shell {stratum} was never tested (probability {of_cell:.3g})"
            raise CampaignError(OPTION, found, f"shells among {', '.join(tested.strata)}", ELSEWHERE)
        p[min(alike)[2]] += of_cell
    of_new = ("pool", "n_paths", "p_event", "p_unreachable", "reference_rate", "reference_square")
    return replace(tested, cell_p=p, **{name: getattr(new, name) for name in of_new})


def _keys(design: ShellDesign) -> list[tuple[str, int]]:
    names = [design.strata[s] for s in design.cell_stratum]
    return list(zip(names, design.cell_references, strict=True))


def reference_shares(design: ShellDesign) -> FloatArray:
    """Share of each stratum on which each reference driver crashes, shape (S, R)."""
    crashes_too = np.array([design.crashes_too(r) for r in range(len(design.references))])
    crashing = design.joined.T @ (design.cell_p * crashes_too.reshape(-1, design.cell_p.size)).T
    return _share(crashing, np.broadcast_to(design.p[:, None], crashing.shape))


def _share_beyond(tested: StoredShells, new: Pool) -> float:
    """Share of crashes in events whose initial state is beyond all those of the same shell that were there."""
    design, old, weight = tested.design, tested.pool, tested.design.p * tested.seen.tally.share
    outside = np.zeros(new.shell.size, np.bool_)
    for name, (low, high) in ranges(old).items():
        outside |= (new.events.facts[name] < low[new.shell]) | (new.events.facts[name] > high[new.shell])
    beyond = {name: float(outside[rows].mean()) for s, name in enumerate(old.names) if (rows := new.shell == s).any()}
    shares: FloatArray = np.array([beyond.get(name, 0.0) for name in design.strata])
    return float(weight @ shares / weight.sum()) if weight.any() else float(shares.max(initial=0.0))
