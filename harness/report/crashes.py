"""Which crashes to look at first: a row of the table for each, and of those that were traced a scene of the player."""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np
import pyarrow.compute as pc

from harness.estimators.severity import weighted_quantiles
from harness.families import family_named
from harness.families.protocol import Environment, Family
from harness.families.words import Shown
from harness.numbers import tenths
from harness.report.player import UNKNOWN, Scene, Scenes
from harness.report.summary import RunFolder, RunSummary
from harness.vocabulary import BoolArray, FloatArray, IntArray

CANDIDATES, SHOWN = 50, 3
"""Crashes considered and shown per ranking: with a share of traces only some of the worst have one."""
MOST_JUDGED, MOST_TRACED = 20_000, 1_000
"""Hardest crashes of which it is asked who would have avoided them; of vehicles whose motion the traces must tell."""
SHOWN_COLUMNS = ("impact_speed_mps", "crash_time_s", "weight", "event_s")
"""Of a crash in the table, beside its episode; as in `RunSummary`."""


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


def crash_gallery(
    run: RunFolder, summary: RunSummary, environment: Environment | None
) -> tuple[list[GalleryRow], list[Scene]]:
    """Crashes that the reference driver avoids, the hardest impacts, typical ones, those of the largest weights.

    Of shells the outermost in place of the latter. Crashes that nobody avoids are left out, unless there are no others.
    Traced crashes go first where some of the worst have no trace: a scene is worth more than a rank.
    """
    crashes, scenes, family = summary.crashes, Scenes(run.campaign, environment), family_named(run.campaign.scenario)
    facts = [each.of(crashes) for each in shown_of(family)]
    told = list(zip(shown_of(family), facts, strict=True))[:2]
    episode = crashes["episode"]
    ends = _ends(run, scenes, episode, crashes["impact_speed_mps"])
    avoided = (ends < 0) & (ends != UNKNOWN)
    stand_in = next(iter(family.stand_ins), "")
    rankings = _rankings(summary, stand_in, avoided, avoided.any(axis=1) | (ends == UNKNOWN).any(axis=1))
    asked = {int(episode[place]) for ranked in rankings.values() for place in ranked}
    traces = run.traces(asked)
    traced = set() if traces is None else set(traces.column("episode").unique().to_pylist())
    reasons: dict[int, list[str]] = {}
    for reason, ranked in rankings.items():
        chosen = sorted(enumerate(ranked, 1), key=lambda item: episode[item[1]] not in traced)[:SHOWN]
        for rank, place in sorted(chosen):
            reasons.setdefault(place, []).append(f"{reason} no. {rank}")
    total, stored = float(crashes["weight"].sum()), run.crashes({int(episode[place]) for place in reasons} & traced)
    rows, shown = list[GalleryRow](), list[Scene]()
    # Shells, or importance functions, of which the forced event is the first.
    names = ["forced", *run.campaign.surrogates] if run.shells is None else [each.shell for each in run.shells.shells]
    for place, why in reasons.items():
        crash = {name: float(crashes[name][place]) for name in SHOWN_COLUMNS}
        number, component = int(episode[place]), int(crashes["component"][place])
        avoid = [name for name, avoids in zip(family.stand_ins, avoided[place], strict=True) if avoids]
        by, scene = ", ".join(avoid) or ("nobody" if (ends[place] != UNKNOWN).all() and ends.size else "–"), None
        if traces is not None and number in traced:
            impact, scene = tenths(crash["impact_speed_mps"]), len(shown)
            row, trace = (each.filter(pc.equal(each["episode"], number)) for each in (stored, traces))
            event = " and ".join(f"{each.words} {tenths(float(of[place]))} {each.unit}" for each, of in told)
            kinds = ", ".join(each.rpartition(" no. ")[0] for each in why)
            shown.append(scenes.scene(row, trace, why=f"{event}, impact at {impact} m/s ({kinds})"))
        share = crash["weight"] / total if total > 0.0 else math.nan
        shown_facts = [float(each[place]) for each in facts]
        drawn_by = names[component] if 0 <= component < len(names) else "–"
        rows.append(GalleryRow(number, crash, shown_facts, ", ".join(why), share, drawn_by, by, scene))
    return rows, shown


def _rankings(summary: RunSummary, stand_in: str, avoided: BoolArray, someone: BoolArray) -> dict[str, list[int]]:
    """Places of crashes by what they are shown for; who ``avoided`` (n, D) them, the first of whom is the ``stand_in``.

    ``someone`` (n,) may have.
    """
    crashes, among = summary.crashes, someone if someone.any() else ~someone
    episode, impact, weight = (crashes[name] for name in ("episode", "impact_speed_mps", "weight"))
    known = someone.any() and (avoided.any(1) == someone).all()
    hardest = "hardest avoidable" if known else "hardest"
    keys = {hardest: impact, "typical": -np.abs(impact - weighted_quantiles(impact, weight, (0.5,))[0])}
    if summary.from_shells:
        keys["outermost"] = crashes["component"]
    elif not summary.all_weights_one:
        keys["weight"] = weight
    first = {f"avoidable by {stand_in}": worst_crashes(impact, episode, avoided[:, 0])} if avoided.size else {}
    return first | {name: worst_crashes(key, episode, among) for name, key in keys.items()}


def _ends(run: RunFolder, scenes: Scenes, episode: FloatArray, impact: FloatArray) -> IntArray:
    """After which step the family's `stand_ins` crash where the AV has (n, D), below zero for never."""
    ends = np.full((episode.size, scenes.n_stand_ins), UNKNOWN, np.int64)
    acts = run.campaign.av.acts_before_event
    judged = np.sort(np.argsort(-impact, kind="stable")[: MOST_TRACED if acts else MOST_JUDGED])
    asked = {int(each) for each in episode[judged]}
    if asked:
        ends[judged] = scenes.ends(run.crashes(asked), run.traces(asked) if acts else None)
    return ends
