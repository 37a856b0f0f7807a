"""Compare two AVs on the same events drawn from shells: both are driven round by round, to where they differ.

The i-th event of a stratum is the same for both, as it follows from the campaign's seed and the pool. What either
folder holds already, from an earlier call or because it is the copy of a stored run, is not driven again.
"""

from __future__ import annotations

import math
import shutil
from collections.abc import Iterator, Mapping
from contextlib import ExitStack
from dataclasses import asdict, dataclass
from itertools import pairwise
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import numpy as np
from pydantic import Field

from harness.arguments import AtLeastOne, checked
from harness.campaign.campaign import Campaign
from harness.campaign.files import campaign_of
from harness.campaign.sections import MOST_EVENTS
from harness.campaign.vehicle import Limits
from harness.errors import EXIT_BUDGET_SPENT, EXIT_DONE, EXIT_REFUTED, CampaignError, RunFolderError
from harness.estimators.answer import ended_by
from harness.estimators.pairs import PairCounts, PairedShells, PairVerdict, paired_estimate
from harness.estimators.stopping import PairRule
from harness.families import family_named
from harness.files import read_bytes
from harness.numbers import leaves, two_digits_up
from harness.pool.shells import Draw, acceleration_limit
from harness.progress import Progress
from harness.records.folder import CAMPAIGN, read_manifest, sole_use, write_bytes, write_sealed
from harness.records.origin import code_of, require_trust
from harness.resolved import Resolved, require_ready
from harness.runner.kept import Earlier, require_own_folder
from harness.runner.run import begun
from harness.sampling.protocol import ShardRequest
from harness.sampling.shells import PairRounds
from harness.strata import ASSUMPTION_FREE, LIBRARY_STATEMENT
from harness.vocabulary import COMPARISON

if TYPE_CHECKING:
    from harness.report.summary import RunFolder

SIDES = ("a", "b")
MAY_DIFFER = frozenset({"av", "name", "description"})
EXIT_OF: Mapping[PairVerdict, int] = {"proven": EXIT_DONE, "refuted": EXIT_REFUTED, "open": EXIT_BUDGET_SPENT}

Both = tuple[Resolved, Resolved]


@dataclass(frozen=True, repr=False)
class Comparison:
    """Two finished campaigns, in run folders ``a`` and ``b``, and the difference; shown, it is the short answer.

    ``content`` is that of ``compare.json``, ``report`` the page. The exit code is 4 when budget or pool were spent
    before what was asked was known, and 5 when B is worse than A by more than the margin.
    """

    folder: Path
    content: dict[str, Any]
    exit_code: int
    report: Path
    shown: list[RunFolder]
    """What the page is made of, of A and of B."""

    def __repr__(self) -> str:
        from harness.report.lines import pair_lines  # noqa: PLC0415 - draws

        last = self.shown[1]
        s_per_pair = last.manifest["wall_time_s"] / self.content["n_pairs"]
        return "\n".join(pair_lines(self.content, last.campaign, self.report, s_per_pair))

    def _repr_html_(self) -> str:
        """The short answer, and the map of events on which one of them crashes, as a notebook shows them."""
        from harness.report.compare_page import crashing_pairs  # noqa: PLC0415 - draws
        from harness.report.page import shown_with  # noqa: PLC0415

        plot = crashing_pairs(self.shown, self.content["shells"]).plot(family_named(self.shown[0].campaign.scenario))
        return shown_with(repr(self), plot)


