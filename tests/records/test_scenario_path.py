"""Initial state and maneuver lists determine the motion of LV and BV exactly."""

from __future__ import annotations

import numpy as np
import pytest

from harness.traffic.laws import acceleration
from harness.vehicles.kinematics import VEHICLE_LENGTH_M, next_position, next_speed
from harness.vocabulary import AV, BV, CUT_IN, LV
from tests.episode.twin_runs import TWO

STEP_PER_S = 10


def redriven(row: dict, hold_steps: int, start_m: float) -> dict[int, tuple[np.ndarray, np.ndarray]]:
    """Positions and speeds (steps + 1,) of LV and BV from a row of the episodes table alone."""
    n, cut = row["n_steps"], row["cut_in_step"]
    lv, bv = iter(row["lv_maneuvers"]), iter(row["bv_maneuvers"])
    x_bv = start_m + VEHICLE_LENGTH_M + row["r2_m"]
    state = {
        BV: (x_bv, row["v_bv_mps"]),
        LV: (x_bv + VEHICLE_LENGTH_M + row["r1_m"], max(row["v_bv_mps"] + row["r1dot_mps"], 0.0)),
    }
    motion: dict[int, list[tuple[float, float]]] = {BV: [state[BV]], LV: [state[LV]]}
    a = {LV: 0.0, BV: 0.0}
    for step in range(n):
        if step % hold_steps == 0:
            a[LV] = acceleration(next(lv))
        if cut is None or step <= cut:
            if step % hold_steps == 0:
                a[BV] = acceleration(next(bv))
            if step == cut:
                assert next(bv) == CUT_IN
        elif (step - cut - 1) % hold_steps == 0:
            a[BV] = acceleration(next(bv))
        for vehicle, (x, v) in state.items():
            after = next_speed(v, a[vehicle])
            state[vehicle] = next_position(x, v, after), after
            motion[vehicle].append(state[vehicle])
    assert next(lv, None) is None
    assert next(bv, None) is None
    return {vehicle: tuple(np.array(rows).T) for vehicle, rows in motion.items()}


@pytest.mark.parametrize(
    "overrides",
    [
        (),
        ("testing.method=forced",),
        ("testing.method=nde",),
        ("testing.method=step_mixture", "testing.challenge=immediate", TWO),
        ("testing.method=forced", "environment.acceleration_hold_s=0.1"),
        ("testing.method=forced", "environment.acceleration_hold_s=0.7"),
    ],
    ids=" ".join,
)
def test_the_path_reproduces_the_motion_in_every_bit(overrides, record):
    recorded = record("records.traces=all", *overrides, n=150)
    hold_steps = round(recorded.campaign.environment.acceleration_hold_s * STEP_PER_S)
    rows = recorded.tables.episodes.to_pylist()
    n_cut_ins = sum(row["cut_in_step"] is not None for row in rows)
    assert n_cut_ins < 50 if recorded.campaign.testing.method == "nde" else n_cut_ins > 100
    for index, row in enumerate(rows):
        assert (row["lv_maneuvers"] + row["bv_maneuvers"]).count(CUT_IN) == (row["cut_in_step"] is not None)
        trace = recorded.shard.traces[index]
        motion = redriven(row, hold_steps, start_m=trace[0, AV, 0])
        for vehicle in (LV, BV):
            x, v = motion[vehicle]
            assert x.tobytes() == np.ascontiguousarray(trace[:, vehicle, 0]).tobytes()
            assert v.tobytes() == np.ascontiguousarray(trace[:, vehicle, 1]).tobytes()
