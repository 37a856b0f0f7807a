"""How often the reference drivers crash, and which crashes of others they avoid.

    python -m benchmarks.reference_drivers

One line per driver: its crashes per test, and the share of the crash rate of three IDM vehicles, the default one, and
0.6 s and 1 s late, that falls on cut-ins on which it does not crash. Standard errors behind ±.
"""

from __future__ import annotations

import numpy as np

from harness import load_campaign
from harness.families import family_named
from harness.families.cut_in.loading import load_environment
from harness.pool.aim import PILOT_PATHS, EnumeratedPaths, Enumerator
from harness.progress import Progress
from harness.vehicles.library import Library
from harness.vocabulary import BoolArray

PATHS = 16_384
SEED = 12_345
TESTED = {
    "idm": {"model": "idm"},
    "late-600ms": {"model": "idm", "reaction": {"delay_s": 0.6}},
    "late-1s": {"model": "idm", "reaction": {"delay_s": 1.0}},
}
REFERENCES = {
    "r157-cc": {"model": "r157-cc"},
    "r157-cc-1mps": {"model": "r157-cc", "parameters": {"lateral_speed_mps": 1.0}},
    "r157-fsm": {"model": "r157-fsm"},
    "r157-fsm-at-once": {"model": "r157-fsm", "parameters": {"evaluated_at_m": 1.6}},
}
ENVELOPE = {"full-throttle-2": {"model": "constant", "parameters": {"acceleration_mps2": 2.0}}}


def main() -> None:
    """Print the rows."""
    drivers = {**TESTED, **REFERENCES, **ENVELOPE}
    described = {"format": "surrogate-library", "version": 1, "boundary": "late-1s", "surrogates": drivers}
    library = Library.model_validate({**described, "envelope": "full-throttle-2"})
    environment, names = load_environment(load_campaign("scenarios/overtaking_shells.yaml").environment), list(drivers)
    pilot = Enumerator(family_named("cut_in"), environment, library.followers(environment.lateral.present), SEED)
    rates = pilot.run(0, PILOT_PATHS, Progress()).rates(len(names))
    # Aimed at the careful ones: the others, and the cut-in itself, are known well enough anyway.
    share = [0.2 if name == "full-throttle-2" else 1.0 for name in names]
    paths = pilot.aimed(rates, np.array([*share, 0.0])).run(PILOT_PATHS, PATHS, Progress())
    crash = {name: ((paths.crashes >> d) & 1).astype(np.bool_) for d, name in enumerate(names)}
    print(f"{'driver':18}{'crashes per test':>22}" + "".join(f"{'avoids of ' + name:>24}" for name in TESTED))
    for name in (*TESTED, *REFERENCES):
        avoided = "".join(f"{avoids(paths, crash[name], crash[of]):>24}" for of in TESTED)
        print(f"{name:18}{rate(paths, crash[name]):>22}{avoided}")


def rate(paths: EnumeratedPaths, crash: BoolArray) -> str:
    """Crash rate, and its relative standard error."""
    by_path = (paths.mass * crash).sum(1)
    return f"{by_path.mean():.3e} ± {by_path.std() / np.sqrt(by_path.size) / by_path.mean():.1%}"


def avoids(paths: EnumeratedPaths, crash: BoolArray, other: BoolArray) -> str:
    """Share of another driver's crash rate on cut-ins on which this one does not crash, and its standard error."""
    both, avoided = ((paths.mass * what).sum(1) for what in (other, other & ~crash))
    share = avoided.mean() / both.mean()
    error = (avoided - share * both).std() / np.sqrt(both.size) / both.mean()
    return f"{share:.1%} ± {error:.1%}"


if __name__ == "__main__":
    main()
