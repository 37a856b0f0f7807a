"""A run under way: rounds of tests, their shards in order, the stop rule, then estimates and report."""

from __future__ import annotations

import math
import time
from collections import Counter
from collections.abc import Iterable, Iterator, Mapping
from contextlib import ExitStack, closing, contextmanager
from dataclasses import asdict, dataclass, replace
from functools import partial
from pathlib import Path
from typing import Any

import pyarrow as pa

from harness.errors import EXIT_BUDGET_SPENT, EXIT_DONE, EXIT_REFUTED, CampaignError, told_of
from harness.estimators import answer
from harness.estimators.one_pass import even
from harness.estimators.pairs import PairDecision, PairVerdict
from harness.estimators.shells import SeenShells
from harness.estimators.stopping import Decision, RoundRule, Rule, Verdict
from harness.files import remove_unfinished
from harness.pool.moved import assumed
from harness.pool.shells import PrescribedEpisodes
from harness.progress import Progress
from harness.records.folder import ESTIMATES, MILDER, SHELLS, parquet, sole_use, write_sealed
from harness.records.reader import ShownTests
from harness.report.drawing import Plot
from harness.report.page import write_page_of
from harness.report.plots import where_plot
from harness.report.summary import RunFolder
from harness.report.words import run_lines
from harness.resolved import Resolved
from harness.runner import kept
from harness.runner.workers import LocalWorkers, ShardResult, Workers
from harness.sampling import paths, prepare
from harness.sampling.protocol import KnownTests, ShardRequest
from harness.sampling.shells import ShellRounds, Shells, round_requests
from harness.shown import ShownInPython
from harness.signals import uninterrupted
from harness.strata import STORED_DESIGN
from harness.vocabulary import IntArray, StoppedBy

_EXIT_OF: Mapping[Verdict | PairVerdict, int] = {
    "accepted": EXIT_DONE, "rejected": EXIT_REFUTED, "undecided": EXIT_BUDGET_SPENT,
    "proven": EXIT_DONE, "refuted": EXIT_REFUTED, "open": EXIT_BUDGET_SPENT,
}  # fmt: skip


def exit_code(decision: Decision | PairDecision | None, *, missed: bool) -> int:
    """Exit code by the decision; where none was asked for, by whether the asked precision was ``missed``."""
    return _EXIT_OF[decision.verdict] if decision else EXIT_BUDGET_SPENT if missed else EXIT_DONE


@dataclass(frozen=True, repr=False)
class RunResult(ShownInPython):
    """What a finished campaign left in its folder, ``estimates.json`` and ``report.html``; shown, the short answer.

    ``stopped_by`` is explained at `harness.vocabulary.StoppedBy`. The exit code is 0, or 4 when the budget or the
    pool was spent before the asked precision or decision, or 5 where the crash rate is above the limit that was to be
    kept.
    """

    folder: Path
    report: Path
    estimates: dict[str, Any]
    stopped_by: StoppedBy
    exit_code: int
    shown: RunFolder
    """Content of its page."""

    def _lines(self) -> list[str]:
        return run_lines(self.shown.campaign, self.shown.manifest, self.shown.estimates, self.report)

    def _plot(self) -> Plot | None:
        return where_plot(self.shown)


