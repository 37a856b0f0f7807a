"""What crashes have in common, as a start for a look of your own: `python examples/what_crashes_share.py runs/smoke`.

Of each quantity at the cut-in it shows the twentieth of all tests that holds the largest share of the crashes, and how
often chance alone would do as well: so many relabelings of crash and no crash give a share as large anywhere.
"""

import sys
from pathlib import Path

import numpy as np
import pandas as pd

import harness

BINS, RELABELINGS = 20, 199


def conditions(tests: pd.DataFrame) -> pd.DataFrame:
    """Quantities at the cut-in; an AV that keeps its speed until then has the initial one."""
    closing = (-tests["event_rate_mps"]).clip(lower=0.0)
    return pd.DataFrame(
        {
            "AV speed, m/s": tests["v_bv_mps"] - tests["r2dot_mps"],
            "gap R2, m": tests["event_gap_m"],
            "closing speed, m/s": closing,
            "needed braking, m/s²": closing**2 / (2.0 * tests["event_gap_m"]),
            "time of the cut-in, s": 0.1 * tests["event_step"],
        }
    )


def what_crashes_share(folder: str | Path) -> pd.DataFrame:
    """The band of each quantity that crashes share most, with a p-value over all bands and quantities."""
    tests = harness.read(folder).episodes()
    tests = tests[tests["event_step"].notna() & (tests["outcome"] != "failed")]
    if harness.load_campaign(Path(folder) / "campaign.yaml").testing.method == "shells":
        tests = tests[tests["component"] == tests["component"].max()]  # outside: one stratum, where all count the same
    values, crash, weight = conditions(tests), (tests["outcome"] == "crash").to_numpy(), tests["weight"].to_numpy()
    bins = {name: pd.qcut(column, BINS, duplicates="drop") for name, column in values.items()}

    def shares(crashed: np.ndarray) -> pd.Series:
        """Share of the crashes' weight in the fullest band of each quantity."""
        mass = pd.Series(weight * crashed, tests.index)
        each = {name: mass.groupby(band, observed=False).sum() for name, band in bins.items()}
        return pd.concat(each) / max(mass.sum(), 1e-300)

    share, rng = shares(crash), np.random.default_rng(1)
    by_chance = np.array([shares(rng.permutation(crash)).max() for _ in range(RELABELINGS)])
    best = share.loc[share.groupby(level=0).idxmax()].rename_axis(["quantity", "band"]).rename("share of crashes")
    p_value = [(1 + np.sum(by_chance >= found)) / (1 + RELABELINGS) for found in best]
    return best.reset_index().assign(p_value=p_value).sort_values("share of crashes", ascending=False)


if __name__ == "__main__":
    found = what_crashes_share(sys.argv[1])
    none = "No crash to look at: of shells only those beyond the library's boundary are compared."
    print(found.to_string(index=False) if found["share of crashes"].any() else none)  # noqa: T201 - it is the answer
