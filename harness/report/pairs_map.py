"""Pairs of tests of a comparison in which a vehicle crashes, by the records, and their map."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any, NamedTuple

import numpy as np
import pyarrow as pa

from harness.errors import RunFolderError
from harness.numbers import count, number
from harness.report.style import BLUE, FULL_WIDTH_IN, GREY, PAPER, Plot, head, new_figure
from harness.report.summary import RunFolder, floats
from harness.vocabulary import COMPARISON, FloatArray, IntArray

PURPLE = "#7a3aa8"
"""Of B; on the page it is ``--reference``, in which the player draws B."""
WHO = {"both": GREY, "only A": BLUE, "only B": PURPLE}
LARGEST_PT2, CELL_M, CELL_MPS = 250.0, 1.0, 0.5
MEND = "Run `harness compare` again with the same --out."


class Pairs(NamedTuple):
    """Pairs with a crash: who of `WHO`, what it adds to the rate, gap (m) and closing speed (m/s) at the cut-in, (n,).

    The cut-in is that of the vehicle that crashes, A's where both do. ``episode`` and ``impact_mps`` are of A and B,
    (2, n); a failed test, which counts as no crash, has no impact, and a negative episode.
    """

    who: IntArray
    weight: FloatArray
    gap_m: FloatArray
    closing_mps: FloatArray
    episode: IntArray
    impact_mps: FloatArray

    @property
    def counts(self) -> dict[str, int]:
        """Pairs by who crashes."""
        return {name: int(np.count_nonzero(self.who == place)) for place, name in enumerate(WHO)}


def crashing_pairs(runs: Sequence[RunFolder], shells: Sequence[dict[str, Any]]) -> Pairs:
    """Pairs on which A or B crashes, by the records: the i-th test of a shell of A and of B."""
    columns = ("episode", "component", "impact_speed_mps", "cut_in_r2_m", "cut_in_r2dot_mps")
    n_pairs, found = [shell["n_pairs"] for shell in shells], []
    for run in runs:
        rows = pa.Table.from_batches(run.episodes(*columns, "outcome"))
        component = rows["component"].to_numpy()
        first = [np.flatnonzero(component == s)[:n] for s, n in enumerate(n_pairs)]
        if [each.size for each in first] != n_pairs:
            raise RunFolderError(str(run.path), "fewer tests than pairs", f"those of {COMPARISON}", MEND)
        tests, outcome = rows.take(np.concatenate(first)), rows["outcome"].cast(pa.string())
        outcome = outcome.take(np.concatenate(first)).to_numpy()
        values = {name: floats(tests[name]) for name in columns}
        episode = np.where(outcome == "failed", -1.0, values["episode"])
        found.append({**values, "episode": episode, "crash": outcome == "crash"})
    a, b = (each["crash"] for each in found)
    weight = np.repeat([shell["p"] / max(n, 1) for shell, n in zip(shells, n_pairs, strict=True)], n_pairs)
    kept = a | b
    gap, rate = (np.where(a, found[0][name], found[1][name])[kept] for name in columns[-2:])
    episode, impact = (np.stack([of[name][kept] for of in found]) for name in ("episode", "impact_speed_mps"))
    who = np.where(a & b, 0, np.where(a, 1, 2))[kept]
    return Pairs(who, weight[kept], gap, -rate, episode.astype(np.int64), impact)


def map_plot(pairs: Pairs) -> Plot | None:
    """Map of the cut-ins on which a vehicle crashes, over gap and closing speed; None without any."""
    if not pairs.who.size:
        return None
    cells = np.stack((pairs.who, pairs.gap_m // CELL_M, pairs.closing_mps // CELL_MPS))
    (who, *_), place = np.unique(cells, axis=1, return_inverse=True)
    weight = np.bincount(place, pairs.weight)
    gap, closing = (np.bincount(place, pairs.weight * x) / weight for x in (pairs.gap_m, pairs.closing_mps))
    figure = new_figure(FULL_WIDTH_IN, 3.6)
    axes = figure.subplots()
    for kind, (name, colour) in enumerate(WHO.items()):
        of = who == kind
        area = LARGEST_PT2 * weight[of] / weight.max()
        axes.scatter(gap[of], closing[of], area, colour, alpha=0.7, edgecolors=PAPER, linewidths=0.5)
        axes.scatter([], [], 36.0, colour, label=f"{name} ({count(pairs.counts[name])})")
    axes.set(xlim=(0.0, None), xlabel="gap at the cut-in, m", ylabel="closing speed, m/s")
    head(axes, "Cut-ins that crash, by who crashes")
    who_crashes = ", ".join(f"{name} on {count(n)}" for name, n in pairs.counts.items())
    text = (
        f"Cut-ins on which a vehicle crashes: {who_crashes}. The area of a disc is what cut-ins within {CELL_M:g} m "
        f"and {CELL_MPS:g} m/s add to the rate, {number(float(weight.max()))} per test for the largest."
    )
    return Plot("pairs", figure, text, text)
