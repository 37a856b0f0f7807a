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
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np

import harness
from harness.campaign.drivers import IDMParameters, Reaction
from harness.families.protocol import Paths
from harness.random_stream import INITIAL, uniforms
from harness.resolved import resolve
from harness.runner.run import Hours
from harness.vehicles.drivers import Followers, driver_records
from harness.vehicles.library import library_records

NAMES = ("cut_in", "lead_brakes", "cut_out")
VEHICLES = {
    "idm": (IDMParameters(), Reaction()),
    "late 1 s": (IDMParameters(), Reaction(delay_s=1.0)),
    "brakes 6 m/s²": (IDMParameters(min_acceleration_mps2=-6.0), Reaction()),
    "0.5 s behind, late 1 s": (IDMParameters(time_headway_s=0.5), Reaction(delay_s=1.0)),
} | {
    f"late 2.5 s in {p:.0%} of tests": (
        IDMParameters(), Reaction(inattention_probability=p, inattention_delay_s=2.5),
    )
    for p in (0.01, 0.1, 0.3)
}  # fmt: skip
"""The first are alike in all tests, so that most strata's shares are 0 or 1; the last fail at random in each."""
TRUTH_SEED, BLOCK = 77_000_001, 1024
DRIVER = "r157-cc"
POOL_ERROR = 0.03
"""Of the pools that are drawn anew: coarser than by default, so that their error is part of what is judged."""


def truths(paths: int) -> dict[str, tuple[float, float]]:
    """Crashes per hour of each vehicle and of `DRIVER`, with standard errors, from so many paths of each scenario."""
    drivers, reactions = zip(*VEHICLES.values(), strict=True)
    late = [{"delay_s": each.delay_s + each.inattention_delay_s, "inattention_probability": 0.0} for each in reactions]
    attentive = [each.model_copy(update={"inattention_probability": 0.0}) for each in reactions]
    inattentive = [each.model_copy(update=given) for each, given in zip(reactions, late, strict=True)]
    part = np.array([each.inattention_probability for each in reactions])
    parts, asked = np.concatenate([1.0 - part, part, [1.0]]), [*VEHICLES, DRIVER]
    total, variance = np.zeros((2, len(asked)))
    for name in NAMES:
        of = resolve(harness.load_campaign("idm", [f"scenario={name}"]))
        family, traffic, see_onset = of.family, of.environment, of.family.shows(of.environment)
        both = driver_records(drivers * 2, attentive + inattentive, see_onset=see_onset)
        followers = Followers(np.concatenate([both, library_records([of.library.references[DRIVER]], see_onset)]))
        n = paths if family.follows else 16 * paths
        rates = np.zeros((n, len(asked) + 1))
        for first in range(0, n, BLOCK):
            u = uniforms(TRUTH_SEED, first, BLOCK, INITIAL, family.n_uniforms)
            given = Paths(first + np.arange(BLOCK), family.start(traffic, u))
            offset = np.random.default_rng(first).integers(0, family.stride, BLOCK)
            found = family.events(traffic, TRUTH_SEED, given, followers, stride=family.stride, offset=offset)
            rows = slice(first, first + BLOCK)
            for d, p in enumerate(parts):
                column = d % part.size if d < 2 * part.size else part.size
                rates[rows, column] += p * np.where(found.crashes >> d & 1, found.probability, 0.0).sum(1)
            rates[rows, -1] = found.probability.sum(1)
        per_hour = family.exposure(traffic, of.parameters).per_hour / rates[:, -1].mean()
        total += per_hour * rates[:, :-1].mean(0)
        variance += per_hour**2 * rates[:, :-1].var(0) / n
    return dict(zip(asked, zip(total.tolist(), np.sqrt(variance).tolist(), strict=True), strict=True))


def one(vehicle: str, seed: int, folder: Path, *asked: str) -> dict[str, Any]:
    """The answer of one campaign with these settings."""
    parameters, reaction = VEHICLES[vehicle]
    given = [f"av.parameters.{key}={value}" for key, value in parameters.model_dump(exclude_defaults=True).items()]
    given += [f"av.reaction.{key}={value}" for key, value in reaction.model_dump(exclude_defaults=True).items()]
    campaign = harness.load_campaign(
        "idm",
        [f"scenarios=[{', '.join(NAMES)}]", "world.engine=twin", f"seed={seed}", f"pool.seed={seed}", *given,
         f"pool.relative_error={POOL_ERROR}", "pool.events_per_shell=5000", "stop.below_reference=null", *asked],
    )  # fmt: skip
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
    print(_verdicts(seen, truth) if asked.accept else _intervals(seen, truth))  # noqa: T201


def _intervals(seen: Mapping[str, list[dict[str, Any]]], truth: Mapping[str, tuple[float, float]]) -> str:
    lines = [
        "| vehicle | truth per hour | held | mean rate / truth | tests, median |",
        "| --- | --- | --- | --- | --- |",
    ]
    for name, answers in seen.items():
        rate, low, high = np.array([[of["per_hour"][k] for k in ("rate", "ci_low", "ci_high")] for of in answers]).T
        (mu, error), held = truth[name], int(((low <= truth[name][0]) & (truth[name][0] <= high)).sum())
        n = np.median([of["n_episodes"] for of in answers])
        told = f"{mu:.3g} ± {error:.1g} | {held} of {len(rate)} | {rate.mean() / mu:.2f} | {n:,.0f} |"
        lines.append(f"| {name} | {told}")
    return "\n".join(lines)


def _verdicts(seen: Mapping[str, list[dict[str, Any]]], truth: Mapping[str, tuple[float, float]]) -> str:
    lines = ["| vehicle | limit | accepted | rejected | campaigns |", "| --- " * 5 + "|"]
    for name, answers in seen.items():
        verdicts = [of["decision"]["verdict"] for of in answers]
        limit = f"{truth[name][0] / truth[DRIVER][0]:.3g} × {DRIVER}"
        counted = f"{verdicts.count('accepted')} | {verdicts.count('rejected')} | {len(verdicts)} |"
        lines.append(f"| {name} | {limit} | {counted}")
    return "\n".join(lines)


if __name__ == "__main__":
    main()
