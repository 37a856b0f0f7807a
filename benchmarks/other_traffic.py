"""How far crash shares within shells stay the same in other traffic, by drivers whose rates are known in both.

    python -m benchmarks.other_traffic                        # 25 environments, twelve drivers: 15 minutes
    python -m benchmarks.other_traffic --relative-error 0.03  # rougher, in three
    python -m benchmarks.other_traffic --runs FOLDER          # the same by tests, of three vehicles, in the default
    python -m benchmarks.other_traffic --replicates mine.yaml # what is not known of fitted traffic: rates, and ratios

Each driver is a reference driver of the library, of which no shell is made. Its rate in the other traffic is known by
the pool that is built there, and predicted as `harness estimate --environment` does: new probabilities, old shares.
Rates of drivers that few of the pool's paths meet are known badly: standard errors stand beside them.
"""

from __future__ import annotations

import argparse
import json
import math
import tempfile
from collections.abc import Mapping
from dataclasses import replace
from pathlib import Path

import numpy as np
import yaml

from harness.campaign.files import load_campaign
from harness.errors import HarnessError
from harness.families.cut_in.loading import load_parameters
from harness.pool.build import campaign_pool
from harness.pool.moved import FewPaths, environment_with
from harness.pool.shells import design_shells
from harness.progress import Progress
from harness.records.reader import read_replicates
from harness.resolved import Resolved, resolve
from harness.runner.other_traffic import estimate_in_other_traffic
from harness.runner.run import run_campaign
from harness.runner.stored_shells import MOST_OFF, moved_design, reference_shares
from harness.strata import ShellDesign
from harness.vehicles.library import SHIPPED_FOLDER as LIBRARIES
from harness.vocabulary import FloatArray

IDM = {"model": "idm"}
DRIVERS = {
    "idm": IDM,
    "late-300ms": {**IDM, "reaction": {"delay_s": 0.3}},
    "late-600ms": {**IDM, "reaction": {"delay_s": 0.6}},
    "brakes-8": {**IDM, "parameters": {"min_acceleration_mps2": -8.0}},
    "brakes-6": {**IDM, "parameters": {"min_acceleration_mps2": -6.0}},
    "brakes-5": {**IDM, "parameters": {"min_acceleration_mps2": -5.0}},
    "brakes-45": {**IDM, "parameters": {"min_acceleration_mps2": -4.5}},
    "late-800ms": {**IDM, "reaction": {"delay_s": 0.8}},
    "sees-1m": {**IDM, "reaction": {"perceives_lateral_m": 1.0}},
    "fvdm-6": {"model": "fvdm", "parameters": {"min_acceleration_mps2": -6.0}},
}
LOOK, ACCEPT, LEAD = "cut_in__ignore_share", "cut_in__accept_ttc_s", "lateral__speed"
TRAFFIC = {
    "ignore_share 0.05": {LOOK: 0.05},
    "accept_ttc_s 5.1": {ACCEPT: 5.1},
    "ignore_share 0.1, accept_ttc_s 3": {LOOK: 0.1, ACCEPT: 3.0},
    "R1 by a quarter wider": {"initial_state__r1_log_mean": 3.5},
    "R1dot 1.2 times as wide": {"initial_state__r1dot_log_scale": 0.17},
    "hazard: rate 1.0": {"cut_in__rate": 1.0},
    "hazard: log_gap -1.5": {"cut_in__log_gap": -1.5},
    "hard braking 6 times as often": {"free_driving__brake_logit": -3.0},
    "noise of car following": {"car_following__log_scale_rate": 0.448},
    "closing at 6 to 9 m/s": {"initial_state__r2dot_min_mps": -9.0, "initial_state__r2dot_max_mps": -6.0},
    "v_BV 4 m/s slower": {"initial_state__v_location_mps": 30.0},
}
TAKES_TIME = TRAFFIC | {
    "R1dot 1.2 times as wide": {"initial_state__r1dot_log_scale": 0.88},
    "hard braking twice as often": {"free_driving__brake_logit": -4.8},
    "lateral speed a tenth higher": {f"{LEAD}_median_mps": 0.95},
    "lateral speed: log_sd 0.36": {f"{LEAD}_log_sd": 0.36},
}
SCENARIOS = {"scenarios/overtaking_shells.yaml": TRAFFIC, "scenarios/smoke.yaml": TAKES_TIME}
"""Cut-ins of one step, and such that take time."""
ENVELOPE_MPS2, BESIDE = 2.0, "r157-cc"
TESTED = {
    "late-300ms": ("av.reaction.delay_s=0.3",),
    "late-600ms": ("av.reaction.delay_s=0.6",),
    "r157-cc": ("av={model: r157-cc}",),
}
MORE = {"closing at 5 to 16 m/s": {"initial_state__r2dot_min_mps": -16.0}}
"""Unlike what is tested elsewhere."""
N_TESTS = 8_000


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--relative-error", type=float, default=0.01, help="of the pools (default: %(default)s)")
    parser.add_argument("--replicates", metavar="FILE", help="environment that names some: how far known rates spread")
    parser.add_argument("--runs", metavar="FOLDER", help="where to run three vehicles, in the twin")
    asked = parser.parse_args()
    if asked.runs:
        by_tests(Path(asked.runs))
        return
    if asked.replicates:
        spread(asked.replicates)
        return
    for scenario, traffic in SCENARIOS.items():
        moved(scenario, traffic, asked.relative_error)