@checked("harness.compare")
def compare_campaigns(
    a: Campaign | str | Path,
    b: Campaign | str | Path,
    out: str | Path,
    *,
    workers: AtLeastOne | None = None,
    progress: Progress | None = None,
    labels: tuple[str, str] | None = None,
    stored: str | Path | None = None,
    margin: Annotated[float, Field(ge=0.0, le=1e6)] | None = None,
    rhw: Annotated[float, Field(ge=1e-4, allow_inf_nan=False)] | None = None,
) -> Comparison:
    """Drive two vehicles on the same events until it is known who crashes less often, or to half-width 0.1.

    Parameters
    ----------
    a, b : Campaign, str or Path
        Campaigns, or the paths or vehicles' names that stand for them, equal but for av, name and description; their
        own ``stop.rhw`` is about one vehicle, and not asked.
    out : str or Path
        Folder of the run folders ``a`` and ``b``; what an earlier call has finished there is used again.
    workers, progress
        As in `harness.run`.
    labels : tuple of two str, optional
        Names of A and B in the answer, by default the campaigns'.
    stored : str or Path, optional
        Run folder of A, whose tests are not driven again: it is copied to ``out/a``.
    margin : float, optional
        Ask instead whether B's rate is at most 1 + margin times A's.
    rhw : float, optional
        Ask instead for this half-width of A - B over the larger rate.

    Raises `CampaignError`: the campaigns differ in something else, or do not draw from the same shells; a margin and a
    half-width are asked for. Raises `RunFolderError`: ``out`` holds other runs.

    Examples
    --------
    >>> import harness
    >>> fast = ["world.engine=twin", "environment.parameters=ndd-overtaking-1", "pool.relative_error=0.1"]
    >>> idm, late = (harness.load_campaign(av, [*fast, "stop.episodes=2000"]) for av in ("idm", "late-600ms"))
    >>> harness.compare(idm, late, "runs/late")
    B crashes more often than A · 1,054 pairs of tests, cut-in · crashes per test
      A idm         1.32 × 10⁻⁷   (0.99 to 2.04) × 10⁻⁷    17 crashes
      B late-600ms  2.38 × 10⁻⁷   (2.03 to 3.11) × 10⁻⁷    57 crashes
      A / B         0.56          0.41 to 0.86
      A − B         −1.06 × 10⁻⁷  (−1.79 to −0.33) × 10⁻⁷  crashes of A alone 0, B 40
      90 % intervals cover sampling error in this simulated traffic only; stopped: verdict reached
      report  runs/late/report.html
    """
    a, b = campaign_of(a), campaign_of(b)
    if stored is not None:
        mend = f"Read that code; then name {Path(stored) / CAMPAIGN} for A, which drives it anew."
        require_trust(Path(stored), read_manifest(Path(stored)), code_of(a.av), mend)
    if margin is not None and rhw is not None:
        expected = "one end of the comparison"
        raise CampaignError("--margin", f"stop.rhw={rhw:g} beside it", expected, "Leave out --margin or stop.rhw.")
    sides = require_ready(a, "compare"), require_ready(b, "compare")
    require_comparable(*(side.campaign for side in sides))
    require_same_shells(sides, stored)
    out = Path(out)
    folders = out / "a", out / "b"
    if stored is not None:
        _take_over(Path(stored), folders[0], sides[0])
    rule = PairRule(sides[0].campaign, margin, rhw)
    rounds, pairs, shown = _compared(sides, folders, rule, workers, progress or Progress())
    found = paired_estimate(pairs, a.stop.confidence)
    told = zip(SIDES, labels or (a.name, b.name), sides, strict=True)
    campaigns = {name: {"label": label, "campaign_hash": side.content_hash} for name, label, side in told}
    content = {
        "format": 1, "method": a.testing.method, "seed": a.seed, "campaigns": campaigns, **found,
        "decision": asdict(rule.decision), "to_decide": _to_decide(sides[0].campaign, rounds, pairs),
        "asked": LIBRARY_STATEMENT if rule.conditional else ASSUMPTION_FREE,
        "ended": ended_by(a, rule, found["n_pairs"]), "unseen": sides[0].parameters.unseen,
    }  # fmt: skip
    code = EXIT_DONE if rule.look.stopped else EXIT_BUDGET_SPENT
    if margin is not None:
        code = EXIT_OF[rule.decision.verdict]
    write_sealed(out / COMPARISON, content)
    from harness.report.compare_page import write_page_of  # noqa: PLC0415 - draws

    return Comparison(out, content, code, write_page_of(out, content, shown), shown)


def _compared(
    sides: Both, folders: tuple[Path, Path], rule: PairRule, workers: int | None, progress: Progress
) -> tuple[PairRounds, PairCounts, list[RunFolder]]:
    """Rounds of pairs until the rule is content: what those say that it has seen, and what pages show of both runs."""
    campaign = sides[0].campaign
    with ExitStack() as held, ExitStack() as working:
        for folder in folders:
            held.enter_context(sole_use(folder))
        both = list(zip(folders, sides, strict=True))
        earlier = [require_own_folder(*each, resume=True) for each in both]  # both, before either is touched
        begins = [begun(*each, found, workers, progress, 2) for each, found in zip(both, earlier, strict=True)]
        runs = [working.enter_context(each) for each in begins]
        prescribed = runs[0].prescribed  # as the other's: one environment and one library make one pool
        rounds = PairRounds(campaign, prescribed.design, prescribed.available, rule)
        pairs = PairedShells(prescribed.design)
        progress.stage("tests of A and B", 2 * campaign.stop.episodes if rule.ends_at_rhw else None)
        for side, each in enumerate(runs):
            for shard in each.drive(stored_requests(each.run.earlier), rule):
                pairs.add(side, shard.block)
        n_pairs = np.zeros_like(pairs.tests(0))
        counts = pairs.first(n_pairs)
        while (added := rounds.next_round(counts)).any():
            n_pairs = n_pairs + added
            for side, each in enumerate(runs):  # what is missing of the first events of each stratum
                tested = pairs.tests(side)
                for shard in each.drive_added(tested, np.maximum(n_pairs - tested, 0), rule):
                    pairs.add(side, shard.block)
            counts = pairs.first(n_pairs)
            if rule.observe(counts):
                break
        for each in runs:
            each.run.require_few_failed()
        working.close()
        return rounds, counts, [each.finish(rule).shown for each in runs]


