"""Drive two vehicles on the same events, round by round, in one scenario or in several side by side.

The i-th event of a stratum is the same for both, as it follows from the campaign's seed and the pool. Tests that a
folder holds already, from an earlier call or as the copy of a stored run, are not driven again.
"""

from __future__ import annotations

import shutil
from collections import Counter
from collections.abc import Iterator, Mapping
from functools import cached_property
from itertools import pairwise
from pathlib import Path

import numpy as np

from harness.campaign.campaign import Campaign
from harness.errors import RunFolderError
from harness.estimators.block import joined
from harness.estimators.pairs import PairedShells, Pairs
from harness.estimators.shells import SeenShells
from harness.estimators.stopping import PairRule
from harness.families.protocol import Exposure
from harness.pool.shells import Draw
from harness.progress import Progress
from harness.records.folder import read_manifest
from harness.resolved import Resolved
from harness.runner.kept import Earlier, require_own_folder
from harness.runner.run import exposure_of
from harness.runner.underway import RunResult, Underway, begun, taken
from harness.sampling.protocol import ShardRequest
from harness.sampling.shells import PairRounds
from harness.vocabulary import IntArray

SIDES = ("a", "b")

Both = tuple[Resolved, Resolved]


class PairedScenario:
    """Both vehicles in one scenario: its ``folder``, the ``runs`` of A and B, their ``results``, and the ``pairs``."""

    results: tuple[RunResult, RunResult]  # once all is driven

    def __init__(self, folder: Path, a: Underway, b: Underway, exposures: Mapping[str, float]) -> None:
        self.folder, self.runs, self._exposures = folder, (a, b), exposures
        self._tests = PairedShells(a.prescribed.design)  # as B's: one environment and one library make one pool
        self._n = np.zeros_like(self._tests.tests(0))
        self.pairs = self._tests.first(self._n)

    @property
    def name(self) -> str:
        """Name of the scenario."""
        return self.runs[0].run.resolved.campaign.scenario

    @cached_property
    def exposure(self) -> Exposure:
        """How often its events are met."""
        return exposure_of(self.runs[0].run.resolved, self._exposures)

    def take_over(self, rule: PairRule) -> None:
        """Add the tests that the folders hold."""
        for side, underway in enumerate(self.runs):
            for shard in underway.drive(stored_requests(underway.run.earlier), rule):
                self._tests.add(side, shard.block)

    def drive(self, added: IntArray, rule: PairRule) -> None:
        """Drive ``added`` more pairs per stratum, (S,), but for the tests that the folders hold."""
        self._n = self._n + added
        for side, underway in enumerate(self.runs):
            tested = self._tests.tests(side)
            for shard in underway.drive_added(tested, np.maximum(self._n - tested, 0), rule):
                self._tests.add(side, shard.block)
        self.pairs = self._tests.first(self._n)

    def tests_of_pairs(self, side: int) -> SeenShells:
        """Tests of A (0) or B (1) that belong to pairs: a folder may hold more."""
        block = joined(self.runs[side].run.blocks)
        rows = [np.flatnonzero(block.stratum == s)[:n] for s, n in enumerate(self._n.tolist())]
        return SeenShells.of_blocks([block.chosen(np.concatenate(rows))])


def drive_pairs(
    campaign: Campaign, ready: Mapping[Path, Both], rule: PairRule, workers: int | None, progress: Progress
) -> tuple[PairRounds, list[PairedScenario]]:
    """Drive rounds of pairs of A and B, ``ready`` by the folder of each scenario, until the rule is content."""
    folders = {folder / side: own for folder, both in ready.items() for side, own in zip(SIDES, both, strict=True)}
    with taken(folders, resume=True) as places:
        with begun(places, workers, progress) as runs:
            folder_and_runs = zip(ready, runs[::2], runs[1::2], strict=True)
            scenarios = [PairedScenario(folder, a, b, campaign.exposure) for folder, a, b in folder_and_runs]
            available = [scenario.runs[0].prescribed.available for scenario in scenarios]
            rounds = PairRounds(campaign, together(scenarios, campaign), available, rule)
            kept = sum(underway.run.earlier.n_episodes for underway in runs)
            progress.stage("tests of A and B", 2 * campaign.stop.episodes if rule.ends_at_rhw else None, done=kept)
            for scenario in scenarios:
                scenario.take_over(rule)
            while np.concatenate(added := rounds.next_round(together(scenarios, campaign))).any():
                for scenario, of_scenario in zip(scenarios, added, strict=True):
                    scenario.drive(of_scenario, rule)
                if rule.observe(together(scenarios, campaign)):
                    break
            for underway in runs:
                underway.require_tests()
        for scenario in scenarios:
            a, b = (underway.finish(rule, of_sum=campaign.scenarios is not None) for underway in scenario.runs)
            scenario.results = a, b
        return rounds, scenarios


def together(scenarios: list[PairedScenario], campaign: Campaign) -> Pairs:
    """The pairs of one scenario, per test; of several, those of all, per hour."""
    if campaign.scenarios is None:
        return scenarios[0].pairs
    pairs = tuple(part for scenario in scenarios for part in scenario.pairs.each)
    tests_per_hour = (each.exposure.per_hour / each.runs[0].prescribed.design.p_counted for each in scenarios)
    return Pairs(pairs, tuple(tests_per_hour))


def stored_requests(earlier: Earlier) -> Iterator[ShardRequest]:
    """The requests that a folder's tests were made by: a part each, with its draws from strata."""
    n_drawn = Counter[int]()
    for index, part in enumerate(earlier.parts):
        tables = earlier.tables(part.first_episode, part.n_episodes)
        if tables is None:  # a file is gone: its tests and all later ones are driven anew
            return
        stratum = tables["episodes"]["component"].to_numpy()
        edges = [0, *(np.flatnonzero(np.diff(stratum)) + 1).tolist(), stratum.size]
        draws = []
        for first, end in pairwise(edges):
            s, n = int(stratum[first]), end - first
            draws.append(Draw(s, n_drawn[s], n))
            n_drawn[s] += n
        yield ShardRequest(index, part.first_episode, part.n_episodes, tuple(draws))


def copy_stored(stored: Path, folder: Path, resolved: Resolved) -> None:
    """Copy a stored run of A to the folder of A, unless that has files; a `RunFolderError` if it is no run of A."""
    if folder.exists() and any(folder.iterdir()):
        return
    manifest = read_manifest(stored)
    if manifest["campaign_hash"] != resolved.content_hash:
        expected = f"one of A as it is to be compared ({resolved.content_hash})"
        mend = "Leave out --set and --av where they change more than the stop rule, or name A's campaign file."
        raise RunFolderError(str(stored), f"a run of campaign {manifest['campaign_hash']}", expected, mend)
    require_own_folder(stored, resolved, resume=True)
    unfinished = folder.with_name(f".{folder.name}.part")
    shutil.rmtree(unfinished, ignore_errors=True)  # that of a call that was killed
    shutil.copytree(stored, unfinished)
    unfinished.replace(folder)
