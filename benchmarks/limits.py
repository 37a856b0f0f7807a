"""Which traffic a crash rate comes from: the figures of docs/limits.md, from a run of method shells.

    harness run scenarios/smoke.yaml --out runs/limits --set world.engine=twin --set stop.rhw=null \
        --set stop.below_reference=null --set stop.min_crashes=null --set stop.episodes=40000 \
        --set testing.shells.first_tests=3000 --set records.traces=none --set records.trace_share=0
    python -m benchmarks.limits runs/limits

Prints JSON, as it is kept in docs/validation/limits.json. Shares of the rate count a crash with its shell's probability
over the number of tests in the shell, and have standard errors; shares of tests are of a million initial states.
"""

from __future__ import annotations

import json
import sys
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd
from scipy import special

import harness
from harness.campaign.files import load_campaign
from harness.families.cut_in.laws import InitialStates
from harness.families.cut_in.loading import load_environment

FAST_MPS = 40.0
"""144 km/h: the end of the speeds that the traffic was fitted to."""
SHORT_LEAD = 15
"""Steps, 1.5 s from the onset of a cut-in to the overlap."""
STATES = 1_000_000
SEED = 20_240


def of_rate(tests: pd.DataFrame, share: Any) -> list[float]:
    """Share of the crash rate that comes from crashes with a property (0, 1 or between), and its standard error."""
    y = np.exp(tests.log_weight) * (tests.outcome == "crash")
    rate = y.groupby(tests.component).mean().sum()
    known = pd.Series(np.asarray(share, np.float64), tests.index).where(tests.outcome == "crash", 0.0)
    found = (y * known).groupby(tests.component).mean().sum() / rate
    spread = (y * (known - found)).groupby(tests.component)
    return [float(found), float(np.sqrt((spread.var() / spread.size()).sum()) / rate)]


def shares_of_rate(tests: pd.DataFrame, numbers: Any) -> dict[str, list[float]]:
    """What the crashes are like."""
    r2, closing = tests.event_gap_m, np.maximum(-tests.event_rate_mps, 1e-9)
    accept = special.expit((r2 / closing - numbers["cut_in__accept_ttc_s"]) / numbers["cut_in__accept_scale_s"])
    ignore = numbers["cut_in__ignore_share"]
    return {
        "gap_below_2_m": of_rate(tests, r2 < 2.0),
        "gap_below_5_m": of_rate(tests, r2 < 5.0),
        "ttc_below_0.5_s": of_rate(tests, r2 / closing < 0.5),
        "ttc_below_1.5_s": of_rate(tests, r2 / closing < 1.5),
        "ttc_at_onset_below_2_s": of_rate(tests, tests.onset_ttc_s < 2.0),
        "lead_at_most_1.5_s": of_rate(tests, tests.lead_steps <= SHORT_LEAD),
        "crash_within_1_s": of_rate(tests, tests.crash_time_s - 0.1 * tests.event_step <= 1.0),
        "av_above_144_kmph": of_rate(tests, tests.v_bv_mps - tests.r2dot_mps > FAST_MPS),
        "cut_in_ignores_the_av": of_rate(tests, ignore / (ignore + (1.0 - ignore) * accept)),
    }


def shares_of_tests(numbers: Any) -> dict[str, float]:
    """What the initial states are like."""
    states = InitialStates(numbers).draw(SEED, 0, STATES)
    return {
        "av_above_144_kmph": float((states["v_bv_mps"] - states["r2dot_mps"] > FAST_MPS).mean()),
        "lv_set_to_standstill": float((states["v_bv_mps"] + states["r1dot_mps"] < 0.0).mean()),
    }


def limits(folder: Path) -> dict[str, Any]:
    """All figures."""
    tests = harness.read(folder).episodes()
    traffic = load_environment(load_campaign(folder / "campaign.yaml").environment)
    estimate = json.loads((folder / "estimates.json").read_text(encoding="utf-8"))["estimates"]["shells"]
    return {
        "command": "python -m benchmarks.limits runs/limits",
        "crash_rate": estimate["crash_rate"],
        "n_crashes": estimate["n_crashes"],
        "of_the_rate": shares_of_rate(tests, traffic.numbers),
        "of_the_tests": shares_of_tests(traffic.numbers),
        "of_the_cut_ins": {"lead_at_most_1.5_s": float(traffic.lateral.cumulative[SHORT_LEAD])},
    }


if __name__ == "__main__":
    print(json.dumps(limits(Path(sys.argv[1])), indent=1))
