"""P(cut-in | path), the path walked a second time: only draws, hazards and a vehicle's step are shared."""

from __future__ import annotations

import numpy as np

from harness.compiled import compiled_threads
from harness.environment.cut_in import acceptance, cut_in_hazard, opportunity
from harness.environment.driving import Environment, car_following, draw_acceleration, free_driving
from harness.maneuvers import acceleration
from harness.random_stream import BV_DRAWS, LV_DRAWS, uniform
from harness.state import State
from harness.vehicles.kinematics import CONTACT_M, next_position, next_speed


@compiled_threads
def _hazards(seed: int, states: np.ndarray, environment: Environment, out: np.ndarray) -> None:
    for i in range(states.size):
        s = states[i]
        x_av, x_bv, v_av, v_bv = 100.0, 105.0 + s.r2_m, s.v_bv_mps - s.r2dot_mps, s.v_bv_mps
        x_lv, v_lv = x_bv + 5.0 + s.r1_m, max(s.v_bv_mps + s.r1dot_mps, 0.0)
        a_lv = a_bv = out[i] = 0.0
        for step in range(environment.numbers.max_steps):
            now = State(v_bv, x_lv - 5.0 - x_bv, v_lv - v_bv, x_bv - 5.0 - x_av, v_bv - v_av)
            if step > 0 and (now.r1_m < CONTACT_M or now.r2_m <= 0.0):
                break
            draw, held = divmod(step, environment.numbers.hold_steps)
            if held == 0:
                u_lv, u_bv = uniform(seed, i, LV_DRAWS, draw), uniform(seed, i, BV_DRAWS, draw)
                a_lv = acceleration(draw_acceleration(u_lv, free_driving(v_lv, environment), environment))
                a_bv = acceleration(draw_acceleration(u_bv, car_following(now, environment), environment))
            accepted = acceptance(now.r2_m, now.r2dot_mps, environment)
            out[i] += cut_in_hazard(opportunity(now, environment), accepted, environment)
            after_lv, after_bv = next_speed(v_lv, a_lv), next_speed(v_bv, a_bv)
            x_lv, x_bv = next_position(x_lv, v_lv, after_lv), next_position(x_bv, v_bv, after_bv)
            x_av = next_position(x_av, v_av, v_av)
            v_lv, v_bv = after_lv, after_bv


def p_cut_in_of_paths(seed: int, states: np.ndarray, environment: Environment) -> np.ndarray:
    hazards = np.zeros(len(states))
    _hazards(seed, states, environment, hazards)
    return -np.expm1(-hazards)
