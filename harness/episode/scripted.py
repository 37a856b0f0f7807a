"""A step whose maneuvers are prescribed: LV and BV repeat a path of the pool, cut-in included."""

from __future__ import annotations

from harness.compiled import compiled_inline
from harness.episode.before_cut_in import begin_cut_in
from harness.episode.cells import Bench, Cells
from harness.maneuvers import acceleration
from harness.outcomes import BV, LV
from harness.state import State


@compiled_inline
def hold(k: int, cells: Cells) -> None:
    """Command what LV and BV have chosen."""
    cell = cells.cell[k]
    cells.acceleration[k, LV] = acceleration(cell.lv_maneuver)
    cells.acceleration[k, BV] = acceleration(cell.bv_maneuver)


@compiled_inline
def repeat_traffic(k: int, state: State, bench: Bench) -> None:
    """LV's and BV's maneuvers of the coming step, from the row of the prescribed traffic."""
    cells, traffic, hold_steps = bench.cells, bench.traffic, bench.environment.numbers.hold_steps
    cell = cells.cell[k]
    redraw = cell.step % hold_steps == 0
    if redraw:
        cell.lv_maneuver = traffic.lv[cell.row, cell.n_lv]
        cells.lv_path[k, cell.n_lv] = cell.lv_maneuver
        cell.n_lv += 1
    since = cell.step - cell.cut_step - 1
    if (cell.cut_step < 0 and redraw) or (cell.cut_step >= 0 and since % hold_steps == 0):
        cell.bv_maneuver = traffic.bv[cell.row, cell.n_path]
        cells.bv_path[k, cell.n_path] = cell.bv_maneuver
        cell.n_path += 1
    if cell.step == traffic.cut_step[cell.row]:
        begin_cut_in(k, cells, state)
        cell.n_control += 1
    hold(k, cells)