@dataclass
class Underway:
    """A run with the workers that drive it, and who is told how far it is."""

    run: kept.Run
    crew: Workers
    progress: Progress
    name: str = ""
    """Vehicle and scenario, for errors, where other runs go on beside it."""

    @property
    def prescribed(self) -> PrescribedEpisodes:
        """The tests of a run of shells."""
        assert isinstance(self.run.source, Shells)
        return self.run.source.prescribed

    def keep_design(self) -> None:
        """Write the strata, which estimates need; refuse a folder whose strata are of another pool."""
        kept.require_same_pool(self.run.folder, self.run.source)
        if (design := self.run.source.design) is not None:
            write_sealed(self.run.folder / SHELLS, STORED_DESIGN.dump_python(design, mode="json"))
            resolved = self.run.resolved
            exposure = resolved.family.exposure(resolved.environment, resolved.parameters)
            counted = "counted" if exposure.counted else "assumed"
            self.run = self.run.noting(tests_per_hour=exposure.per_hour / design.p_counted, exposure=counted)

    def drive_before_tests(self) -> None:
        """Drive milder events, where the family has some, and baseline runs, where tests follow from them."""
        self.keep_design()
        resolved, source = self.run.resolved, self.run.source
        left_open = assumed(resolved, source.pool, source.design, self.progress)
        self.run = self.run.noting(assumed=left_open, onset_step=resolved.family.first_onset(resolved.environment))
        if resolved.family.milder(resolved.environment) is not None:
            milder_tests = self._before(MILDER, paths.N_MILDER)
            self.run = self.run.noting(milder=paths.milder_of(resolved, milder_tests))
        if (baseline := source.baseline_paths) is None:
            return
        table, runs = paths.begin(source, self._before)
        self.crew.follow_from(parquet(table))
        self.run = self.run.noting(distance_per_test_m=runs.mean_distance_m(baseline.weight)).written()
        self.keep_design()

    def _before(self, name: str, n: int) -> pa.Table:
        """Run the ``n`` baseline runs or milder events, but those that an earlier run has left: all, as a table."""
        what = paths.IN_WORDS[name]
        self.progress.stage(f"{what}{self.crew.where}", n)
        stored = paths.stored_table(self.run.folder, self.run.parts_before, name)
        known = partial(paths.stored_baseline, stored, self.run.source.baseline_paths)
        for result in self.crew.run(paths.requests_before(name, n), known):
            with uninterrupted():
                self.run = self.run.with_baseline(name, result)
            self.progress.advance(result.request.n_episodes)
        table = pa.concat_tables(self.run.before[name])
        if name != MILDER:  # these are few: one that fails is reported as if it had crashed
            campaign, causes = self.run.resolved.campaign, Counter(table["failure"].drop_null().to_pylist())
            again = f"`harness av-check VEHICLE --scenario {campaign.scenario}` drives it alone"
            kept.require_few_failed(causes, n, campaign, again, what, f"the run folder's {name}/ table")
        return table

    def drive_tests(self) -> Rule:
        """Drive rounds of tests until the rule has enough; returns the rule, which knows why."""
        campaign, n_held = self.run.resolved.campaign, self.run.earlier.n_episodes
        # A run to a precision or to a decision does not know its number of tests.
        total = campaign.stop.episodes if campaign.accept is None and campaign.stop.rhw is None else None
        self.progress.stage(f"tests{self.crew.where}", total, done=n_held)
        if campaign.sampling.strata:
            rule: Rule = self._drive_rounds(RoundRule(campaign, n_held))
        else:
            known = KnownTests(campaign)
            rule = known.rule
            for shard in self.drive(known, rule):
                if known.enough(shard.block):
                    break
        self.require_tests()
        return rule

    def _drive_rounds(self, rule: RoundRule) -> RoundRule:
        seen, available = SeenShells(self.prescribed.design), self.prescribed.available
        rounds = ShellRounds(self.run.resolved.campaign, seen.design, available, rule)
        while (added := rounds.next_round(seen)[0]).any():
            self.drive_round(seen, added, rule)
            if rule.observe(seen):
                break
        return rule

    def drive_round(self, seen: SeenShells, added: IntArray, rule: Rule) -> None:
        """Drive the tests of a round, ``added`` (S,) to those ``seen``; to a limit those cut off may have crashed."""
        for shard in self.drive_added(seen.tally.tests, added, rule):
            decides = self.run.resolved.campaign.accept is not None
            seen.add(shard.block.cut_off_as_failed() if decides else shard.block)

    def drive(self, requests: Iterable[ShardRequest], rule: Rule) -> Iterator[ShardResult]:
        """Drive shards and yield them in order, each once it is added to the run."""
        with told_of(self.name):
            for shard in self.crew.run(iter(requests), self.run.known):
                with uninterrupted():
                    self.run = self.run.with_shard(shard)
                self.run.require_few_failed(at_least=kept.SMALLEST_FAILED_SAMPLE)
                n_new = max(self.run.n_episodes - self.run.earlier.n_episodes, 0)
                counts = {"crashes": int(shard.block.crash.sum()), "failed": int(shard.block.failed.sum())}
                shown = {name: n for name, n in counts.items() if n or name == "crashes"}
                self.progress.advance(min(n_new, shard.request.n_episodes), **shown)
                target = None if self.run.resolved.campaign.accept else rule.target
                self.progress.status(rhw=rule.look.rhw, asked=target or math.inf)
                yield shard

    def drive_added(self, tested: IntArray, added: IntArray, rule: Rule) -> Iterator[ShardResult]:
        """Drive ``added`` more tests per stratum, (S,), after the ``tested`` ones, (S,); yields their shards."""
        run, size = self.run, self.run.resolved.campaign.run.smallest_shard
        requests = round_requests(tested, added, len(run.blocks), run.n_episodes, size) if added.any() else ()
        return self.drive(requests, rule)

    def require_tests(self) -> None:
        """Refuse (`HarnessError`) a run without tests, with too many that failed, or fewer than the folder had."""
        if not self.run.n_episodes:
            campaign = self.run.resolved.campaign
            found = f"{campaign.stop.episodes}, spent before a test of {campaign.scenario}"
            mend = "Raise it and go on with --resume, or lower testing.shells.first_tests."
            raise CampaignError("stop.episodes", found, "some tests of each scenario", mend)
        with told_of(self.name):
            self.run.require_few_failed()
            self.run.require_no_fewer()

    def doubtful(self) -> tuple[int, int]:
        """Numbers of tests that keep a limit from being accepted: ``n_milder`` and ``n_differing`` of a `Decision`."""
        run, campaign, counts = self.run, self.run.resolved.campaign, Counter[str]()
        for block in run.blocks:
            counts.update(block.acts())
        n_early = sum(block.n_crashes_before_event(run.facts.get("onset_step")) for block in run.blocks)
        n_milder = paths.n_left_out(campaign, n_early) + paths.beyond_scope(run.facts.get("milder"))
        n_milder += answer.n_softened(answer.before_event(campaign, run.facts, counts))
        return n_milder, len(run.repeated.differing) if run.repeated else 0

    def finish(self, rule: Rule, *, of_sum: bool = False) -> RunResult:
        """Write manifest, estimates and report; with ``of_sum`` rule and decision are of several scenarios together."""
        run, campaign = self.run, self.run.resolved.campaign
        stopped_by: StoppedBy = "sum" if of_sum else answer.ended_by(campaign, rule, run.n_episodes)
        missed = campaign.stop.rhw is not None and stopped_by not in ("rhw", "below_reference", "sum")
        ended: dict[str, Any] = {"stopped_by": stopped_by, "unmet": [asdict(each) for each in rule.look.unmet]}
        if (decision := None if of_sum else rule.look.decision) is not None:
            decision = doubted(decision, [self])
            ended["decision"] = decision.to_json()
        ended["expected"] = answer.expected_for(rule, campaign, run.n_episodes) if missed else None
        ended["remedy"] = answer.pool_remedy(rule, campaign, stopped_by) or None
        ended["wall_time_s"] = run.took_s  # the same in the manifest and in what is shown
        run = run.written("done", **ended)
        self.progress.stage("writing estimates and report", None)
        manifest = run.content("done", **ended)
        estimates = answer.estimate_blocks(even(run.blocks), campaign, manifest)
        write_sealed(run.folder / ESTIMATES, estimates)
        tests, traffic = ShownTests.joined(run.shown, run.folder), run.resolved.environment
        validated = answer.STORED_ESTIMATES.validate_python(estimates)
        shown = RunFolder(run.folder, campaign, manifest, validated, run.source.design, tests, traffic)
        code = exit_code(decision, missed=missed)
        return RunResult(run.folder, write_page_of(shown), estimates, stopped_by, code, shown)