def with_drivers(folder: str, campaign: str, *changes: str) -> Resolved:
    """A campaign in whose library the drivers are references."""
    traffic = resolve(load_campaign(campaign, changes))
    content = yaml.safe_load((LIBRARIES / f"{traffic.campaign.pool.library}.yaml").read_text(encoding="utf-8"))
    content["references"] |= DRIVERS
    library = Path(folder, "library.yaml")
    library.write_text(yaml.safe_dump(content), encoding="utf-8")
    return resolve(load_campaign(campaign, (*changes, f"pool.library={library}")))


def moved(scenario: str, traffic: Mapping[str, Mapping[str, float]], error: float) -> None:
    """By how much rates come out wrong in each traffic."""
    with tempfile.TemporaryDirectory() as folder:
        base = with_drivers(folder, scenario, f"pool.relative_error={error}")
        here = campaign_pool(base)
        tested = design_shells(here, ENVELOPE_MPS2)
        names = [each.name for each in tested.references]
        shipped = [r for r, name in enumerate(names) if name not in DRIVERS]

        def show(words: str, numbers: FloatArray, form: str, after: str = "") -> None:
            print(f"{words:34}" + "".join(f"{each:12{form}}" for each in numbers) + after, flush=True)

        print(f"{base.campaign.environment.parameters:34}" + "".join(f"{name:>12}" for name in names), flush=True)
        p, shares = tested.p, reference_shares(tested)
        show("crashing share of shells", (p @ shares**2) / (p @ shares), ".2f")  # refused below `LEAST_SHARE`
        show("standard error of a rate", _error(tested), ".1%")
        for words, values in traffic.items():
            environment = environment_with(base, values)
            if environment is None:
                print(f"{words:34}  no laws", flush=True)
                continue
            pool = campaign_pool(replace(base, environment=environment), order=here.names)
            there = moved_design(tested, design_shells(pool, ENVELOPE_MPS2), words)
            off = there.p @ shares / there.reference_rate - 1.0
            show(words, off, ".1%", "  refused" if np.abs(off[shipped]).max() > MOST_OFF else "")


def _error(design: ShellDesign) -> FloatArray:
    rate, square = design.reference_rate, design.reference_square
    return np.asarray(np.sqrt(np.maximum(square / rate**2 - 1.0, 0.0) / design.n_paths))


def by_tests(folder: Path) -> None:
    """Answers of old tests over those of new ones in the other traffic, and standard errors of both together."""
    shipped = load_parameters(load_campaign("scenarios/smoke.yaml").environment)
    fixed = (
        "world.engine=twin",
        "pool.relative_error=0.01",
        "stop.rhw=0.001",
        "stop.below_reference=null",
        "testing.shells.statement=library",
        f"stop.episodes={N_TESTS}",
    )
    print(f"{'':34}" + "".join(f"{vehicle:>16}" for vehicle in TESTED), flush=True)
    for words, values in {"": {}, **TAKES_TIME, **MORE}.items():
        environment = folder / "traffic.yaml"
        environment.parent.mkdir(parents=True, exist_ok=True)
        environment.write_text(yaml.safe_dump(shipped.with_values(values).model_dump(exclude_none=True)))
        cells = []
        for vehicle, changes in TESTED.items():
            old, new = folder / vehicle, folder / f"{vehicle} {words}"
            if not words:
                run_campaign(load_campaign("scenarios/smoke.yaml", (*fixed, *changes)), old)
                continue
            try:
                told = estimate_in_other_traffic(old, str(environment))
            except HarnessError:
                cells.append("refused")
                continue
            elsewhere = f"environment.parameters={environment}"
            run_campaign(load_campaign("scenarios/smoke.yaml", (*fixed, *changes, elsewhere, "seed=2")), new)
            known = json.loads((new / "estimates.json").read_text(encoding="utf-8"))
            found = [each["estimates"]["shells"] for each in (told, known)]
            rate, other = (each["crash_rate"] for each in found)
            error = math.hypot(*(each["std_error"] / each["crash_rate"] for each in found))
            cells.append(f"{rate / other - 1.0:.1%} ± {error:.1%}")
        print(f"{words:34}" + "".join(f"{cell:>16}" for cell in cells), flush=True)


def spread(environment: str) -> None:
    """Nine tenths of the replicates: by what rates of drivers move, and their ratios to the competent driver."""
    with tempfile.TemporaryDirectory() as folder:
        traffic = with_drivers(folder, "scenarios/smoke.yaml", f"environment.parameters={environment}")
        pool = campaign_pool(traffic)
        rows = read_replicates(environment, traffic.parameters, traffic.family.shipped)
        environments = [environment_with(traffic, row) for row in rows]
        sound = [each for each in environments if each is not None]
        paths = FewPaths(traffic, pool, design_shells(pool, ENVELOPE_MPS2), ENVELOPE_MPS2, Progress())
        first, *others = (each.references for each in paths.of([traffic.environment, *sound]))
    drivers = list(pool.library.references)
    rate = np.array(others) / np.where(first > 0.0, first, np.nan)
    ratio = rate / rate[:, [drivers.index(BESIDE)]]
    print(f"{len(sound)} of {len(rows)} replicates of {environment}: 90 % of factors")
    print(f"{'driver':14}{'rate per test':>14}{'of the rate':>20}{'of the ratio':>20}")
    for r, driver in enumerate(drivers):
        ends = [" … ".join(f"{end:.3g}" for end in np.quantile(of[:, r], [0.05, 0.95])) for of in (rate, ratio)]
        print(f"{driver:14}{first[r]:14.3g}{ends[0]:>20}{ends[1]:>20}", flush=True)


if __name__ == "__main__":
    main()
