"""Compare two AVs on the same events drawn from shells: both are driven round by round, to where they differ.

Of one scenario the folder holds run folders ``a`` and ``b``, ``compare.json`` and the page. Of several it holds such a
folder of each, and the sum: crashes per hour of driving.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Annotated, Any

from pydantic import Field

from harness.arguments import AtLeastOne, checked
from harness.campaign.campaign import Campaign
from harness.campaign.files import campaign_of
from harness.campaign.sections import MOST_EVENTS
from harness.errors import CampaignError, RunFolderError, told_of
from harness.estimators.answer import ended_by
from harness.estimators.estimate import finite_json
from harness.estimators.likelihood import Level
from harness.estimators.pairs import PairDecision, Pairs, contrast, paired_estimate
from harness.estimators.per_hour import OfFamily, PerHour
from harness.estimators.stopping import PairRule
from harness.families import family_named
from harness.numbers import leaves, two_digits_up
from harness.pool.shells import tested_limit
from harness.progress import Progress
from harness.records.folder import CAMPAIGN, read_manifest, require_sum, write_sealed
from harness.records.reader import code_of, require_trust
from harness.report.crashes import crashing_pairs
from harness.report.drawing import Plot
from harness.report.page import write_comparison, write_comparison_of_sum
from harness.report.several import pair_lines
from harness.report.summary import RunFolder
from harness.report.words import doubts_of
from harness.resolved import Resolved, require_ready
from harness.runner.paired import SIDES, Both, PairedScenario, copy_stored, drive_pairs, together
from harness.runner.run import hour_answer, require_no_other
from harness.runner.stored import MEND, read_families, replay_episode
from harness.runner.underway import exit_code
from harness.sampling.shells import PairRounds
from harness.shown import ShownInPython
from harness.strata import ASSUMPTION_FREE, LIBRARY_STATEMENT
from harness.vocabulary import COMPARISON, FAMILIES

MAY_DIFFER = frozenset({"av", "name", "description"})


@dataclass(frozen=True, repr=False)
class Comparison(ShownInPython):
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

    def _lines(self) -> list[str]:
        last = self.shown[1]
        s_per_pair = last.manifest["wall_time_s"] / self.content["n_pairs"]
        return pair_lines(self.content, last.campaign, self.report, s_per_pair)

    def _plot(self) -> Plot | None:
        """Events on which one of them crashes."""
        if "shells" not in self.content:  # of several scenarios, each of which has its own map
            return None
        return crashing_pairs(self.shown, self.content["shells"]).plot(family_named(self.shown[0].campaign.scenario))


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
        own ``stop.rhw`` is about one vehicle, and not asked. Of several scenarios the sum is compared, per hour.
    out : str or Path
        Folder of the run folders ``a`` and ``b``, or of such a folder of each scenario; what an earlier call has
        finished there is used again.
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
      A / B         0.56          0.41 to 0.86             verdict: confidence 0.95 over all looks
      A − B         −1.06 × 10⁻⁷  (−1.79 to −0.33) × 10⁻⁷  crashes of A alone 0, B 40
      90 % intervals cover sampling error in this simulated traffic only; stopped: verdict reached
      report  runs/late/report.html
    """
    a, b, out, stored = campaign_of(a), campaign_of(b), Path(out), None if stored is None else Path(stored)
    folders = {name: name for name in a.scenarios} if a.scenarios else {a.scenario: ""}
    if stored is not None:
        _require_stored(stored, [*folders.values()], a, out)
    if margin is not None and rhw is not None:
        expected = "one end of the comparison"
        raise CampaignError("--margin", f"stop.rhw={rhw:g} beside it", expected, "Leave out --margin or stop.rhw.")
    if a.scenarios or b.scenarios:
        require_comparable(a, b)
    if a.stop.each_family:
        expected = "false: a comparison ends by the sum of its scenarios"
        raise CampaignError("stop.each_family", "true", expected, "Write --set stop.each_family=false.")
    if out.is_dir():
        require_no_other(out, [*(a.scenarios or SIDES), COMPARISON])
    ready = {out / folder: _ready(a, b, name, a_is_stored=stored is not None) for name, folder in folders.items()}
    if stored is not None:
        for folder in folders.values():
            copy_stored(stored / folder, out / folder / "a", ready[out / folder][0])
    rule = PairRule(a, margin, rhw)
    rounds, scenarios = drive_pairs(a, ready, rule, workers, progress or Progress())
    pairs = together(scenarios, a)
    decision = _decided(rule, scenarios)
    code = exit_code(None if margin is None else decision, missed=not rule.look.stopped)
    ended = {
        "decision": decision.to_json(), "to_decide": _to_decide(a, rounds, pairs),
        "ended": ended_by(a, rule, int(pairs.tests.sum())),
    }  # fmt: skip
    told = labels or (a.name, b.name), LIBRARY_STATEMENT if rule.conditional else ASSUMPTION_FREE
    if a.scenarios is None:
        return _written(scenarios[0], ended, *told, code)
    each = {}
    for of in scenarios:
        own = PairRule(a, margin, rhw)
        own.observe(of.pairs)
        each[of.name] = _decided(own, [of]).to_json()
        _written(of, {"decision": each[of.name], "to_decide": None, "ended": "sum"}, *told, code)
    return _sum_written(out, a, pairs, scenarios, ended, each, told[0], code)


