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
from harness.estimators.per_hour import FamilyTests, PerHour
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
    """Content of the page, of A and of B."""

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
    a, b = campaign_of(a), campaign_of(b)
    out, stored = Path(out), None if stored is None else Path(stored)
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
    labels = labels or (a.name, b.name)
    statement = LIBRARY_STATEMENT if rule.conditional else ASSUMPTION_FREE
    if a.scenarios is None:
        return _written(scenarios[0], ended, labels, statement, code)
    decisions = {}
    for scenario in scenarios:
        own = PairRule(a, margin, rhw)
        own.observe(scenario.pairs)
        decisions[scenario.name] = _decided(own, [scenario]).to_json()
        ended_by_sum = {"decision": decisions[scenario.name], "to_decide": None, "ended": "sum"}
        _written(scenario, ended_by_sum, labels, statement, code)
    return _sum_written(out, a, pairs, scenarios, ended, decisions, labels, code)


def _require_stored(stored: Path, folders: Sequence[str], campaign: Campaign, out: Path) -> None:
    """Refuse a run of A that ``out`` lies in, whose code may be a stranger's, or whose campaign is damaged."""
    if out.resolve().is_relative_to(stored.resolve()):
        expected = "a folder outside of that of A's run, which is copied into it"
        raise RunFolderError("--out", str(out), expected, "Choose another folder with --out.")
    for folder in folders:
        mend = f"Read that code; then name {stored / CAMPAIGN} for A, which drives it anew."
        require_trust(stored / folder, read_manifest(stored / folder), code_of(campaign.av), mend)
    if (stored / FAMILIES).is_file():  # the campaign of one scenario is checked by its hash
        crc32 = read_families(stored).get("campaign_crc32")
        require_sum(stored / CAMPAIGN, crc32, (stored / CAMPAIGN).read_bytes(), MEND)


def _ready(a: Campaign, b: Campaign, scenario: str, *, a_is_stored: bool) -> Both:
    """Both in one of their scenarios, refused where they cannot be run, or not be compared."""
    ready = []
    for side, campaign in zip("AB", (a, b), strict=True):
        with told_of(f"{side}, {scenario}" if a.scenarios else side):
            own = campaign.of_family(scenario) if campaign.scenarios else campaign
            ready.append(require_ready(own, "compare"))
    require_comparable(*(each.campaign for each in ready))
    return _with_same_shells(*ready, a_is_stored=a_is_stored)


def _written(
    scenario: PairedScenario, ended: Mapping[str, Any], labels: tuple[str, str], statement: str, code: int
) -> Comparison:
    """Write the comparison in one scenario, and its page."""
    resolved = [underway.run.resolved for underway in scenario.runs]
    campaign, sides = resolved[0].campaign, zip(SIDES, labels, resolved, strict=True)
    content = finite_json({
        "format": 1, "method": campaign.testing.method, "seed": campaign.seed, "scenario": campaign.scenario,
        "campaigns": {side: {"label": label, "campaign_hash": own.content_hash} for side, label, own in sides},
        **paired_estimate(scenario.pairs, campaign.stop.confidence), **ended, "asked": statement,
        "unseen": resolved[0].parameters.unseen,
    })  # fmt: skip
    shown = [result.shown for result in scenario.results]
    for side, run in zip(SIDES, shown, strict=True):
        content[side] |= finite_json(doubts_of(run.campaign, run.manifest, run.estimates))
    folder = scenario.folder
    write_sealed(folder / COMPARISON, content)
    return Comparison(folder, content, code, write_comparison(folder, content, shown, replay_episode), shown)


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
    """Write the comparison of the sum of several scenarios, and its page; those of each scenario are written."""
    confidence = campaign.stop.confidence
    level, sides = Level.two_sided(confidence), {}
    for i, side in enumerate(SIDES):
        ready = {scenario.name: scenario.runs[i].run.resolved for scenario in scenarios}
        shown = {scenario.name: scenario.results[i].shown for scenario in scenarios}
        answers = {name: (run.estimates, run.manifest) for name, run in shown.items()}
        families = [FamilyTests(each.name, each.exposure, each.tests_of_pairs(i)) for each in scenarios]
        sides[side] = hour_answer(PerHour(families), ready, answers, confidence)
    contrasts = {scenario.name: contrast(together([scenario], campaign), level) for scenario in scenarios}
    content = finite_json({
        "format": 1, "method": campaign.testing.method, "seed": campaign.seed, "exposure": campaign.exposure,
        "campaigns": {side: {"label": label} for side, label in zip(SIDES, labels, strict=True)},
        **sides, **contrast(pairs, level), **ended, "confidence": confidence,
        "families": {name: {**own, "decision": decisions[name]} for name, own in contrasts.items()},
    })  # fmt: skip
    write_sealed(out / COMPARISON, content)
    runs = [result.shown for scenario in scenarios for result in scenario.results]
    return Comparison(out, content, code, write_comparison_of_sum(out, content), runs)


