"""How often the interval of crashes per hour over three scenarios holds, pools and tests drawn anew each time.

``python -m studies.replication.hours --replications 40`` runs built-in vehicles in the twin until the half-width is
0.3 of the rate. The truth is what the enumeration of independent paths says of the same driver; of one that fails at
random, of both that it is, each by its probability.
"""

from __future__ import annotations

import argparse
import sys
import tempfile
from pathlib import Path
from typing import Any

import numpy as np

import harness
from harness.campaign.sections import EnvironmentSettings
from harness.campaign.vehicle import AutomatedVehicle
from harness.commands.printing import print_table
from harness.families import family_named
from harness.families.protocol import Paths
from harness.random_stream import INITIAL, uniforms
from harness.runner.families import Hours
from harness.vehicles.drivers import Followers
from studies.replication.populations import reactions

NAMES = ("cut_in", "lead_brakes", "cut_out")
_GIVEN: dict[str, dict[str, Any]] = {
    "idm": {},
    "late 1 s": {"reaction": {"delay_s": 1.0}},
    "brakes 6 m/s²": {"parameters": {"min_acceleration_mps2": -6.0}},
    "0.5 s behind, late 1 s": {"parameters": {"time_headway_s": 0.5}, "reaction": {"delay_s": 1.0}},
} | {
    f"late 2.5 s in {p:.0%} of tests": {"reaction": {"inattention_probability": p, "inattention_delay_s": 2.5}}
    for p in (0.01, 0.1, 0.3)
}
VEHICLES = {name: AutomatedVehicle.model_validate(given) for name, given in _GIVEN.items()}
"""The first are alike in all tests, so that most strata's shares are 0 or 1; the last fail at random in each."""
TRUTH_SEED, BLOCK = 77_000_001, 1024
POOL_ERROR = 0.03
"""Of the pools that are drawn anew: coarser than by default, so that their error is part of what is judged."""


def truths(paths: int) -> dict[str, tuple[float, float]]:
    """Crashes per hour of each vehicle, with standard errors, from so many paths of each scenario."""
    total, variance = np.zeros((2, len(VEHICLES)))
    for name in NAMES:
        family, settings = family_named(name), EnvironmentSettings()
        traffic = family.traffic(settings)
        each = [reactions(av, family.shows(traffic)) for av in VEHICLES.values()]
        followers = Followers(np.concatenate([records for records, _ in each]))
        drivers = [(i, share) for i, (_, shares) in enumerate(each) for share in shares]
        n = paths if family.follows else 16 * paths
        rates = np.zeros((n, len(VEHICLES) + 1))
        for first in range(0, n, BLOCK):
            u = uniforms(TRUTH_SEED, first, BLOCK, INITIAL, family.n_uniforms)
            given = Paths(first + np.arange(BLOCK), family.start(traffic, u))
            offset = np.random.default_rng(first).integers(0, family.stride, BLOCK)
            found = family.events(traffic, TRUTH_SEED, given, followers, stride=family.stride, offset=offset)
            rows = slice(first, first + BLOCK)
            for d, (i, share) in enumerate(drivers):
                rates[rows, i] += share * np.where(found.crashes >> d & 1, found.probability, 0.0).sum(1)
            rates[rows, -1] = found.probability.sum(1)
        per_hour = family.exposure(traffic, family.parameters(settings)).per_hour / rates[:, -1].mean()
        total += per_hour * rates[:, :-1].mean(0)
        variance += per_hour**2 * rates[:, :-1].var(0) / n
    return dict(zip(VEHICLES, zip(total.tolist(), np.sqrt(variance).tolist(), strict=True), strict=True))


def one(vehicle: str, seed: int, folder: Path) -> tuple[float, float, float, int]:
    """Rate per hour with its limits, and tests, of one campaign."""
    campaign = harness.load_campaign(
        "idm",
        [f"scenarios=[{', '.join(NAMES)}]", "world.engine=twin", f"seed={seed}", f"pool.seed={seed}",
         f"pool.relative_error={POOL_ERROR}", "pool.events_per_shell=5000", "stop.below_reference=null",
         "stop.episodes=60000"],
    ).replaced(("av",), VEHICLES[vehicle])  # fmt: skip
    found = harness.run(campaign, folder, workers=1)
    assert isinstance(found, Hours)
    hour = found.content["per_hour"]
    return hour["rate"], hour["ci_low"], hour["ci_high"], found.content["n_episodes"]


def main() -> None:
    """Print a row a vehicle."""
    options = argparse.ArgumentParser(description=__doc__)
    options.add_argument("--replications", type=int, default=40)
    options.add_argument("--paths", type=int, default=32 * BLOCK, help="of the truth, a multiple of 1,024")
    options.add_argument("--first-seed", type=int, default=1000)
    options.add_argument("--only", default="", help="vehicles whose name this is a part of")
    asked = options.parse_args()
    truth = truths(asked.paths)
    seen: dict[str, list[tuple[float, float, float, int]]] = {name: [] for name in VEHICLES if asked.only in name}
    for seed in range(asked.first_seed, asked.first_seed + asked.replications):
        for name, rows in seen.items():
            with tempfile.TemporaryDirectory() as folder:
                rows.append(one(name, seed, Path(folder) / "run"))
            sys.stderr.write(f"{seed} {name}: {rows[-1]}, truth {truth[name][0]:.4g}\n")
    table = []
    for name, rows in seen.items():
        (rate, low, high, n), (mu, error) = np.array(rows).T, truth[name]
        told = {"vehicle": name, "truth per hour": mu, "±": error, "held": int(((low <= mu) & (mu <= high)).sum())}
        table.append(told | {"of": len(rows), "mean rate / truth": rate.mean() / mu, "median tests": np.median(n)})
    print_table("Crashes per hour", table)


if __name__ == "__main__":
    main()