def _require_stored(stored: Path, folders: Sequence[str], campaign: Campaign, out: Path) -> None:
    """Refuse a run of A that ``out`` lies in, whose code may be a stranger's, or whose campaign is damaged."""
    if out.resolve().is_relative_to(stored.resolve()):
        expected = "a folder outside of that of A's run, which is copied into it"
        raise RunFolderError("--out", str(out), expected, "Choose another folder with --out.")
    for folder in folders:
        mend = f"Read that code; then name {stored / CAMPAIGN} for A, which drives it anew."
        require_trust(stored / folder, read_manifest(stored / folder), code_of(campaign.av), mend)
    if (stored / FAMILIES).is_file():  # that of one scenario is known by its hash
        known = read_families(stored).get("campaign_crc32")
        require_sum(stored / CAMPAIGN, known, (stored / CAMPAIGN).read_bytes(), MEND)


def _ready(a: Campaign, b: Campaign, scenario: str, *, a_is_stored: bool) -> Both:
    """Both in one of their scenarios, refused where they cannot be run, or not be compared."""
    ready = []
    for side, whole in zip("AB", (a, b), strict=True):
        with told_of(f"{side}, {scenario}" if a.scenarios else side):
            ready.append(require_ready(whole.of_family(scenario) if whole.scenarios else whole, "compare"))
    require_comparable(*(each.campaign for each in ready))
    return _with_same_shells(*ready, a_is_stored=a_is_stored)


def _written(
    of: PairedScenario, ended: Mapping[str, Any], labels: tuple[str, str], asked: str, code: int
) -> Comparison:
    """Write what is known of one scenario, and its page."""
    resolved = [each.run.resolved for each in of.runs]
    campaign, told = resolved[0].campaign, zip(SIDES, labels, resolved, strict=True)
    content = finite_json({
        "format": 1, "method": campaign.testing.method, "seed": campaign.seed, "scenario": campaign.scenario,
        "campaigns": {side: {"label": label, "campaign_hash": own.content_hash} for side, label, own in told},
        **paired_estimate(of.pairs, campaign.stop.confidence), **ended, "asked": asked,
        "unseen": resolved[0].parameters.unseen,
    })  # fmt: skip
    for side, each in zip(SIDES, of.results, strict=True):
        content[side] |= finite_json(doubts_of(each.shown.campaign, each.shown.manifest, each.shown.estimates))
    write_sealed(of.folder / COMPARISON, content)
    shown = [each.shown for each in of.results]
    return Comparison(of.folder, content, code, write_comparison(of.folder, content, shown, replay_episode), shown)


def _sum_written(
    out: Path,
    campaign: Campaign,
    pairs: Pairs,
    scenarios: Sequence[PairedScenario],
    ended: Mapping[str, Any],
    decisions: Mapping[str, Any],
    labels: tuple[str, str],
    code: int,
) -> Comparison:
    """Write what is known of the sum of several scenarios, and its page; each one's own has been written."""
    confidence = campaign.stop.confidence
    level, sides = Level.two_sided(confidence), {}
    for i, side in enumerate(SIDES):
        ready = {of.name: of.runs[i].run.resolved for of in scenarios}
        told = {of.name: (of.results[i].shown.estimates, of.results[i].shown.manifest) for of in scenarios}
        families = [OfFamily(of.name, of.exposure, of.tests_of_pairs(i)) for of in scenarios]
        sides[side] = hour_answer(PerHour(families), ready, told, confidence)
    content = finite_json({
        "format": 1, "method": campaign.testing.method, "seed": campaign.seed, "exposure": campaign.exposure,
        "campaigns": {side: {"label": label} for side, label in zip(SIDES, labels, strict=True)},
        **sides, **contrast(pairs, level), **ended, "confidence": confidence,
        "families": {
            of.name: {**contrast(together([of], campaign), level), "decision": decisions[of.name]} for of in scenarios
        },
    })  # fmt: skip
    write_sealed(out / COMPARISON, content)
    shown = [each.shown for of in scenarios for each in of.results]
    return Comparison(out, content, code, write_comparison_of_sum(out, content), shown)


def _decided(rule: PairRule, scenarios: Sequence[PairedScenario]) -> PairDecision:
    """What a rule has found, after what was seen besides in these scenarios."""
    doubts = (zip(*(of.runs[side].doubtful() for of in scenarios), strict=True) for side in (0, 1))
    of_a, of_b = (tuple(map(sum, each)) for each in doubts)
    return rule.decision.doubted(of_a[0], of_b[0], of_a[1] + of_b[1])


def _to_decide(campaign: Campaign, rounds: PairRounds, pairs: Pairs) -> dict[str, Any] | None:
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


def _with_same_shells(a: Resolved, b: Resolved, *, a_is_stored: bool) -> Both:
    """Both with the strata of the one that accelerates harder, where only that is tested beyond the envelope."""
    narrow = [tested_limit(each.campaign) <= a.library.envelope_mps2 for each in (a, b)]
    if not any(narrow) or all(narrow):
        return a, b
    if narrow[0] and a_is_stored:
        expected = "a run with beyond_envelope: true, as B accelerates harder than the library's full throttle"
        mend = f"Name its {CAMPAIGN} for A, which drives it anew."
        raise CampaignError("testing.shells.beyond_envelope", "false in the stored run of A", expected, mend)
    own = b if narrow[1] else a
    campaign = own.campaign.replaced(("testing", "shells", "beyond_envelope"), True)
    widened = replace(
        own, campaign=campaign, content_hash=campaign.content_hash(own.parameters.content_hash(), own.challenge)
    )
    return (a, widened) if narrow[1] else (widened, b)
