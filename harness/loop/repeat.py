"""Where tests begin, and what the others do in them, as a script prescribes it."""

from __future__ import annotations

import math
from typing import Any

from harness.compiled import compiled, compiled_inline
from harness.families.script import Script
from harness.loop.cells import FAR_BEHIND_S, KernelState
from harness.loop.drive import leader_of
from harness.vehicles.kinematics import gap
from harness.vehicles.sideways import onset_of
from harness.vocabulary import RecordArray


class Traffic:
    """What the others do in the tests of a shard: here they repeat a ``script``.

    A family whose events are drawn in the loop has a class of its own, with the same methods. Its ``drawn`` is then
    recorded beside the facts, as columns of the tests' table and as control steps (`harness.records.schemas`).
    """

    drawn: Any = None

    def __init__(self, script: Script, facts: RecordArray) -> None:
        self.script, self._facts = script, facts

    def __len__(self) -> int:
        return len(self.script.x)

    @property
    def facts(self) -> RecordArray:
        """What records keep of each test's path and event, fields of the family, shape (n,)."""
        return self._facts

    def rows(self, rows: slice) -> Traffic:
        """The traffic of some of the tests."""
        return Traffic(self.script.rows(rows), self._facts[rows])

    def begin(self, n_cells: int) -> None:
        """Make room for the tests of a shard, which run in K cells."""

    def move(self, kernel: KernelState, placed: int) -> None:  # noqa: ARG002 - a script begins with the test
        """Command the others for the coming step; ``placed`` is the number of cells in which a test begins."""
        repeat(kernel)

    def finish(self, kernel: KernelState, n: int) -> None:
        """Record the ``n`` tests that have just ended."""


@compiled
def refill(kernel: KernelState, given: int) -> int:
    """Begin the next tests of the shard in idle cells, after the first ``given`` rows; returns how many.

    The world's ``x`` and ``v`` receive the placement of their vehicles, ``cells.placed`` their cells.
    """
    n, cells, script = 0, kernel.cells, kernel.script
    for k in range(cells.cell.size):
        for vehicle in range(cells.lane.shape[1]):
            cells.lane_before[k, vehicle] = cells.lane[k, vehicle]
        row = given + n
        if row == script.x.shape[0] or cells.cell[k].row >= 0:
            continue
        for vehicle in range(cells.lane.shape[1]):
            kernel.x[k, vehicle], kernel.v[k, vehicle] = script.x[row, vehicle], script.v[row, vehicle]
            cells.lane[k, vehicle] = cells.lane_before[k, vehicle] = script.lane[row, vehicle]
        begin_cell(k, row, kernel)
        cells.placed[n] = k
        n += 1
    return n


@compiled_inline
def begin_cell(k: int, row: int, kernel: KernelState) -> None:
    """Reset cell ``k`` for the test of a row."""
    script, av = kernel.script, kernel.x.shape[1] - 1
    cell, test = kernel.cells.cell[k], kernel.episode[row]
    episode = kernel.first_episode + row
    cell.row, cell.episode, cell.step, cell.lead, cell.motion_hash = row, episode, 0, 0, 0
    cell.event_step = cell.planned = cell.onset_step = -1
    cell.acts_from = 0 if kernel.acts_early else script.acts_from[row]
    cell.cruises = kernel.av_cruises if cell.acts_from > 0 else 0
    cell.av_speed, set_speed = kernel.v[k, av], script.set_speed_mps[row]
    cell.set_speed = cell.av_speed if math.isnan(set_speed) else set_speed
    cell.announced_index = script.announced_index[row] if script.announced_index[row] >= 0 else episode
    cell.danger = test.min_ttc_s = test.end_ttc_s = math.inf
    test.took_over_step = test.braked_step = -1
    test.component = script.stratum[row]
    test.log_weight, test.log_p_event = script.log_weight[row], script.log_p_event[row]
    test.event_gap_m = test.event_rate_mps = test.onset_gap_m = test.onset_rate_mps = math.nan
    test.crash_time_s = test.impact_speed_mps = math.nan
    kernel.cells.acceleration[k] = 0.0
    if script.at[row] >= 0:
        cell.planned, cell.lead = script.at[row], script.lead[row]
        cell.onset_step = onset_of(cell.planned, cell.lead)
        cell.acts_from = min(cell.acts_from, cell.onset_step + 1)


@compiled
def repeat(kernel: KernelState) -> None:
    """Command the others in every cell as the script prescribes."""
    cells, script = kernel.cells, kernel.script
    for k in range(cells.cell.size):
        cell = cells.cell[k]
        if cell.row < 0:
            continue
        for vehicle in range(script.speed.shape[2]):
            cells.speed[k, vehicle] = script.speed[cell.row, cell.step, vehicle]
            cells.lane[k, vehicle] = script.lanes[cell.row, cell.step, vehicle]
        test = kernel.episode[cell.row]
        if cell.step == cell.onset_step:
            test.onset_gap_m, test.onset_rate_mps = gap_and_rate(k, kernel)
            test.fell_behind = cell.acts_from == 0 and is_far_behind(k, kernel)
        if cell.step == script.at[cell.row]:
            note_event(k, kernel)
            test.n_control_steps += test.component >= 0 or test.log_weight != 0.0  # not drawn by its own probability


@compiled_inline
def is_far_behind(k: int, kernel: KernelState) -> bool:
    """Whether an AV that has followed from the start is far behind the vehicle ahead."""
    av, leader = kernel.x.shape[1] - 1, leader_of(k, kernel.cells.lane_before, True, kernel)
    return leader >= 0 and gap(kernel.x[k, leader], kernel.x[k, av]) > FAR_BEHIND_S * kernel.v[k, av]


@compiled_inline
def note_event(k: int, kernel: KernelState) -> None:
    """Record that the event is in this step, and where the principal vehicle is."""
    cell = kernel.cells.cell[k]
    test, cell.event_step = kernel.episode[cell.row], cell.step
    if cell.onset_step < 0:
        cell.planned = cell.onset_step = cell.step
        cell.acts_from = min(cell.acts_from, cell.step + 1)
    test.event_gap_m, test.event_rate_mps = gap_and_rate(k, kernel)


@compiled_inline
def gap_and_rate(k: int, kernel: KernelState) -> tuple[float, float]:
    """Gap (m) from the AV to the principal vehicle, bumper to bumper, and its rate (m/s)."""
    x, v, av, principal = kernel.x, kernel.v, kernel.x.shape[1] - 1, kernel.principal
    return gap(x[k, principal], x[k, av]), v[k, principal] - v[k, av]
