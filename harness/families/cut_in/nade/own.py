"""Challenge by a function of a user's own, ``my.py:function``, in place of what a surrogate would do.

    function(driver, v_bv_mps, gap_m, gap_rate_mps, acceleration_mps2, remaining_s) -> array in [0, 1]

says how critical it is for a driver behind BV that BV holds an acceleration for a hold period from here. It is asked at
the points of the grid, in arrays that broadcast, and tabulated as a recursive challenge is; what not cutting in is
worth follows from it. It steers alone: likelihood ratios are of what is drawn, whatever it says.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import numpy as np

from harness.controllers.find import own_code
from harness.controllers.hosts import cause_of
from harness.errors import CampaignError
from harness.families.cut_in.laws import Environment
from harness.families.cut_in.nade.challenge import LEVELS, build_before_cut_in, level_steps
from harness.families.cut_in.nade.grid import AFTER, points_of
from harness.families.cut_in.nade.tables import Tables
from harness.vehicles.kinematics import STEP_S
from harness.vocabulary import ACCELERATIONS_MPS2, N_ACCELERATIONS, RecordArray

WHERE = "testing.challenge"


def own_challenge(name: str) -> Callable[[Environment, RecordArray, str], Tables]:
    """What builds tables of one surrogate (`tables.build_one`) by the function of that ``name``.

    It raises a `CampaignError` where there is no such function, or where what it gives are no challenges.
    """

    def build(environment: Environment, driver: RecordArray, _: str) -> Tables:
        function = own_code(name, WHERE, "a function of a driver and a state (docs/method.md)")
        numbers, shape, none = driver.view(np.recarray)[0], AFTER.shape, np.zeros((0, 2, 2, 2), np.float32)
        per_level_s = STEP_S * level_steps(int(environment.numbers["hold_steps"]))
        value, maneuvers = np.zeros((LEVELS + 1, *shape), np.float32), np.zeros((*shape, N_ACCELERATIONS), np.float32)
        for i, speed in enumerate(points_of(AFTER).speed):
            gap, rate = np.meshgrid(*points_of(AFTER)[1:], indexing="ij")
            for level in range(1, LEVELS + 1):
                value[level, i] = _asked(name, function, numbers, speed, gap, rate, 0.0, level * per_level_s)
            states = speed, gap[..., None], rate[..., None], ACCELERATIONS_MPS2
            maneuvers[i] = _asked(name, function, numbers, *states, LEVELS * per_level_s)
        return Tables(value, maneuvers, build_before_cut_in(environment, value), none)

    return build


def _asked(name: str, function: Callable[..., Any], *given: Any) -> Any:
    shape, mend = np.broadcast_shapes(*map(np.shape, given[1:])), "Fix the function; numpy's clip limits."
    try:
        found = np.broadcast_to(np.asarray(function(*given), np.float64), shape)
    except (Exception, SystemExit) as error:
        raise CampaignError(WHERE, f"{name}: {cause_of(error)}", f"challenges of shape {shape}", mend) from error
    if not ((found >= 0.0) & (found <= 1.0)).all():
        wrong = found[~((found >= 0.0) & (found <= 1.0))][0]
        raise CampaignError(WHERE, f"{name}, which gives {wrong:g}", "challenges from 0 to 1", mend)
    return found