def _to_decide(campaign: Campaign, rounds: PairRounds, pairs: PairCounts) -> dict[str, Any] | None:
    """How many pairs would decide what was left open, and what to set; None where nobody can tell."""
    rule = rounds.rule
    if rule.decision.verdict != "open" or math.isinf(times := rule.more_pairs(pairs)):
        return None
    needed = two_digits_up(int(pairs.tests.sum()) * times)
    settings = {"stop.episodes": needed} if needed > campaign.stop.episodes else {}
    if new_folder := (more := rounds.used_of_pool(pairs) * times) > 1.0:
        kept = two_digits_up(campaign.pool.events_per_shell * more)
        if kept > MOST_EVENTS:
            return None
        settings["pool.events_per_shell"] = kept
    return {"pairs": needed, "settings": settings, "new_folder": new_folder}


def stored_requests(earlier: Earlier) -> Iterator[ShardRequest]:
    """Tests that a folder holds, as they were asked for."""
    taken: dict[int, int] = {}
    for index, part in enumerate(earlier.parts):
        tables = earlier.tables(part.first_episode, part.n_episodes)
        if tables is None:  # what is gone is driven anew, and so is all that follows
            return
        stratum = tables.episodes.column("component").to_numpy()
        edges = [0, *(np.flatnonzero(np.diff(stratum)) + 1).tolist(), stratum.size]
        draws = []
        for first, end in pairwise(edges):
            s, n = int(stratum[first]), end - first
            draws.append(Draw(s, taken.get(s, 0), n))
            taken[s] = taken.get(s, 0) + n
        yield ShardRequest(index, part.first_episode, part.n_episodes, tuple(draws))


def _take_over(stored: Path, folder: Path, resolved: Resolved) -> None:
    """Copy a stored run of A, and no other (`RunFolderError`), to where A is to be run, unless it is there already."""
    if folder.exists() and any(folder.iterdir()):
        return
    manifest = read_manifest(stored)
    if manifest["campaign_hash"] != resolved.content_hash:
        expected = f"one of A as it is to be compared ({resolved.content_hash})"
        mend = "Leave out --set and --av where they change more than the stop rule, or name A's campaign file."
        raise RunFolderError(str(stored), f"a run of campaign {manifest['campaign_hash']}", expected, mend)
    require_own_folder(stored, resolved, resume=True)
    unfinished = folder.with_name(f".{folder.name}.part")
    with sole_use(unfinished):  # in which a call that was killed may have left a part
        try:
            shutil.rmtree(unfinished / "a", ignore_errors=True)
            copy = unfinished / "a"
            for file in filter(Path.is_file, stored.rglob("*")):
                write_bytes(copy / file.relative_to(stored), read_bytes(file))
            if folder.exists():
                folder.rmdir()
            copy.replace(folder)
        finally:
            shutil.rmtree(unfinished)


def require_comparable(a: Campaign, b: Campaign) -> None:
    """Refuse campaigns that differ in more than the vehicle, by a `CampaignError` that names every key that differs."""
    keys = set(MAY_DIFFER)
    of_a, of_b = (dict(leaves(each.model_dump(exclude=keys))) for each in (a, b))
    if apart := [key for key in of_a | of_b if of_a.get(key) != of_b.get(key)]:
        where = apart[0]
        more = f"; also {', '.join(apart[1:])}" if len(apart) > 1 else ""
        expected = f"campaigns that differ in {', '.join(sorted(keys))} only: pairs of tests need equal settings"
        mend = f"Make them equal, e.g. with --set {where}=…, which holds for both."
        raise CampaignError(where, f"{of_a.get(where)} in A and {of_b.get(where)} in B{more}", expected, mend)


def require_same_shells(sides: Both, stored: str | Path | None = None) -> None:
    """Refuse vehicles that would not have the same strata of events."""
    limits = [acceleration_limit(of_side.campaign.av) for of_side in sides]
    envelope = sides[0].library.envelope_mps2
    if (limits[0] > envelope) != (limits[1] > envelope):
        found = f"a hardest acceleration of {limits[0]:g} m/s² in A and {limits[1]:g} m/s² in B"
        expected = f"both up to {envelope:g} m/s², the envelope of the surrogate library, or both above"
        raise CampaignError("av", found, expected, _limit_both(sides, int(limits[1] > envelope), stored))


def _limit_both(sides: Both, harder: int, stored: str | Path | None) -> str:
    """How to compare vehicles of which the ``harder`` side accelerates beyond the envelope of the library."""
    av, envelope = sides[harder].campaign.av, sides[harder].library.envelope_mps2
    if av.source in ("sumo", "traci"):
        return "Nothing in the harness limits a vehicle that SUMO or a program drives: compare it with another such."
    section, default = "parameters", ""
    if av.model is None:
        section, default = "limits", f" (by default {Limits().max_acceleration_mps2:g})"
    limit = f"av.{section}.max_acceleration_mps2={envelope:g}"
    if stored is None:
        return f"Add --set {limit}, which limits both{default}."
    if harder:
        return f"Add --against {limit}, which limits B."
    return f"Name A's vehicle or campaign, not {stored}, so that it is run again with --set {limit}."
