"""Which crashes to look at first: in a table of a run, and those that were traced in the player.

In a comparison they are those on which only one of the two crashes.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import suppress
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import pyarrow as pa
import pyarrow.compute as pc

from harness.errors import HarnessError, RunFolderError
from harness.estimators.severity import weighted_quantiles
from harness.families.protocol import Family
from harness.families.words import Shown
from harness.numbers import count, tenths
from harness.report.drawing import Plot
from harness.report.player import UNKNOWN, ReplayResult, Scene, Scenes, beside_other
from harness.report.plots import WHO, pairs_plot
from harness.report.summary import RunFolder, RunSummary, summarise
from harness.strata import weight_of_a_test
from harness.vocabulary import COMPARISON, CRASH, FAILED, BoolArray, FloatArray, IntArray

CANDIDATES, SHOWN = 50, 3
"""Crashes considered and shown per ranking: with a share of traces only some of the worst have one."""
MOST_JUDGED, MOST_TRACED = 20_000, 1_000
"""Hardest crashes of which it is asked who would have avoided them; of vehicles whose motion the traces must tell."""
SHOWN_ALONE = 2
"""Crashes of A or B alone: a vehicle in foreign code is run again in a process of its own."""
COMPARE_AGAIN = "Run `harness compare` again with the same --out."

Replay = Callable[[Path, int], ReplayResult]


class GalleryRow(NamedTuple):
    """One crash in the table: why it is there, how to see it again, and its place among the scenes if it was traced."""

    episode: int
    crash: dict[str, float]
    shown: list[float]
    reason: str
    share_of_estimate: float
    component: str
    avoided_by: str
    scene: int | None


def shown_of(family: Family) -> list[Shown]:
    """What a table of crashes says of events: each axis of the family's maps once."""
    return list({id(each): each for axes in family.maps for each in axes}.values())


def worst_crashes(key: FloatArray, episode: FloatArray, among: BoolArray) -> list[int]:
    """Places of the `CANDIDATES` largest by a key; ties go to the smaller episode index."""
    order = np.lexsort((episode, -key))
    return [int(place) for place in order[among[order]][:CANDIDATES]]


def crash_gallery(run: RunFolder, summary: RunSummary) -> tuple[list[GalleryRow], list[Scene]]:
    """Crashes that the reference driver avoids, the hardest impacts, typical ones, and those of the largest weights.

    In a run of shells those of the outermost shells take the place of the last. Crashes that nobody avoids are left
    out, unless there are no others. A traced crash goes before a worse one without a trace: it can be watched.
    """
    crashes, scenes, family = summary.crashes, Scenes(run.campaign, run.traffic), run.family
    facts = [each.of(crashes) for each in shown_of(family)]
    first_facts = list(zip(shown_of(family), facts, strict=True))[:2]
    episode = crashes["episode"]
    ends = _ends(run, scenes, episode, crashes["impact_speed_mps"])
    avoided = (ends < 0) & (ends != UNKNOWN)
    stand_in = next(iter(family.stand_ins), "")
    rankings = _rankings(summary, stand_in, avoided, avoided.any(axis=1) | (ends == UNKNOWN).any(axis=1))
    episodes = {int(episode[place]) for ranked in rankings.values() for place in ranked}
    traces = run.traces(episodes)
    traced = set() if traces is None else set(traces.column("episode").unique().to_pylist())
    reasons = _reasons(rankings, [int(each) in traced for each in episode])
    total = float(crashes["weight"].sum())
    stored = run.crashes({int(episode[place]) for place in reasons} & traced)
    rows, shown = list[GalleryRow](), list[Scene]()
    # Shells, or importance functions, of which the forced event is the first.
    names = ["forced", *run.campaign.surrogates] if run.shells is None else [each.shell for each in run.shells.shells]
    for place, why in reasons.items():
        crash = {name: float(column[place]) for name, column in crashes.items()}
        number, component = int(episode[place]), int(crashes["component"][place])
        all_known = ends.size and (ends[place] != UNKNOWN).all()
        who_avoid = [name for name, avoids in zip(family.stand_ins, avoided[place], strict=True) if avoids]
        avoiders = ", ".join(who_avoid) or ("nobody" if all_known else "–")
        scene = None
        if traces is not None and number in traced:
            impact, scene = tenths(crash["impact_speed_mps"]), len(shown)
            row, trace = (table.filter(pc.equal(table["episode"], number)) for table in (stored, traces))
            event = " and ".join(f"{fact.words} {tenths(float(x[place]))} {fact.unit}" for fact, x in first_facts)
            kinds = ", ".join(reason.rpartition(" no. ")[0] for reason in why)
            shown.append(scenes.scene(row, trace, why=f"{event}, impact at {impact} m/s ({kinds})"))
        share = crash["weight"] / total if total > 0.0 else math.nan
        drawn_by = names[component] if 0 <= component < len(names) else "–"
        values = [float(column[place]) for column in facts]
        rows.append(GalleryRow(number, crash, values, ", ".join(why), share, drawn_by, avoiders, scene))
    return rows, shown


