"""Tests whose cut-in is drawn in the loop: NADE's mixtures, and naturalistic ones of a vehicle that acts before it."""

from __future__ import annotations

from harness.estimators.block import EPISODE_COLUMNS
from harness.families.cut_in.nade.decide import decide
from harness.families.cut_in.nade.functions import build_importance
from harness.families.cut_in.nade.in_loop import DrawnInLoop
from harness.families.cut_in.nade.tables import Tables, build_tables, tables_name
from harness.progress import Progress
from harness.resolved import Resolved
from harness.sampling.protocol import Source

MOMENT_LIMITS = {"all": 32767, "first_9": 9, "none": 0}


class InLoop(Source):
    """``tables`` are challenges, where surrogates' importance functions are mixed."""

    columns = (*EPISODE_COLUMNS, "log_q", "martingale")
    kernel = staticmethod(decide)

    def __init__(self, resolved: Resolved, progress: Progress) -> None:
        super().__init__(resolved, progress)
        self.tables: Tables | None = None
        if self.campaign.sampling.mixes:
            drivers = resolved.surrogates
            progress.stage("criticality tables", len(drivers))
            challenge = self.campaign.testing.challenge
            self.tables = build_tables(resolved.environment, drivers, challenge, progress.advance)
        self.importance = build_importance(self.campaign, self.tables)

    @classmethod
    def cached_files(cls, resolved: Resolved) -> list[str]:
        if not resolved.campaign.sampling.mixes:
            return []
        return [tables_name(resolved.environment, resolved.surrogates, resolved.campaign.testing.challenge)]

    def tests(self, first_episode: int, n_episodes: int) -> DrawnInLoop:
        states, limit = self.paths(first_episode, n_episodes).start, MOMENT_LIMITS[self.campaign.records.moments]
        return DrawnInLoop(states, self.resolved.environment, self.importance, limit)
