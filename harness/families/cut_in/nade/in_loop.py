"""Tests whose cut-in is drawn in the loop: NADE's mixtures, and naturalistic ones of a vehicle that acts before it."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import numpy as np

from harness.compiled import unboxed
from harness.estimators.block import EPISODE_COLUMNS
from harness.families.cut_in.events import Maneuvers
from harness.families.cut_in.laws import Environment
from harness.families.cut_in.nade.cells import empty_nade, with_more_room
from harness.families.cut_in.nade.decide import decide, finish
from harness.families.cut_in.nade.functions import Importance, build_importance
from harness.families.cut_in.nade.own import own_challenge, own_surrogate
from harness.families.cut_in.nade.tables import Tables, build_one, build_tables, tables_name
from harness.families.cut_in.script import beginning, facts_of
from harness.families.script import natural_script
from harness.loop.cells import KernelState
from harness.loop.repeat import Traffic
from harness.progress import Progress
from harness.resolved import Resolved
from harness.sampling.protocol import Source
from harness.vocabulary import BV, RecordArray

MOMENT_LIMITS = {"all": 32767, "first_9": 9, "none": 0}


class DrawnInLoop(Traffic):
    """LV and BV in tests that begin in ``states`` (n,); ``moment_limit`` control steps are kept of each.

    When the tests are over, ``drawn`` holds what was drawn in them.
    """

    def __init__(
        self, states: RecordArray, environment: Environment, importance: Importance, moment_limit: int = 0
    ) -> None:
        n = len(states)
        speed, lanes = np.zeros((n, 0, BV + 1)), np.zeros((n, 0, BV + 1), np.int8)  # they are drawn in the loop
        script = natural_script(*beginning(states), speed, lanes, np.full(n, -1), np.zeros(n, np.int64))
        n_steps = np.full(n, int(environment.numbers["max_steps"]))
        super().__init__(script._replace(n_steps=n_steps), states)
        self._given = states, environment, importance, moment_limit

    def rows(self, rows: slice) -> DrawnInLoop:
        states, environment, importance, limit = self._given
        return DrawnInLoop(states[rows], environment, importance, limit)

    def begin(self, n_cells: int) -> None:
        states, environment, importance, limit = self._given
        self._nade = empty_nade(states, n_cells, environment, importance, limit)
        self.drawn, self._unboxed = self._nade.drawn, unboxed(self._nade)

    def move(self, kernel: KernelState, placed: int) -> None:
        if self.drawn.moment_count[0] > self.drawn.moment.size - len(self._nade.cell):
            self.drawn = with_more_room(self.drawn)
            self._nade = self._nade._replace(drawn=self.drawn)
            self._unboxed = unboxed(self._nade)
        decide(kernel, self._unboxed, placed)

    def finish(self, kernel: KernelState, n: int) -> None:
        finish(kernel, self._unboxed, n)

    @property
    def facts(self) -> RecordArray:
        drawn = self.drawn
        leads = np.zeros(len(drawn.n_lv), np.int64)
        return facts_of(self._given[0], Maneuvers(drawn.lv_path, drawn.bv_path, drawn.n_lv, drawn.n_bv, leads))

    def __getstate__(self) -> dict[str, Any]:
        return {"_given": self._given, "script": self.script}


class InLoop(Source):
    """``tables`` are those of challenges; None without importance functions of surrogates."""

    columns = (*EPISODE_COLUMNS, "log_q", "martingale")
    kernel = staticmethod(decide)

    def __init__(self, resolved: Resolved, progress: Progress) -> None:
        super().__init__(resolved, progress)
        self.tables: Tables | None = None
        if self.campaign.sampling.mixes:
            drivers = resolved.surrogates
            progress.stage("criticality tables", len(drivers))
            builds = [self._build_of(surrogate) for surrogate in self.campaign.surrogates]
            self.tables = build_tables(resolved.environment, drivers, resolved.challenge, progress.advance, builds)
        self.importance = build_importance(self.campaign, self.tables)

    def _build_of(self, surrogate: str) -> Callable[..., Tables]:
        if (own := self.campaign.testing.own_challenge) is not None:
            return own_challenge(own)
        code = self.campaign.own_surrogates.get(surrogate)
        return build_one if code is None else own_surrogate(code, f"surrogates.{surrogate}")

    @classmethod
    def cached_files(cls, resolved: Resolved) -> list[str]:
        if not resolved.campaign.sampling.mixes:
            return []
        return [tables_name(resolved.environment, resolved.surrogates, resolved.challenge)]

    def tests(self, first_episode: int, n_episodes: int) -> DrawnInLoop:
        states, limit = self.paths(first_episode, n_episodes).start, MOMENT_LIMITS[self.campaign.records.moments]
        return DrawnInLoop(states, self.resolved.environment, self.importance, limit)