def _rankings(summary: RunSummary, stand_in: str, avoided: BoolArray, someone: BoolArray) -> dict[str, list[int]]:
    """Places of crashes by what they are shown for.

    ``avoided`` (n, D) says which drivers avoid them, the ``stand_in`` first; ``someone`` (n,) whether any of them may.
    """
    crashes = summary.crashes
    among = someone if someone.any() else ~someone
    episode, impact, weight = (crashes[name] for name in ("episode", "impact_speed_mps", "weight"))
    all_known = someone.any() and (avoided.any(1) == someone).all()
    hardest = "hardest avoidable" if all_known else "hardest"
    keys = {hardest: impact, "typical": -np.abs(impact - weighted_quantiles(impact, weight, (0.5,))[0])}
    if summary.from_shells:
        keys["outermost"] = crashes["component"]
    elif not summary.all_weights_one:
        keys["weight"] = weight
    first = {f"avoidable by {stand_in}": worst_crashes(impact, episode, avoided[:, 0])} if avoided.size else {}
    return first | {name: worst_crashes(key, episode, among) for name, key in keys.items()}


def _reasons(rankings: Mapping[str, list[int]], traced: Sequence[bool]) -> dict[int, list[str]]:
    """Why a crash is shown, by its place: the first `SHOWN` of each ranking, ``traced`` ones before others."""
    reasons: dict[int, list[str]] = {}
    for reason, ranked in rankings.items():
        chosen = sorted(enumerate(ranked, 1), key=lambda item: not traced[item[1]])[:SHOWN]
        for rank, place in sorted(chosen):
            reasons.setdefault(place, []).append(f"{reason} no. {rank}")
    return reasons


def _ends(run: RunFolder, scenes: Scenes, episode: FloatArray, impact: FloatArray) -> IntArray:
    """The step after which the family's `stand_ins` crash in the AV's place (n, D), below zero for never."""
    ends = np.full((episode.size, len(run.family.stand_ins)), UNKNOWN, np.int64)
    acts = run.campaign.av.acts_before_event
    judged = np.sort(np.argsort(-impact, kind="stable")[: MOST_TRACED if acts else MOST_JUDGED])
    episodes = {int(each) for each in episode[judged]}
    if episodes:
        ends[judged] = scenes.ends(run.crashes(episodes), run.traces(episodes) if acts else None)
    return ends


# -- of a comparison --


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
    axes = runs[0].family.maps[0]
    n_pairs, tests = [shell["n_pairs"] for shell in shells], []
    for run in runs:
        rows = summarise(run).rows
        paired = [np.flatnonzero(rows["component"] == s)[:n] for s, n in enumerate(n_pairs)]
        if [side.size for side in paired] != n_pairs:
            raise RunFolderError(str(run.path), "fewer tests than pairs", f"those of {COMPARISON}", COMPARE_AGAIN)
        tests.append({name: column[np.concatenate(paired)] for name, column in rows.items()})
    a, b = (side["outcome"] == CRASH for side in tests)
    crashed = a | b
    values = np.stack([np.where(a, axis.of(tests[0]), axis.of(tests[1]))[crashed] for axis in axes])
    episode = np.stack([np.where(side["outcome"] == FAILED, -1.0, side["episode"])[crashed] for side in tests])
    impact = np.stack([side["impact_speed_mps"][crashed] for side in tests])
    weight = np.repeat(weight_of_a_test(np.array([shell["p"] for shell in shells]), np.array(n_pairs)), n_pairs)
    who = np.where(a & b, 0, np.where(a, 1, 2))[crashed]
    return CrashPairs(who, weight[crashed], values, episode.astype(np.int64), impact)


def scenes_of(runs: Sequence[RunFolder], pairs: CrashPairs, replay: Replay) -> Iterator[Scene]:
    """The hardest crashes of B alone, then of A alone, beside the other vehicle on the same event."""
    for side, other in ((1, 0), (0, 1)):
        name, impact = "AB"[side], pairs.impact_mps[side]
        places = np.flatnonzero((pairs.who == 1 + side) & (pairs.episode[other] >= 0))
        for place in places[np.argsort(-impact[places], kind="stable")][:SHOWN_ALONE]:
            episodes = [int(each) for each in pairs.episode[:, place]]
            speed = f"{tenths(float(impact[place]))} m/s"
            row, trace = motion_of(runs[side], episodes[side], replay)
            if trace is None:  # nothing to watch
                continue
            scene = Scenes(runs[side].campaign, None).scene(row, trace)
            scene = beside_other(scene, name, "AB"[other], motion_of(runs[other], episodes[other], replay)[1])
            where = " and ".join(f"test {count(n)} of {side_name}" for n, side_name in zip(episodes, "AB", strict=True))
            yield {**scene, "episode": f"only {name}, {speed}", "title": f"Only {name} crashes, at {speed} ({where})"}


def motion_of(run: RunFolder, episode: int, replay: Replay) -> tuple[pa.Table, pa.Table | None]:
    """Row of a crash, and the trace of any episode: the stored one, or of the test run again; None if it cannot be."""
    trace = run.traces({episode})
    if trace is None:
        with suppress(HarnessError):  # of another version, a vehicle that is gone or does not do the same again
            trace = replay(run.path, episode).trace
    return run.crashes({episode}), trace
