"""A step whose maneuvers are prescribed: LV and BV repeat a path of the pool, cut-in included."""

from __future__ import annotations

from harness.compiled import compiled_inline
from harness.episode.before_cut_in import begin_cut_in
from harness.episode.cells import Cells, Scratch, Script
from harness.maneuvers import acceleration
from harness.outcomes import BV, LV


@compiled_inline
def hold(k: int, cells: Cells) -> None:
    """Command what LV and BV have chosen."""
    cell = cells.cell[k]
    cells.acceleration[k, LV] = acceleration(cell.lv_maneuver)
    cells.acceleration[k, BV] = acceleration(cell.bv_maneuver)


@compiled_inline
def follow_script(k: int, hold_steps: int, cells: Cells, scratch: Scratch, script: Script) -> None:
    """LV's and BV's maneuvers of the coming step, from row ``cell.row`` of the script."""
    cell = cells.cell[k]
    redraw = cell.step % hold_steps == 0
    if redraw:
        cell.lv_maneuver = script.lv[cell.row, cell.n_lv]
        cells.lv_path[k, cell.n_lv] = cell.lv_maneuver
        cell.n_lv += 1
    since = cell.step - cell.cut_step - 1
    if (cell.cut_step < 0 and redraw) or (cell.cut_step >= 0 and since % hold_steps == 0):
        cell.bv_maneuver = script.bv[cell.row, cell.n_path]
        cells.bv_path[k, cell.n_path] = cell.bv_maneuver
        cell.n_path += 1
    if cell.step == script.cut_step[cell.row]:
        begin_cut_in(k, cells, scratch.state)
        cell.n_control += 1
    hold(k, cells)
