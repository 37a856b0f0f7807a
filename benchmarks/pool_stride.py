"""How many cut-ins of a path a pool should ask: variance and time per path, by stride.

    python -m benchmarks.pool_stride

One line per stride: n·Var/μ² of each surrogate's crash rate over aimed paths, the CPU time of a path, and the largest
product of both (of the surrogates up to the boundary that ordinary traffic brings to a crash) against stride 1: what a
pool of the asked precision costs.
"""

from __future__ import annotations

import time

from harness import load_campaign
from harness.families import family_named
from harness.families.cut_in.loading import load_environment
from harness.pool.aim import PILOT_PATHS, Enumerator
from harness.progress import Progress
from harness.vehicles.library import load_library

PATHS = 8192
STRIDES = (1, 2, 3, 4, 6, 8)
SEED = 77


def main() -> None:
    """Print the rows."""
    campaign = load_campaign("scenarios/overtaking_shells.yaml")
    environment, library = load_environment(campaign.environment), load_library(campaign.pool.library)
    names = list(library.surrogates)
    before = names[: names.index(library.boundary) + 1]
    followers = library.followers(environment.lateral.present)
    pilot = Enumerator(family_named("cut_in"), environment, followers, SEED)
    pilot_rates = pilot.run(0, PILOT_PATHS, Progress()).rates(len(names))[:, : len(before)]
    print("stride  ms/path  cost  " + "  ".join(before))
    first = 0.0
    for stride in STRIDES:
        enumerator = Enumerator(family_named("cut_in"), environment, followers, SEED, stride=stride).aimed(pilot_rates)
        begin = time.process_time()
        paths = enumerator.run(PILOT_PATHS, PATHS, Progress())
        milliseconds = (time.process_time() - begin) / PATHS * 1e3
        rates = paths.rates(len(names))[:, : len(before)]
        relvar = rates.var(0) / rates.mean(0) ** 2
        cost = milliseconds * relvar.max()
        first = first or cost
        print(
            f"{stride:6}  {milliseconds:7.2f}  {cost / first:4.2f}  " + "  ".join(f"{v:.2f}" for v in relvar),
            flush=True,
        )


if __name__ == "__main__":
    main()
