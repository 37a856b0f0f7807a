"""How often the interval of crashes per hour over three scenarios holds, pools and tests drawn anew each time.

``python -m studies.replication.hours --replications 40`` runs built-in vehicles in the twin until the half-width is
0.3 of the rate; with ``--accept`` as a gate whose limit is the vehicle's own ratio to the competent driver, so that
both verdicts are wrong. The truth is what the enumeration of independent paths says of the same drivers; of one that
fails at random, of both that it is, each by its probability.
"""

from __future__ import annotations

import argparse
import sys
import tempfile
from pathlib import Path
from typing import Any

import numpy as np

import harness
from harness.campaign.vehicle import AutomatedVehicle
from harness.commands.printing import print_table
from harness.families.protocol import Paths
from harness.random_stream import INITIAL, uniforms
from harness.resolved import resolve
from harness.runner.run import Hours
from harness.vehicles.drivers import Followers
from harness.vehicles.library import library_records
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
DRIVER = "r157-cc"
POOL_ERROR = 0.03
"""Of the pools that are drawn anew: coarser than by default, so that their error is part of what is judged."""


def truths(paths: int) -> dict[str, tuple[float, float]]:
    """Crashes per hour of each vehicle and of `DRIVER`, with standard errors, from so many paths of each scenario."""
    asked = [*VEHICLES, DRIVER]
    total, variance = np.zeros((2, len(asked)))
    for name in NAMES:
        of = resolve(harness.load_campaign("idm", [f"scenario={name}"]))
        family, traffic, shows = of.family, of.environment, of.family.shows(of.environment)
        each = [reactions(av, shows) for av in VEHICLES.values()]
        each.append((library_records([of.library.references[DRIVER]], shows), [1.0]))
        followers = Followers(np.concatenate([records for records, _ in each]))
        drivers = [(i, share) for i, (_, shares) in enumerate(each) for share in shares]
        n = paths if family.follows else 16 * paths
        rates = np.zeros((n, len(asked) + 1))
        for first in range(0, n, BLOCK):
            u = uniforms(TRUTH_SEED, first, BLOCK, INITIAL, family.n_uniforms)
            given = Paths(first + np.arange(BLOCK), family.start(traffic, u))
            offset = np.random.default_rng(first).integers(0, family.stride, BLOCK)
            found = family.events(traffic, TRUTH_SEED, given, followers, stride=family.stride, offset=offset)
            rows = slice(first, first + BLOCK)
            for d, (i, share) in enumerate(drivers):
                rates[rows, i] += share * np.where(found.crashes >> d & 1, found.probability, 0.0).sum(1)
            rates[rows, -1] = found.probability.sum(1)
        per_hour = family.exposure(traffic, of.parameters).per_hour / rates[:, -1].mean()
        total += per_hour * rates[:, :-1].mean(0)
        variance += per_hour**2 * rates[:, :-1].var(0) / n
    return dict(zip(asked, zip(total.tolist(), np.sqrt(variance).tolist(), strict=True), strict=True))


def one(vehicle: str, seed: int, folder: Path, *asked: str) -> dict[str, Any]:
    """The answer of one campaign with these settings."""
    campaign = harness.load_campaign(
        "idm",
        [f"scenarios=[{', '.join(NAMES)}]", "world.engine=twin", f"seed={seed}", f"pool.seed={seed}",
         f"pool.relative_error={POOL_ERROR}", "pool.events_per_shell=5000", "stop.below_reference=null", *asked],
    ).replaced(("av",), VEHICLES[vehicle])  # fmt: skip
    found = harness.run(campaign, folder, workers=1)
    assert isinstance(found, Hours)
    return found.content


def main() -> None:
    """Print a row a vehicle."""
    options = argparse.ArgumentParser(description=__doc__)
    options.add_argument("--replications", type=int, default=40)
    options.add_argument("--paths", type=int, default=32 * BLOCK, help="of the truth, a multiple of 1,024")
    options.add_argument("--first-seed", type=int, default=1000)
    options.add_argument("--only", default="", help="vehicles whose name this is a part of")
    options.add_argument("--accept", type=int, metavar="TESTS", help="a gate at the vehicle's own ratio, so many tests")
    asked = options.parse_args()
    truth = truths(asked.paths)
    seen: dict[str, list[dict[str, Any]]] = {name: [] for name in VEHICLES if asked.only in name}
    for seed in range(asked.first_seed, asked.first_seed + asked.replications):
        for name, answers in seen.items():
            settings = ["stop.episodes=60000"]
            if asked.accept:
                limit = f"{{driver: {DRIVER}, at_most: {truth[name][0] / truth[DRIVER][0]}}}"
                settings = [f"stop.episodes={asked.accept}", "stop.rhw=null", f"accept={{times_reference: {limit}}}"]
            with tempfile.TemporaryDirectory() as folder:
                answers.append(one(name, seed, Path(folder) / "run", *settings))
            told = answers[-1]["decision"]["verdict"] if asked.accept else answers[-1]["per_hour"]
            sys.stderr.write(f"{seed} {name}: {told}, truth {truth[name][0]:.4g}\n")
    table = []
    for name, answers in seen.items():
        told = [of["decision"]["verdict"] for of in answers] if asked.accept else []
        row = {"limit": truth[name][0] / truth[DRIVER][0]} | {v: told.count(v) for v in ("accepted", "rejected")}
        table.append({"vehicle": name, **(row if asked.accept else _held(answers, *truth[name])), "of": len(answers)})
    print_table("Gates at their limit" if asked.accept else "Crashes per hour", table)


def _held(answers: list[dict[str, Any]], mu: float, error: float) -> dict[str, Any]:
    rate, low, high = np.array([[of["per_hour"][key] for key in ("rate", "ci_low", "ci_high")] for of in answers]).T
    told = {"truth per hour": mu, "±": error, "mean rate / truth": rate.mean() / mu}
    told["median tests"] = np.median([of["n_episodes"] for of in answers])
    return told | {"held": int(((low <= mu) & (mu <= high)).sum())}


if __name__ == "__main__":
    main()
