"""The driver that a statement says the AV is never ahead of, driven beside it from its cut-in on.

It starts with the AV: same place, same speed, one step after the onset of the cut-in, when neither could act yet. As
long as the AV is not ahead of it, the AV runs into nothing that it does not run into. Where it has run into BV itself,
or passed it before the overlap, there is nothing left to be compared.
"""

from __future__ import annotations

import math

from harness.compiled import compiled, compiled_inline
from harness.episode.cells import Bench
from harness.vehicles.kinematics import CONTACT_M, gap, next_position, next_speed
from harness.vehicles.references import Memory, react
from harness.vocabulary import AV, BV

AHEAD_M = 1e-6
"""What counts as ahead: more than a rounding of positions."""


@compiled
def drive_beside(bench: Bench) -> None:
    """Before a step: the boundary's position at its end, infinite once it has run into BV."""
    x, v, driver = bench.x, bench.v, bench.boundary[0]
    for k in range(bench.cells.cell.size):
        cell = bench.cells.cell[k]
        since = cell.step - cell.onset_step - 1
        if cell.row < 0 or cell.onset_step < 0 or since < 0:
            continue
        if since == 0:
            cell.beside_x, cell.beside_v = x[k, AV], v[k, AV]
            cell.beside_acceleration, cell.beside_danger = 0.0, math.inf
        ahead = gap(x[k, BV], cell.beside_x)
        if ahead < CONTACT_M and cell.step > cell.planned:
            cell.beside_x = math.inf
        if cell.beside_x == math.inf:
            continue
        if since >= driver.delay_steps:
            memory = Memory(cell.beside_acceleration, cell.beside_danger, driver.used_up_steps)
            memory = react(driver, memory, since - driver.delay_steps, cell.beside_v, v[k, BV], ahead)
            cell.beside_acceleration, cell.beside_danger = memory.acceleration, memory.danger
        after = next_speed(cell.beside_v, cell.beside_acceleration)
        cell.beside_x, cell.beside_v = next_position(cell.beside_x, cell.beside_v, after), after


@compiled_inline
def note_if_ahead(k: int, bench: Bench) -> None:
    """After a step: whether it was the first at whose end the AV is ahead of the boundary."""
    cell = bench.cells.cell[k]
    followed = 0 <= cell.onset_step < cell.step - 1
    if followed and cell.ahead_step < 0 and bench.x[k, AV] > cell.beside_x + AHEAD_M:
        cell.ahead_step = cell.step
