"""What the tests of a stored run say of other traffic: the shells' probabilities there, and crash shares as they were.

Traffic decides how probable a cut-in is; what a vehicle makes of one, only through what LV and BV do afterwards, and
through which cut-ins of a shell there are. Crash shares within shells are taken to be the same. The reference drivers,
of which no shell is made, tell how far that holds: their rates follow by the same rule, and are known besides. Traffic
with cut-ins that no test stands for is refused.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np

from harness.campaign.campaign import Campaign
from harness.errors import CampaignError, RunFolderError
from harness.estimators.answer import estimate_blocks
from harness.estimators.block import Block
from harness.numbers import share
from harness.pool.build import campaign_pool
from harness.pool.cut_ins import Pool
from harness.pool.shells import acceleration_limit, design_shells
from harness.progress import Progress
from harness.records.folder import read_manifest
from harness.records.reader import read_campaign
from harness.resolved import Resolved, resolve
from harness.runner.stored import stored_blocks
from harness.sampling import distance_per_test_m
from harness.sampling.shells import Shells
from harness.strata import ShellDesign
from harness.vocabulary import STATE_COLUMNS, FloatArray, IntArray

MOST_BEYOND = 0.01
"""Share of the probability in a shell, as it crashes, that may lie where no cut-in of the old pool does [assumed]."""
SAME_POOL = 0.05
"""How far a pool that another version has built may differ [assumed]."""
MOST_OFF = 0.1
"""How far the rate of a reference driver may come out wrong [assumed; docs/environment.md says what it misses]."""
_OPTION = "--environment"


def estimate_in_other_traffic(
    folder: str | Path, environment: str, *, confidence: float | None = None, progress: Progress | None = None
) -> dict[str, Any]:
    """Content of ``estimates.json`` as the stored tests have it for another environment: a shipped name or a file.

    Raises `HarnessError`: the folder is no run of shells, the environment is wrong, or the tests say nothing of it.
    """
    folder, progress = Path(folder), progress or Progress()
    manifest = read_manifest(folder)
    campaign = read_campaign(folder, manifest, check_files=True)
    _require_shells(campaign)
    here, there = resolve(campaign), resolve(campaign.replaced(("environment", "parameters"), environment))
    _require_same_leads(here, there, environment)
    tested, pool = Shells.stored_design(folder), campaign_pool(here, progress)
    rebuilt = design_shells(pool, acceleration_limit(campaign.av))
    if tested.strata != rebuilt.strata or not np.allclose(tested.p, rebuilt.p, rtol=SAME_POOL):
        mend = "Use the version of the harness (manifest.json) and the surrogate library that it was made with."
        raise RunFolderError(str(folder), f"tests of pool {tested.pool}", f"shells as those of pool {pool.key}", mend)
    progress.stage("pool of the other traffic", None)
    elsewhere = campaign_pool(there, progress, order=pool.names)
    moved = Moved.of(tested, design_shells(elsewhere, acceleration_limit(campaign.av)), environment)
    off = moved.reference_error()
    blocks = list(map(moved.block, stored_blocks(folder, moments=False)))
    beyond = _share_beyond(pool, elsewhere, blocks)
    if beyond > MOST_BEYOND or off > MOST_OFF:
        found = f"traffic where {share(beyond)} of the crashes are in cut-ins unlike any that was tested"
        if beyond <= MOST_BEYOND:
            found = f"traffic for which the rate of a reference driver would come out wrong by {share(off)}"
        expected = f"at most {share(MOST_BEYOND)} and {share(MOST_OFF)}: crash shares within shells must stay the same"
        raise CampaignError(_OPTION, found, expected, "Run the campaign in that environment, into another folder.")
    told: dict[str, Any] = {key: manifest[key] for key in ("retraced", "repeated") if key in manifest}
    told |= {"campaign_hash": there.content_hash, "distance_per_test_m": distance_per_test_m(there.environment)}
    content = estimate_blocks(blocks, there.campaign, told, estimators=["shells"], confidence=confidence)
    drivers = " and ".join(each.name for each in tested.references)
    known = f" (off by {share(off, least=0.001)} for {drivers})" if drivers else ""
    was, now = (Path(each).stem for each in (campaign.environment.parameters, environment))
    words = f"tests of {was}, answered for {now}: holds if as large a share of each shell crashes as there{known}"
    answer = {**content["answer"], "scope": words}
    return {**content, "answer": answer, "scope": f"{content['scope']} {words[:1].upper()}{words[1:]}."}


def _require_shells(campaign: Campaign) -> None:
    if campaign.sampling.strata and not campaign.has_baseline_runs:
        return
    found = f"tests by {campaign.testing.method}"
    if campaign.sampling.strata:
        found = "a vehicle that acts before the cut-in: its cut-ins follow from its own runs"
    expected = "tests of shells, of a vehicle that holds its speed until the cut-in"
    raise CampaignError(_OPTION, found, expected, "Run the campaign in that environment, into another folder.")


def _require_same_leads(here: Resolved, there: Resolved, name: str) -> None:
    leads = [each.environment.lateral for each in (here, there)]
    if leads[0].distance_m != leads[1].distance_m or not np.array_equal(leads[0].cumulative, leads[1].cumulative):
        found = f"{name}, in which cut-ins take another time"
        expected = "the same lateral motion: the time in which a vehicle sees a cut-in decides whether it crashes"
        raise CampaignError(_OPTION, found, expected, "Run the campaign in that environment, into another folder.")


@dataclass(frozen=True, eq=False)
class Moved:
    """Strata as they were ``tested``, and the same, ``there``, with the probabilities of other traffic."""

    tested: ShellDesign
    there: ShellDesign

    @classmethod
    def of(cls, tested: ShellDesign, new: ShellDesign, environment: str) -> Moved:
        """Cells of the new design are those of the old by stratum and reference drivers; a `CampaignError` if not."""
        keys = [_keys(each) for each in (tested, new)]
        p = np.zeros(len(keys[0]))
        for key, of_cell in zip(keys[1], new.cell_p.tolist(), strict=True):
            alike = [key, *((key[0], other) for s, other in keys[0] if s == key[0])]
            place = next((keys[0].index(each) for each in alike if each in keys[0]), None)
            if place is None:
                found = f"{environment}, whose shell {key[0]} was never tested (probability {of_cell:.3g})"
                mend = "Run the campaign in that environment, into another folder."
                raise CampaignError(_OPTION, found, f"shells among {', '.join(tested.strata)}", mend)
            p[place] += of_cell
        there = replace(
            tested,
            pool=new.pool,
            cell_p=p,
            n_paths=new.n_paths,
            p_cut_in=new.p_cut_in,
            p_unreachable=new.p_unreachable,
            reference_rate=new.reference_rate,
            reference_square=new.reference_square,
        )
        return cls(tested, there)

    def block(self, block: Block) -> Block:
        """Tests as they count there: a path's probability of cut-ins is taken to change as that of all paths."""
        old, new = self.tested.cell_p, self.there.cell_p
        times = np.divide(new, old, out=np.zeros_like(new), where=old > 0.0)
        columns = {**block.columns, "cell_mass": block.cell_mass * times}
        drawn = replace(block.drawn, shells=self.there)
        with np.errstate(divide="ignore"):
            log_weight = np.log(self.there.p[block.stratum])
        return replace(block, columns=columns, drawn=drawn, log_weight=log_weight)

    def reference_error(self) -> float:
        """By how much the rate of a reference driver comes out wrong at most, by its shares of strata."""
        worst, old = 0.0, self.tested
        for r, rate in enumerate(self.there.reference_rate.tolist()):
            crashing = (old.cell_p * old.crashes_too(r)) @ old.joined
            shares = np.divide(crashing, old.p, out=np.zeros_like(crashing), where=old.p > 0.0)
            worst = max(worst, abs(float(self.there.p @ shares) / rate - 1.0) if rate > 0.0 else 0.0)
        return worst


