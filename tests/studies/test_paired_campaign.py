"""Comparisons, repeated: the intervals of the difference cover; one that assumes what is not so does not."""

from __future__ import annotations

from pathlib import Path

import numpy as np

from harness.campaign.files import load_campaign
from harness.strata import ShellDesign, Statement
from studies.replication.populations import CONDITIONAL_DIFFERENCE, DIFFERENCE
from studies.replication.shells import DrawnPool, PairedCampaign

SMOKE = Path(__file__).parents[2] / "scenarios/smoke.yaml"
P = np.array([1e-7, 2e-7, 3e-6])
BOTH, ONLY_A, ONLY_B = np.array([[0.5, 0.2, 0.0], [0.3, 0.1, 0.1], [0.0, 0.1, 0.0]])
"""Shares of each stratum."""
TRUTH = float(P @ (ONLY_A - ONLY_B))
REPLICATIONS = 120
"""At 0.9 a standard error of 0.027: three of them below 0.9 is 0.818."""


def known_pool(_rng):
    """A pool without error of its own."""
    design = ShellDesign(
        pool="0" * 24, strata=("a", "b", "outside"), cell_stratum=(0, 1, 2), cell_p=P, n_paths=10**12,
        statements=(Statement("library", "b", "keeps to b", 2),), p_cut_in=float(P.sum()), p_unreachable=0.0,
    )  # fmt: skip
    mass = np.diag(P)
    return [DrawnPool(design, mass, mass * share) for share in (BOTH, ONLY_A, ONLY_B)]


def covered(rows):
    return np.mean([row.ci_low <= TRUTH <= row.ci_high for row in rows])


def test_intervals_cover_at_the_stop_and_conditional_ones_do_not_where_vehicles_differ_outside():
    """Nine tenths of the difference lie beyond the boundary, which the conditional statement leaves out."""
    campaign = load_campaign(SMOKE, ["world.engine=twin", "stop.rhw=0.5", "testing.shells.first_tests=12"])
    found = PairedCampaign(campaign, known_pool, seed=3).run(range(REPLICATIONS))
    free, inside = ([row for row in found if row.result == name] for name in (DIFFERENCE, CONDITIONAL_DIFFERENCE))
    assert len(free) == REPLICATIONS
    assert all(row.reached for row in free)
    assert covered(free) >= 0.818
    larger = float(P @ (BOTH + ONLY_A))
    assert abs(np.mean([row.crash_rate for row in free]) - TRUTH) < 0.1 * larger
    assert covered(inside) < 0.5
    assert all(row.n_crashes_outside == 0 for row in inside)
    assert any(row.n_crashes_outside > 0 for row in free)
