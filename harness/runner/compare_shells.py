"""Compare two AVs on the same cut-ins drawn from shells: both are driven round by round, to where they differ.

The i-th cut-in of a stratum is the same for both, as it follows from the campaign's seed and the pool. What either
folder holds already, from an earlier call or because it is the copy of a stored run, is not driven again.
"""

from __future__ import annotations

import time
from collections.abc import Iterator, Mapping
from contextlib import ExitStack
from dataclasses import asdict
from itertools import pairwise
from pathlib import Path
from typing import Any

import numpy as np

from harness.errors import EXIT_BUDGET_SPENT, EXIT_DONE, EXIT_REFUTED, CampaignError
from harness.estimators.answer import conditional_paired_statement, paired_statement
from harness.estimators.block import Block
from harness.estimators.pairs import MarginVerdict, PairCounts, PairedEstimate, PairedShells, paired_estimate
from harness.estimators.stopping import PairRule
from harness.pool.shells import Draw, acceleration_limit
from harness.progress import Progress
from harness.records.folder import sole_use
from harness.records.reader import read_shards
from harness.resolved import Resolved
from harness.runner.campaign_run import Run
from harness.runner.manifest import require_own_folder
from harness.runner.planner import PairPlanner, Planner, round_specs
from harness.runner.worker import ShardSpec
from harness.vocabulary import IntArray

PAIRING = "the i-th cut-in that A meets of a shell is the i-th that B meets: same initial state, paths and cut-in"
EXIT_OF: Mapping[MarginVerdict, int] = {"proven": EXIT_DONE, "refuted": EXIT_REFUTED, "open": EXIT_BUDGET_SPENT}


class _Side(Planner):
    """One vehicle's run, which is told from outside what to test."""

    def __init__(self, run: Run, side: int, pairs: PairedShells, rule: PairRule, shard_size: int) -> None:
        super().__init__(rule)
        self._run, self._side, self._pairs, self._shard_size = run, side, pairs, shard_size
        run.planner = self

    def add(self, block: Block) -> bool:
        """Hand on the tests of a shard."""
        self._pairs.add(self._side, block)
        return False

    def drive(self, n_pairs: IntArray) -> None:
        """Test what is missing of the first cut-ins of each stratum."""
        held, prefix = self._pairs.tests(self._side), self._run.prefix
        missing = np.maximum(n_pairs - held, 0)
        if missing.any():
            specs = round_specs(held, missing, len(prefix.shards), prefix.n_episodes, self._shard_size)
            self._run.run_round(iter(specs))


def compare_shells(
    sides: tuple[Resolved, Resolved],
    folders: tuple[Path, Path],
    *,
    margin: float | None = None,
    workers: int | None = None,
    progress: Progress | None = None,
) -> tuple[PairedEstimate, PairRule]:
    """Drive both vehicles on the same cut-ins until the difference, or the margin, is known well enough.

    Parameters
    ----------
    sides, folders : pair
        Campaigns that differ in the vehicle only, and their run folders.
    margin : float, optional
        Stop when it is known whether B's rate is at most 1 + margin times A's, instead of at ``stop.rhw``.
    workers, progress
        See `harness.runner.run_campaign`.

    Raises
    ------
    CampaignError
        The vehicles do not have the same shells.
    """
    require_same_shells(sides)
    began, progress = time.monotonic(), progress or Progress()
    campaign = sides[0].campaign
    with ExitStack() as locks:
        runs, held = [], []
        for resolved, folder in zip(sides, folders, strict=True):
            locks.enter_context(sole_use(folder))
            earlier = require_own_folder(folder, resolved, resume=True)
            held.append(list(_held_specs(folder, earlier)))
            runs.append(Run(resolved, folder, earlier, workers, progress, began, n_runs=2))
        if (prescribed := runs[0].prescribed) is None:  # those of both: one environment and one library make one pool
            raise ValueError("the campaigns do not draw from shells")
        planner = PairPlanner(campaign, prescribed.design, prescribed.available, margin)
        pairs = PairedShells(prescribed.design)
        both = [_Side(run, side, pairs, planner.rule, campaign.run.smallest_shard) for side, run in enumerate(runs)]
        progress.stage("tests of A and B", 2 * campaign.stop.episodes)
        with ExitStack() as working:
            for run in runs:
                working.enter_context(run.under_way())
            for run, specs in zip(runs, held, strict=True):
                run.run_round(iter(specs))
            counts = _drive(planner, pairs, both)
        for run in runs:
            run.discard_uncounted()
            run.finish()
    return paired_estimate(counts, campaign.stop.confidence), planner.rule


def _drive(planner: PairPlanner, pairs: PairedShells, both: list[_Side]) -> PairCounts:
    """Rounds of pairs until the rule is content; the pairs that it has seen."""
    n_pairs = np.zeros_like(pairs.tests(0))
    counts = pairs.first(n_pairs)
    while (added := planner.next_round(counts)).any():
        n_pairs = n_pairs + added
        for side in both:
            side.drive(n_pairs)
        counts = pairs.first(n_pairs)
        if planner.rule.observe(counts):
            break
    return counts


def require_same_shells(sides: tuple[Resolved, Resolved]) -> None:
    """Refuse vehicles that would not have the same strata of cut-ins."""
    limits = [acceleration_limit(of_side.campaign.av) for of_side in sides]
    envelope = sides[0].library.envelope_mps2
    if (limits[0] > envelope) != (limits[1] > envelope):
        raise CampaignError(
            "av",
            found=f"a hardest acceleration of {limits[0]:g} m/s² in A and {limits[1]:g} m/s² in B",
            expected=f"both up to {envelope:g} m/s², the envelope of the surrogate library, or both above",
            mend=f"Limit both (av.limits.max_acceleration_mps2: {envelope:g}), or neither.",
        )


def _held_specs(folder: Path, earlier: Mapping[str, Any]) -> Iterator[ShardSpec]:
    """Shards that a folder holds, as they were asked for."""
    if not earlier["shards"]:
        return
    taken: dict[int, int] = {}
    tables = read_shards(folder, episode_columns=["component"], moment_columns=[])
    for shard, (episodes, _) in zip(earlier["shards"], tables, strict=True):
        stratum = episodes.column("component").to_numpy()
        edges = [0, *(np.flatnonzero(np.diff(stratum)) + 1).tolist(), stratum.size]
        draws = []
        for first, end in pairwise(edges):
            s, n = int(stratum[first]), end - first
            draws.append(Draw(s, taken.get(s, 0), n))
            taken[s] = taken.get(s, 0) + n
        yield ShardSpec(shard["index"], shard["first_episode"], shard["n_episodes"], tuple(draws))


def shells_content(found: PairedEstimate, rule: PairRule, labels: tuple[str, str]) -> dict[str, Any]:
    """What ``compare.json`` says under shells."""
    statements = [paired_statement(found, *labels), conditional_paired_statement(found)]
    if rule.conditional:
        statements.reverse()
    decided = None
    if rule.margin is not None:
        decided = asdict(rule.margin)
        statements.insert(0, rule.margin.sentence)
    return {**found.to_json(), "margin": decided, "statement": statements[0], "statements": statements}


def exit_code(rule: PairRule, *, precision_asked: bool) -> int:
    """5 where B is worse by more than the margin; 4 where the budget was spent before anything was known."""
    if rule.margin is not None:
        return EXIT_OF[rule.margin.verdict]
    return EXIT_BUDGET_SPENT if precision_asked and not rule.look.stopped else EXIT_DONE