def _keys(design: ShellDesign) -> list[tuple[str, int]]:
    names = [design.strata[s] for s in design.cell_stratum]
    return list(zip(names, design.cell_references, strict=True))


def _share_beyond(old: Pool, new: Pool, blocks: list[Block]) -> float:
    """Share of crashes in cut-ins whose initial state is beyond all those of the same shell that were there."""
    design = blocks[0].drawn.shells
    assert design is not None
    tests, crashes = (np.zeros(len(design.strata)) for _ in range(2))
    for block in blocks:
        np.add.at(tests, block.stratum, 1.0)
        np.add.at(crashes, block.stratum[block.crash], 1.0)
    weight = design.p * (crashes / np.maximum(tests, 1.0))
    beyond = {name: _beyond(old, new, shell) for shell, name in enumerate(old.names)}
    shares: FloatArray = np.array([beyond.get(name, 0.0) for name in design.strata])
    return float(weight @ shares / weight.sum()) if weight.any() else float(shares.max(initial=0.0))


def _beyond(old: Pool, new: Pool, shell: int) -> float:
    rows: list[IntArray] = [np.flatnonzero(pool.shell == shell) for pool in (old, new)]
    if not all(each.size for each in rows):
        return 0.0
    outside = np.zeros(rows[1].size, np.bool_)
    for name in STATE_COLUMNS:
        was, now = (pool.cut_ins.state[name][each] for pool, each in zip((old, new), rows, strict=True))
        outside |= (now < was.min()) | (now > was.max())
    return float(outside.mean())
