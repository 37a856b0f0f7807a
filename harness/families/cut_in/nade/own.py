"""Challenge by code of a user's own: by a function ``my.py:function``, or of a surrogate ``my.py:Model``.

    function(driver, v_bv_mps, gap_m, gap_rate_mps, acceleration_mps2, remaining_s) -> array in [0, 1]

says how critical it is for a driver behind BV that BV holds an acceleration for a hold period from here. It is called
at the points of the grid, with arrays that broadcast, and tabulated like a recursive challenge; the challenge of not
cutting in follows from it. A model, which is a batch controller, is put behind BV in the same states, newly made, and
driven for a hold period. Either one only steers what is drawn: likelihood ratios are exact whatever it returns.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import numpy as np

from harness.controllers.find import own_code
from harness.controllers.hosts import cause_of
from harness.controllers.protocol import BatchController, BatchObservation
from harness.errors import CampaignError
from harness.families.cut_in.laws import Environment
from harness.families.cut_in.nade.challenge import COLLIDED, LEVELS, induced, level_steps
from harness.families.cut_in.nade.grid import AFTER, points_of
from harness.families.cut_in.nade.tables import Tables, recursive_tables
from harness.families.cut_in.vocabulary import ACCELERATIONS_MPS2, N_ACCELERATIONS
from harness.vehicles.kinematics import CONTACT_M, STEP_S, VEHICLE_LENGTH_M
from harness.vocabulary import FloatArray, RecordArray, read_only

WHERE = "testing.challenge"


def own_challenge(name: str) -> Callable[[Environment, RecordArray, str], Tables]:
    """Builder of the tables of one surrogate (like `tables.build_one`), by the function of that ``name``.

    It raises a `CampaignError` if there is no such function, or if it returns anything but challenges.
    """

    def build(environment: Environment, driver: RecordArray, _: str) -> Tables:
        function = own_code(name, WHERE, "a function of a driver and a state (docs/method.md)")
        numbers, shape = driver.view(np.recarray)[0], AFTER.shape
        per_level_s = STEP_S * level_steps(int(environment.numbers["hold_steps"]))
        value, maneuvers = np.zeros((LEVELS + 1, *shape), np.float32), np.zeros((*shape, N_ACCELERATIONS), np.float32)
        for i, speed in enumerate(points_of(AFTER).speed):
            gap, rate = np.meshgrid(*points_of(AFTER)[1:], indexing="ij")
            for level in range(1, LEVELS + 1):
                value[level, i] = _call(name, function, numbers, speed, gap, rate, 0.0, level * per_level_s)
            states = speed, gap[..., None], rate[..., None], ACCELERATIONS_MPS2
            maneuvers[i] = _call(name, function, numbers, *states, LEVELS * per_level_s)
        return recursive_tables(environment, value, maneuvers)

    return build


def _call(name: str, function: Callable[..., Any], *arguments: Any) -> Any:
    shape = np.broadcast_shapes(*map(np.shape, arguments[1:]))
    mend = "Fix the function; numpy's clip limits."
    try:
        challenges = np.broadcast_to(np.asarray(function(*arguments), np.float64), shape)
    except (Exception, SystemExit) as error:
        raise CampaignError(WHERE, f"{name}: {cause_of(error)}", f"challenges of shape {shape}", mend) from error
    wrong = challenges[~((challenges >= 0.0) & (challenges <= 1.0))]
    if wrong.size:
        raise CampaignError(WHERE, f"{name}, which gives {wrong[0]:g}", "challenges from 0 to 1", mend)
    return challenges


def own_surrogate(name: str, where: str) -> Callable[[Environment, RecordArray, str], Tables]:
    """What builds tables of the surrogate of that ``name``, which the campaign has at ``where``.

    It raises a `CampaignError` where there is no such class, or where it gives no accelerations.
    """

    def build(environment: Environment, _driver: RecordArray, _challenge: str) -> Tables:
        expected = "a batch controller, which is made without arguments (docs/controllers.md)"
        model_class = own_code(name, where, expected)
        if not hasattr(model_class, "step_batch"):
            mend = "It is asked for millions of states at once: write step_batch(seen)."
            raise CampaignError(where, f"{name}, which has no step_batch", expected, mend)
        after = np.empty((*AFTER.shape, N_ACCELERATIONS, 3), np.float32)
        points, hold = points_of(AFTER), int(environment.numbers["hold_steps"])
        gap, rate, bv = (each.ravel() for each in np.meshgrid(*points[1:], ACCELERATIONS_MPS2, indexing="ij"))
        try:
            for i, speed in enumerate(points.speed):
                after[i] = states_after(model_class(), speed, gap, rate, bv, hold).reshape(after.shape[1:])
        except (Exception, SystemExit) as error:
            raise CampaignError(where, f"{name}: {cause_of(error)}", expected, "Fix the class.") from error
        return recursive_tables(environment, *induced(environment, after))

    return build


def states_after(
    model: BatchController, speed: float, gap: FloatArray, rate: FloatArray, bv: FloatArray, steps: int
) -> FloatArray:
    """States (v_BV, R2, R2dot), (n, 3), after ``steps`` steps in which a ``model`` follows; v_BV as in `hold_period`.

    BV begins with one ``speed`` (m/s), gaps (m), gap rates (m/s) and accelerations ``bv`` (m/s²) are (n,).
    """
    lead, follower, gap = np.full(gap.size, speed), np.maximum(speed - rate, 0.0), gap.copy()
    zeros, cell = np.broadcast_to(0.0, gap.size), read_only(np.arange(gap.size))
    set_speed, unknown, right = read_only(follower.copy()), np.broadcast_to(np.nan, gap.size), np.zeros_like(cell)
    commanded, collided = np.zeros(gap.size), np.zeros(gap.size, np.bool_)
    if begin := getattr(model, "start_batch", None):
        begin(cell, cell, [np.random.default_rng(0)] * gap.size)
    for step in range(steps):
        observation = BatchObservation(
            cell=cell, episode=cell, time_s=np.broadcast_to(step * STEP_S, gap.size), position_m=zeros,
            speed_mps=read_only(follower), acceleration_mps2=read_only(commanded), gap_m=read_only(gap),
            lead_speed_mps=read_only(lead), bv_position_m=read_only(gap + VEHICLE_LENGTH_M), bv_speed_mps=lead,
            bv_lane=right, lv_position_m=unknown, lv_speed_mps=unknown, lv_lane=right, bv_lateral_m=zeros,
            bv_lateral_speed_mps=zeros, bv_overlaps=right + 1, set_speed_mps=set_speed, lv_lateral_m=zeros,
            lv_lateral_speed_mps=zeros,
        )  # fmt: skip
        commanded = np.array(np.broadcast_to(np.asarray(model.step_batch(observation), np.float64), gap.shape))
        if not np.isfinite(commanded).all():
            raise ValueError(f"an acceleration of {commanded[~np.isfinite(commanded)][0]}")
        lead_after, follower_after = np.maximum(lead + bv * STEP_S, 0.0), np.maximum(follower + commanded * STEP_S, 0.0)
        gap = gap + 0.5 * (lead + lead_after - follower - follower_after) * STEP_S
        lead, follower = lead_after, follower_after
        collided |= gap < CONTACT_M
    return np.stack([np.where(collided, COLLIDED, lead), gap, lead - follower], axis=1)