def _decided(rule: PairRule, scenarios: Sequence[PairedScenario]) -> PairDecision:
    """The rule's decision, with the tests in these scenarios that keep it from being accepted."""
    doubtful = [[scenario.runs[side].doubtful() for scenario in scenarios] for side in (0, 1)]
    milder_a, milder_b = (sum(n_milder for n_milder, _ in of_side) for of_side in doubtful)
    return rule.decision.doubted(milder_a, milder_b, sum(n for of_side in doubtful for _, n in of_side))


def _to_decide(campaign: Campaign, rounds: PairRounds, pairs: Pairs) -> dict[str, Any] | None:
    """Pairs that would decide what was left open, and what to set for them; None where that cannot be told."""
    rule = rounds.rule
    if rule.decision.verdict != "open" or math.isinf(times := rule.more_pairs(pairs)):
        return None
    needed = two_digits_up(int(pairs.tests.sum()) * times)
    settings = {"stop.episodes": needed} if needed > campaign.stop.episodes else {}
    if new_folder := (more := rounds.used_of_pool(pairs) * times) > 1.0:
        per_shell = two_digits_up(campaign.pool.events_per_shell * more)
        if per_shell > MOST_EVENTS:
            return None
        settings["pool.events_per_shell"] = per_shell
    return {"pairs": needed, "settings": settings, "new_folder": new_folder}


def require_comparable(a: Campaign, b: Campaign) -> None:
    """Refuse campaigns that differ in more than the vehicle, by a `CampaignError` that names every key that differs."""
    of_a, of_b = (dict(leaves(each.model_dump(exclude=set(MAY_DIFFER)))) for each in (a, b))
    if differing := [key for key in of_a | of_b if of_a.get(key) != of_b.get(key)]:
        where = differing[0]
        more = f"; also {', '.join(differing[1:])}" if len(differing) > 1 else ""
        expected = f"campaigns that differ in {', '.join(sorted(MAY_DIFFER))} only: pairs of tests need equal settings"
        mend = f"Make them equal, e.g. with --set {where}=…, which holds for both."
        raise CampaignError(where, f"{of_a.get(where)} in A and {of_b.get(where)} in B{more}", expected, mend)


def _with_same_shells(a: Resolved, b: Resolved, *, a_is_stored: bool) -> Both:
    """Both with the same strata: where only one accelerates beyond the library's envelope, the other gets its own."""
    narrow = [tested_limit(resolved.campaign) <= a.library.envelope_mps2 for resolved in (a, b)]
    if not any(narrow) or all(narrow):
        return a, b
    if narrow[0] and a_is_stored:
        expected = "a run with beyond_envelope: true, as B accelerates harder than the library's full throttle"
        mend = f"Name its {CAMPAIGN} for A, which drives it anew."
        raise CampaignError("testing.shells.beyond_envelope", "false in the stored run of A", expected, mend)
    slower = b if narrow[1] else a
    campaign = slower.campaign.replaced(("testing", "shells", "beyond_envelope"), True)
    content_hash = campaign.content_hash(slower.parameters.content_hash(), slower.challenge)
    widened = replace(slower, campaign=campaign, content_hash=content_hash)
    return (a, widened) if narrow[1] else (widened, b)
