"""The roll-out leaves out tanh where FVDM brakes fully anyway: not a bit may change."""

import numpy as np
import pytest

from harness.campaign.models import FVDMParameters, IDMParameters
from harness.criticality.immediate import smallest_gaps
from harness.maneuvers import acceleration
from harness.vehicles.kinematics import STEP_S, next_speed
from harness.vehicles.models import driver_acceleration, driver_records

HOLD, STEPS_PER_LEVEL, LEVELS = 10, 20, 10


def rolled_out(driver, speed, r2, r2dot, maneuver):
    """Smallest gap at every level, with the driver model asked in every step."""
    follower, smallest, found = speed - r2dot, 1e3, [1e3]
    for step in range(LEVELS * STEPS_PER_LEVEL):
        a = driver_acceleration(driver, follower, speed, r2)
        speed_after, follower_after = (
            next_speed(speed, acceleration(maneuver) if step < HOLD else 0.0),
            next_speed(follower, a),
        )
        r2 += 0.5 * (speed + speed_after - follower - follower_after) * STEP_S
        speed, follower = speed_after, follower_after
        smallest = min(smallest, r2)
        if (step + 1) % STEPS_PER_LEVEL == 0:
            found.append(smallest)
    return found


@pytest.mark.parametrize(
    "parameters",
    [
        IDMParameters(),
        FVDMParameters(min_acceleration_mps2=-1.0),
        FVDMParameters(min_acceleration_mps2=-6.0),
        FVDMParameters(min_acceleration_mps2=-3.0, kappa_per_s=0.1, lambda_per_s=5.0),
    ],
)
def test_every_bit_is_that_of_a_plain_roll_out(parameters):
    driver = driver_records([parameters])[0]
    rng = np.random.default_rng(7)
    out = np.empty(LEVELS + 1)
    for _ in range(200):
        state = (rng.uniform(5, 45), rng.uniform(0, 60), rng.uniform(-20, 6), int(rng.integers(31)))
        smallest_gaps(*state, HOLD, STEPS_PER_LEVEL, driver, out)
        assert out.tolist() == rolled_out(driver, *state)
