"""The page of a comparison: both answers, what lies between them, and the events on which only one vehicle crashes."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator, Sequence
from contextlib import suppress
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import pyarrow as pa

from harness.errors import HarnessError, RunFolderError
from harness.families import family_named
from harness.families.protocol import Family
from harness.numbers import count, tenths
from harness.report.drawing import Plot
from harness.report.hour_words import beside_row, called
from harness.report.pair_words import deciding_words, pair_asked, pair_warnings, pair_words, rates_of, ratio_words
from harness.report.player import ReplayResult, Scene, Scenes, beside_other
from harness.report.plots import WHO, pairs_plot
from harness.report.summary import RunFolder, summarise
from harness.report.templates import write_page
from harness.report.words import short_answer
from harness.strata import weight_of_a_test
from harness.vocabulary import COMPARISON, CRASH, FAILED, FloatArray, IntArray

MEND = "Run `harness compare` again with the same --out."

Replay = Callable[[Path, int], ReplayResult]
SHOWN = 2
"""Crashes of each: a vehicle in foreign code is run again in a process of its own."""


def write_page_of(folder: Path, stored: dict[str, Any], runs: Sequence[RunFolder], replay: Replay) -> Path:
    """Write the page of a comparison in hand; ``replay`` runs a test of one of its folders again."""
    pairs, campaign = crashing_pairs(runs, stored["shells"]), runs[0].campaign
    family = family_named(campaign.scenario)
    answers = [short_answer(run.campaign, run.manifest, run.estimates) for run in runs]
    of_each = [{row.key: row for row in answer.rows} for answer in answers]
    shown = {"ratio": "× competent driver", "impact": "impact"}
    return _write(
        folder, stored, [(answer.vehicle, answer.parameters) for answer in answers],
        [(what, [rows.get(key) for rows in of_each]) for key, what in shown.items()],
        above=campaign.crash.counts_above_mps, level=campaign.environment.lane_change_level,
        family=family, words=family.words, plot=pairs.plot(family),
        scenes=list(scenes_of(runs, pairs, replay)), counts=pairs.counts,
    )  # fmt: skip


def write_sum(folder: Path, stored: dict[str, Any]) -> Path:
    """Write the page of a comparison in several scenarios: the sum, and the way to each one's own page."""
    beside = [beside_row("", stored[side]["beside"], seen=stored[side]["n_crashes"] > 0) for side in "ab"]
    scenarios = [
        (called(name), name, of, ratio_words(of), pair_words(of["decision"])) for name, of in stored["families"].items()
    ]
    vehicles = [(of["label"], ()) for of in stored["campaigns"].values()]
    return _write(folder, stored, vehicles, [("× competent driver", beside)], above=0.0, scenarios=scenarios)


def _write(
    folder: Path, stored: dict[str, Any], vehicles: Iterable[tuple[Any, ...]], rows: Sequence[Any], **content: Any
) -> Path:
    """Write either page; ``rows`` are what its table has besides, of A and of B."""
    asked, sides = pair_asked(stored), zip("AB", vehicles, strict=True)
    return write_page(
        folder / "report.html", "compare.html.j2",
        compared=stored, asked=asked, given=asked is not stored, ratio=ratio_words(asked),
        verdict=pair_words(stored["decision"]), to_decide=deciding_words(stored), warnings=list(pair_warnings(stored)),
        vehicles=[(name, *of) for name, of in sides], rates=[rates_of(stored[side]) for side in "ab"],
        rows=rows, **content,
    )  # fmt: skip


class CrashPairs(NamedTuple):
    """Pairs with a crash: who of `WHO`, what it adds to the rate, and of the event what a map's axes show, (2, n).

    The event is that of the vehicle that crashes, A's where both do. ``episode`` and ``impact_mps`` are of A and B,
    (2, n); a failed test, which counts as no crash, has no impact, and a negative episode.
    """

    who: IntArray
    weight: FloatArray
    values: FloatArray
    episode: IntArray
    impact_mps: FloatArray

    @property
    def counts(self) -> dict[str, int]:
        """Pairs by who crashes."""
        return {name: int(np.count_nonzero(self.who == place)) for place, name in enumerate(WHO)}

    def plot(self, family: Family) -> Plot | None:
        """Their map; None without any."""
        return pairs_plot(self.who, self.weight, self.values, family)


def crashing_pairs(runs: Sequence[RunFolder], shells: Sequence[dict[str, Any]]) -> CrashPairs:
    """Pairs on which A or B crashes, by the records: the i-th test of a shell of A and of B."""
    axes = family_named(runs[0].campaign.scenario).maps[0]
    n_pairs, found = [shell["n_pairs"] for shell in shells], []
    for run in runs:
        rows = summarise(run).rows
        first = [np.flatnonzero(rows["component"] == s)[:n] for s, n in enumerate(n_pairs)]
        if [each.size for each in first] != n_pairs:
            raise RunFolderError(str(run.path), "fewer tests than pairs", f"those of {COMPARISON}", MEND)
        found.append({name: column[np.concatenate(first)] for name, column in rows.items()})
    a, b = (each["outcome"] == CRASH for each in found)
    kept = a | b
    of_map = np.stack([np.where(a, axis.of(found[0]), axis.of(found[1]))[kept] for axis in axes])
    episode = np.stack([np.where(each["outcome"] == FAILED, -1.0, each["episode"])[kept] for each in found])
    impact = np.stack([each["impact_speed_mps"][kept] for each in found])
    weight = np.repeat(weight_of_a_test(np.array([shell["p"] for shell in shells]), np.array(n_pairs)), n_pairs)
    who = np.where(a & b, 0, np.where(a, 1, 2))[kept]
    return CrashPairs(who, weight[kept], of_map, episode.astype(np.int64), impact)


def scenes_of(runs: Sequence[RunFolder], pairs: CrashPairs, replay: Replay) -> Iterator[Scene]:
    """The hardest crashes of B alone, then of A alone, beside the other vehicle on the same event."""
    family = family_named(runs[0].campaign.scenario)
    for side, other in ((1, 0), (0, 1)):
        name, impact = "AB"[side], pairs.impact_mps[side]
        places = np.flatnonzero((pairs.who == 1 + side) & (pairs.episode[other] >= 0))
        for place in places[np.argsort(-impact[places], kind="stable")][:SHOWN]:
            episodes = [int(each) for each in pairs.episode[:, place]]
            told = f"{tenths(float(impact[place]))} m/s"
            row, trace = motion_of(runs[side], episodes[side], replay)
            if trace is None:
                continue
            scene = Scenes(runs[side].campaign, None).scene(row, trace)
            scene = beside_other(scene, name, "AB"[other], motion_of(runs[other], episodes[other], replay)[1], family)
            where = " and ".join(f"test {count(n)} of {of}" for n, of in zip(episodes, "AB", strict=True))
            yield {**scene, "episode": f"only {name}, {told}", "title": f"Only {name} crashes, at {told} ({where})"}


def motion_of(run: RunFolder, episode: int, replay: Replay) -> tuple[pa.Table, pa.Table | None]:
    """Row of a crash, and the trace of any episode: the stored one, or of the test run again; None if it cannot be."""
    trace = run.traces({episode})
    if trace is None:
        with suppress(HarnessError):  # of another version, a vehicle that is gone or does not do the same again
            trace = replay(run.path, episode).trace
    return run.crashes({episode}), trace
