"""Replicates of fitted traffic.

A replicate is what other trajectories of the same kind would have given: clusters (recordings, or vehicles where there
are few) are drawn with replacement, and each law moves by the influence of those drawn more or less often than once
(one-step bootstrap: θ + Σ (w_c - 1) influence_c). With few clusters, moves are widened to those of Student's t. Lane
changes in front of a vehicle that closes in are counts: accepted shares are drawn as gamma(k + 1/2) over exposure.
"""

from __future__ import annotations

import numpy as np

from harness.campaign.sections import EnvironmentSettings
from harness.errors import CampaignError, TrajectoryError
from harness.families.cut_in.loading import load_environment, require_sound_laws
from harness.fitting.fit import Fit
from harness.fitting.laws import TTC_EDGES_S
from harness.progress import Progress
from harness.vocabulary import FloatArray

REPLICATES = 200
MOST_DRAWS = 5
"""At most this many times the replicates asked for are drawn, as tests cannot be drawn from some."""
_SHARES = tuple(f"acceptance_steps__share__{j}" for j in range(TTC_EDGES_S.size))


def replicates(fit: Fit, n: int, seed: int, progress: Progress) -> dict[str, FloatArray]:
    """Numbers that vary, by their flat names, in n replicates (n,) from which tests can be drawn.

    Raises `TrajectoryError`: there are too few of these.
    """
    random = np.random.default_rng(seed)
    settings, good = EnvironmentSettings(), []
    progress.stage("replicates", n)
    for _ in range(MOST_DRAWS):
        drawn = _draw(fit, n, random)
        for row in zip(*drawn.values(), strict=True):
            try:
                moved = fit.environment.with_values(dict(zip(drawn, row, strict=True)))
                require_sound_laws(load_environment(settings, moved), "replicate")
            except (CampaignError, ValueError):
                continue
            good.append(row)
            progress.advance(1)
            if len(good) == n:
                return dict(zip(drawn, np.array(good).T, strict=True))
    found = f"{len(good)} of {MOST_DRAWS * n} replicates that tests can be drawn from"
    raise TrajectoryError("replicates", found, f"{n}", "Add recordings, or ask for fewer --replicates.")


def _draw(fit: Fit, n: int, random: np.random.Generator) -> dict[str, list[float]]:
    n_clusters = int(fit.traffic.cluster.max()) + 1
    times = random.multinomial(n_clusters, np.full(n_clusters, 1.0 / n_clusters), n) - 1.0
    times *= np.sqrt(n_clusters / random.chisquare(max(n_clusters - 1, 1), n))[:, None]
    drawn: dict[str, list[float]] = {}
    for name, law in fit.laws.items():
        theta, noise = law.maximum.theta, law.maximum.noise
        moved = theta + times @ law.maximum.influence + random.standard_normal((n, noise.shape[1])) @ noise.T
        values = law.values(moved)
        drawn |= {key: values[:, i].tolist() for i, key in enumerate(law.names) if law.std_error[key] > 0.0}
        if name == "hazard":
            shares = fit.acceptance.drawn(moved, random)
            drawn |= {key: shares[:, j].tolist() for j, key in enumerate(_SHARES)}
    return drawn
