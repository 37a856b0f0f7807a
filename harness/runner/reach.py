"""Which crash rates a campaign can tell within its budget, and where an upper limit is all that it can give.

A rate to within ± r of itself needs some 1.6 ln(1/α) p/(2 r μ) tests, p being the probability of the cut-ins that have
to be shown not to crash: without an assumption all that the envelope reaches, inside a boundary those of its shells.
(Lower bound ln(1/α) p/(2 r μ); the panel of docs/shells-validation.md took 1.5 to 1.75 times that.) Where cut-ins take
time, the rate of an attentive vehicle falls by orders of magnitude, and that number of tests grows as its inverse; what
remains is the upper limit ln(1/α) p/n.
"""

from __future__ import annotations

import math

from harness.campaign.models import Campaign
from harness.pool.cut_ins import Pool
from harness.pool.shells import acceleration_limit, design_shells
from harness.strata import ASSUMPTION_FREE, ShellDesign

OVER_BOUND = 1.6
"""Tests that a rate takes, over the lower bound (measured: medians of the panel, 1.5 to 1.75)."""
USUAL_RHW = 0.3


def reach_of_statements(campaign: Campaign, pool: Pool) -> dict[str, str]:
    """What each statement can say within ``stop.episodes``, by its name."""
    limit = acceleration_limit(campaign.av)
    design = design_shells(pool, shells=campaign.testing.shells, limit_mps2=limit)
    return {
        name: _reach(p, campaign.stop.rhw or USUAL_RHW, campaign.stop.confidence, campaign.stop.episodes)
        for name, p in _at_stake(design).items()
    }


def _at_stake(design: ShellDesign) -> dict[str, float]:
    """Probability of the cut-ins that each statement has to be sure about."""
    inside = {each.name: float(design.p[: each.n_inside].sum()) for each in design.statements}
    return {ASSUMPTION_FREE: float(design.p.sum()), **inside}


def _reach(p: float, rhw: float, confidence: float, n: int) -> str:
    nats = math.log(1.0 / (1.0 - confidence))
    smallest, limit = OVER_BOUND * nats * p / (2.0 * rhw * n), nats * p / n
    return (
        f"a rate to within ±{100.0 * rhw:.0f} % from some {smallest:.1e} per test on, with {n:,} tests; of a vehicle "
        f"that crashes less an upper limit, {limit:.1e} without a crash"
    )
