"""What deciding by its own paths when a pool has enough of them does to its rates: replicated on paths of one pilot.

    python -m benchmarks.pool_paths [PATHS]

A million aimed paths are the truth (five minutes of one core). Pools are drawn from them in rounds of 1,024, with
replacement, and end by either rule: where their own estimated errors are small enough, or at a number that the pilot
has decided. One line per rule and ``pool.relative_error``, with the error of the mean and the spread of pools, in
per cent: of the surrogate that the first rule puts furthest off, up to the boundary and beyond it.
"""

from __future__ import annotations

import sys

import numpy as np

from harness import load_campaign
from harness.pool.aim import PILOT_PATHS
from harness.pool.build import AGGRESSIVE_ERROR, ROUND_PATHS, Aim, planned_number, take_aim
from harness.progress import Progress
from harness.resolved import resolve
from harness.vocabulary import FloatArray

POOLS = 4000
"""Ten times as many of those whose number of paths is known."""
ERRORS = 0.005, 0.01, 0.03


def stopped(sums: FloatArray, squares: FloatArray, aim: Aim, error: float, rng: np.random.Generator) -> FloatArray:
    """Rates of a pool that ends where its own errors are small enough; ``sums``, ``squares`` (rounds, D + 1)."""
    wanted = error * np.where(aim.conservative, 1.0, AGGRESSIVE_ERROR)
    drawn = rng.integers(0, len(sums), 3 * len(sums))
    n = ROUND_PATHS * np.arange(1, drawn.size + 1)[:, None]
    mean = sums[drawn].cumsum(0) / n
    variance = squares[drawn].cumsum(0) / n - mean * mean
    enough = np.all(np.sqrt(variance / n) <= wanted * mean, axis=1)
    found: FloatArray = mean[np.argmax(enough)]
    return found


def main() -> None:
    """Print the lines."""
    resolved = resolve(load_campaign("scenarios/overtaking_shells.yaml", ["pool.seed=101"]))
    aim = take_aim(resolved, Progress())
    n_rounds, n_surrogates = int(sys.argv[1]) // ROUND_PATHS if sys.argv[1:] else 1024, len(resolved.library.surrogates)
    firsts = range(PILOT_PATHS, PILOT_PATHS + n_rounds * ROUND_PATHS, ROUND_PATHS)
    rates = (aim.enumerator.run(first, ROUND_PATHS, Progress()).rates(n_surrogates) for first in firsts)
    sums, squares = map(np.array, zip(*((each.sum(0), (each * each).sum(0)) for each in rates), strict=True))
    report(sums, squares, aim)


def report(sums: FloatArray, squares: FloatArray, aim: Aim) -> None:
    """Replicate both rules."""
    truth = sums.mean(0) / ROUND_PATHS
    inside, rng = aim.conservative, np.random.default_rng(1)
    for error in ERRORS:
        rounds = planned_number(aim, error) // ROUND_PATHS
        planned = [sums[rng.integers(0, len(sums), rounds)].mean(0) / ROUND_PATHS for _ in range(10 * POOLS)]
        own = [stopped(sums, squares, aim, error, rng) for _ in range(POOLS)]
        far = np.abs(np.mean(own, 0) / truth - 1.0)
        worst = [int(np.argmax(np.where(which, far, 0.0))) for which in (inside, ~inside)]
        for rule, pools in (("its own errors", np.array(own)), (f"{rounds * ROUND_PATHS:,} paths", np.array(planned))):
            off, spread = 100.0 * (pools.mean(0) / truth - 1.0), 100.0 * pools.std(0) / truth
            words = (f"{off[d]:+.3f} +/- {spread[d] / len(pools) ** 0.5:.3f}, spread {spread[d]:.2f}" for d in worst)
            print(f"{error}  {rule:<16} {'   '.join(words)}", flush=True)


if __name__ == "__main__":
    main()
