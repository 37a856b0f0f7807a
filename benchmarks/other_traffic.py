"""How far crash shares within shells stay the same in other traffic, by drivers whose rates are known in both.

    python -m benchmarks.other_traffic                        # eleven environments, seven drivers: 8 minutes
    python -m benchmarks.other_traffic --relative-error 0.03  # rougher, in two
    python -m benchmarks.other_traffic --replicates mine.yaml # what is not known of fitted traffic: rates, and ratios

Each driver is a reference driver of the library, of which no shell is made. Its rate in the other traffic is known by
the pool that is built there, and predicted as `harness estimate --environment` does: new probabilities, old shares.
"""

from __future__ import annotations

import argparse
import re
import tempfile
from pathlib import Path

import numpy as np
import yaml

from harness.campaign.files import load_campaign
from harness.campaign.sections import EnvironmentSettings
from harness.pool.build import campaign_pool
from harness.pool.moved import FewPaths
from harness.pool.shells import design_shells
from harness.progress import Progress
from harness.resolved import Resolved, resolve
from harness.runner.other_traffic import read_replicates
from harness.runner.stored_shells import Moved, environment_with
from harness.traffic.loading import load_parameters
from harness.traffic.parameters import SHIPPED_FOLDER
from harness.vehicles.library import OF_TRAFFIC
from harness.vehicles.library import SHIPPED_FOLDER as LIBRARIES

IDM = {"model": "idm"}
DRIVERS = {
    "idm": IDM,
    "late-600ms": {**IDM, "reaction": {"delay_s": 0.6}},
    "brakes-8": {**IDM, "parameters": {"min_acceleration_mps2": -8.0}},
    "brakes-6": {**IDM, "parameters": {"min_acceleration_mps2": -6.0}},
    "fvdm-6": {"model": "fvdm", "parameters": {"min_acceleration_mps2": -6.0}},
}
TRAFFIC = {
    "ignore_share 0.05": {"ignore_share": 0.05},
    "accept_ttc_s 5.1": {"accept_ttc_s": 5.1},
    "ignore_share 0.1, accept_ttc_s 3": {"ignore_share": 0.1, "accept_ttc_s": 3.0},
    "R1 by a quarter wider": {"r1_log_mean": 3.5},
    "R1dot 1.2 times as wide": {"r1dot_log_scale": 0.17},
    "hazard: rate 1.0": {"rate": 1.0},
    "hazard: log_gap -1.5": {"log_gap": -1.5},
    "hard braking 6 times as often": {"brake_logit": -3.0},
    "noise of car following": {"log_scale_rate": 0.448},
    "closing at 6 to 9 m/s": {"r2dot_min_mps": -9.0, "r2dot_max_mps": -6.0},
    "v_BV 4 m/s slower": {"v_location_mps": 30.0},
}
ENVELOPE_MPS2, BESIDE = 2.0, "r157-cc"


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--relative-error", type=float, default=0.01, help="of the pools (default: %(default)s)")
    parser.add_argument("--replicates", metavar="FILE", help="environment that names some: how far known rates spread")
    asked = parser.parse_args()
    if asked.replicates:
        spread(asked.replicates)
        return
    error = asked.relative_error
    shipped = (SHIPPED_FOLDER / "ndd-overtaking-1.yaml").read_text(encoding="utf-8")
    with tempfile.TemporaryDirectory() as name:
        library, environment = Path(name, "library.yaml"), Path(name, "environment.yaml")
        content = yaml.safe_load((LIBRARIES / "ladder-2.yaml").read_text(encoding="utf-8"))
        content["references"] |= DRIVERS
        library.write_text(yaml.safe_dump(content), encoding="utf-8")

        def resolved(*more: str) -> Resolved:
            changes = f"pool={{library: {library}, relative_error: {error}}}", *more
            return resolve(load_campaign("scenarios/overtaking_shells.yaml", changes))

        here = campaign_pool(resolved())
        tested = design_shells(here, ENVELOPE_MPS2)
        print(f"{'traffic':34}" + "".join(f"{each.name:>12}" for each in tested.references), flush=True)
        for words, values in TRAFFIC.items():
            text = shipped
            for key, value in values.items():
                text = re.sub(rf"(\n  {key}: {{value: )[-0-9.]+", rf"\g<1>{value}", text, count=1)
            environment.write_text(text, encoding="utf-8")
            pool = campaign_pool(resolved(f"environment.parameters={environment}"), order=here.names)
            there = Moved.of(tested, design_shells(pool, ENVELOPE_MPS2), words).there
            off = []
            for r, rate in enumerate(there.reference_rate):
                shares = ((tested.cell_p * tested.crashes_too(r)) @ tested.joined) / np.where(tested.p > 0, tested.p, 1)
                off.append(float(there.p @ shares) / rate - 1.0)
            print(f"{words:34}" + "".join(f"{each:12.1%}" for each in off), flush=True)


def spread(environment: str) -> None:
    """Nine tenths of the replicates: by what rates of drivers move, and their ratios to the competent driver."""
    with tempfile.TemporaryDirectory() as name:
        takes_time = load_parameters(EnvironmentSettings(parameters=environment)).lateral_motion().present
        content = yaml.safe_load((LIBRARIES / f"{OF_TRAFFIC[takes_time]}.yaml").read_text(encoding="utf-8"))
        content["references"] |= DRIVERS
        library = Path(name, "library.yaml")
        library.write_text(yaml.safe_dump(content), encoding="utf-8")
        changes = f"environment.parameters={environment}", f"pool.library={library}"
        traffic = resolve(load_campaign("scenarios/smoke.yaml", changes))
        pool = campaign_pool(traffic)
        parameters = load_parameters(traffic.campaign.environment)
        rows = read_replicates(environment, parameters)
        environments = [environment_with(traffic, parameters, row) for row in rows]
        sound = [each for each in environments if each is not None]
        paths = FewPaths(traffic, pool, design_shells(pool, ENVELOPE_MPS2), ENVELOPE_MPS2, Progress())
        first, *others = (each.rate[len(pool.names) :] for each in paths.of([traffic.environment, *sound]))
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