def doubted(decision: Decision, runs: Iterable[Underway]) -> Decision:
    """The decision about these runs together, with their numbers of tests that keep a limit from being accepted."""
    n_milder, n_differing = map(sum, zip(*(run.doubtful() for run in runs), strict=True))
    return replace(decision, n_milder=n_milder, n_differing=n_differing)


Places = Mapping[Path, tuple[Resolved, dict[str, Any]]]
"""Folders of runs, each with the manifest of the run that is to go on there (`require_own_folder`)."""


@contextmanager
def taken(folders: Mapping[Path, Resolved], *, resume: bool) -> Iterator[Places]:
    """Lock the folders against other processes; all are checked before one is touched."""
    with ExitStack() as locks:
        for folder in folders:
            locks.enter_context(sole_use(folder))
        yield {folder: (own, kept.require_own_folder(folder, own, resume=resume)) for folder, own in folders.items()}


@contextmanager
def begun(places: Places, workers: int | None, progress: Progress) -> Iterator[list[Underway]]:
    """Runs that begin or go on in folders, with all that comes before their tests already driven.

    Wherever it is interrupted, the folders can be read. Workers end with it; those of several runs take turns.
    """
    n_scenarios = len({resolved.campaign.scenario for resolved, _ in places.values()})
    runs: list[Underway] = []
    with ExitStack() as working:
        try:
            for folder, (resolved, earlier) in places.items():
                scenario = resolved.campaign.scenario if n_scenarios > 1 else ""
                progress.remark = f" ({scenario.replace('_', ' ')})" if scenario else ""
                name = ", ".join(filter(None, (folder.name.upper() * (len(places) > n_scenarios), scenario)))
                with told_of(name):
                    crew = working.enter_context(closing(workers_of(resolved, workers, n_runs=len(places))))
                    began = time.monotonic()
                    remove_unfinished(folder.rglob(".*.part"))
                    source = prepare(resolved, progress)
                    run = kept.take_over(folder, resolved, source, earlier, began, workers=crew.n_workers)
                    runs.append(Underway(run, crew, progress, name))
                    runs[-1].drive_before_tests()
            progress.remark = ""
            yield runs
        except BaseException:
            for underway in runs:
                if not underway.run.is_behind:  # else it would write a file that no manifest lists
                    underway.run.written("interrupted")
            raise


def workers_of(resolved: Resolved, n_workers: int | None, *, n_runs: int = 1) -> Workers:
    """Workers for a campaign's shards, by turns if there are ``n_runs``; a `HarnessError` where there is no room."""
    if resolved.campaign.run.executor == "local":
        return LocalWorkers(resolved, n_workers)
    try:
        from harness.runner.ray import RayWorkers  # noqa: PLC0415 - an extra
    except ModuleNotFoundError as error:
        if error.name != "ray":
            raise
        mend = "Install it in the harness's folder, on all machines: pip install -c requirements.lock -e '.[ray]'."
        raise CampaignError("run.executor", "ray, but no package ray", "the extra for clusters", mend) from error
    return RayWorkers(resolved, n_workers, n_runs=n_runs)
