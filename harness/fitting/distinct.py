"""Whether a recording comes twice: as it is, or elsewhere, mirrored, rounded, at another rate, or in part."""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
import pandas as pd

from harness.errors import TrajectoryError
from harness.fitting.recording import Recording
from harness.vocabulary import IntArray

ONE_OF = 8
SPEED_MPS, GAP_M, LENGTH_M = 0.25, 1.0, 0.25
"""Cells of a motion, wide enough for values rounded to 0.1 [assumed]."""
MOMENTS, APART_S = 4, 2
"""Number of moments at which a motion is looked at, and the time between them."""


class Fingerprint(NamedTuple):
    """Hashes of one recording, the same ones in a copy of it; ``place`` is its file and name, for messages."""

    place: str
    rows: IntArray
    """Of one row in `ONE_OF`: where a vehicle is, its speed and length."""
    motions: IntArray
    """Of 6 s in which a speed changes: length, speeds and ways to the next vehicle on the lane, in cells. All rows
    count, so it does not matter when the clock ticks."""
    recurring: dict[str, float]
    """Shares of both that another vehicle of the recording has, too: so many another recording has by chance."""


def fingerprint(track: Recording) -> Fingerprint:
    """Fingerprint of one recording, whatever its clock, order of rows and identifiers."""
    row_hashes = _hashes(track.s / 1e-3, track.v / 1e-3, track.length / 1e-2)
    order = np.lexsort((track.s, track.lane, track.road, track.frame))
    way_m = np.full(track.v.size, -GAP_M)
    same = np.all([np.diff(column[order]) == 0 for column in (track.frame, track.road, track.lane)], axis=0)
    way_m[order[:-1][same]] = np.diff(track.s[order])[same]
    apart = round(APART_S * track.rate_hz)
    n = max(track.v.size - (MOMENTS - 1) * apart, 0)
    speeds, ways = ([x[i * apart :][:n] for i in range(MOMENTS)] for x in (track.v / SPEED_MPS, way_m / GAP_M))
    changes = np.ptp(np.rint(speeds), axis=0) > 0
    changes &= track.piece[:n] == track.piece[track.v.size - n :]
    motions = _hashes(*speeds, *ways, track.length[:n] / LENGTH_M)[changes]
    sampled = row_hashes % ONE_OF == 0
    rows, of_rows = _recurring(row_hashes[sampled], track.piece[sampled])
    motions, of_motions = _recurring(motions, track.piece[:n][changes])
    return Fingerprint(track.place, rows, motions, {"rows": of_rows, "motions": of_motions})


def _recurring(hashes: IntArray, piece: IntArray) -> tuple[IntArray, float]:
    """Each hash once, and the share of those of a piece that are in others, too."""
    of_pieces = pd.DataFrame({"hash": hashes, "piece": piece}).drop_duplicates()["hash"]
    marks, n = np.unique(of_pieces, return_counts=True)
    return marks, float(n[n > 1].sum() / max(n.sum(), 1))


def _hashes(*columns: np.ndarray) -> IntArray:
    cells = np.rint(np.column_stack(columns)).astype(np.int64)
    return pd.util.hash_pandas_object(pd.DataFrame(cells), index=False).to_numpy().astype(np.int64)


# Largest shares that recordings may have in common beyond chance, and fewest hashes that can tell [assumed]. Of small
# recordings of one law without noise 0.45 of the motions were; of copies rounded to 0.1 0.6.
KINDS = (
    ("rows", "rows", "positions, speeds and lengths are the same", 0.1, 1),
    ("motions", "motion", "speeds, gaps and lengths are the same over 6 s, but for rounding", 0.5, 40),
)


def require_distinct(fingerprints: Sequence[Fingerprint]) -> None:
    """Refuse a recording that has come before, under whatever name, or a notable part of one (`TrajectoryError`)."""
    for kind, what, why, most, fewest in KINDS:
        hashes: list[IntArray] = [getattr(each, kind) for each in fingerprints]
        sizes = [each.size for each in hashes]
        marks, owner = np.concatenate(hashes), np.repeat(np.arange(len(fingerprints)), sizes)
        order = np.lexsort((owner, marks))
        marks, owner = marks[order], owner[order]
        again = np.flatnonzero(marks[1:] == marks[:-1])
        pairs, counts = np.unique(np.column_stack([owner[again], owner[again + 1]]), axis=0, return_counts=True)
        for (first, second), n in zip(pairs.tolist(), counts.tolist(), strict=True):
            smaller, larger = sorted((first, second), key=sizes.__getitem__)
            chance = fingerprints[larger].recurring[kind]
            if (size := sizes[smaller]) >= fewest and n / size > chance + most * (1.0 - chance):
                words = f"{n / size:.0%} of its {what} also in {fingerprints[first].place}: {why}"
                mend = "Leave one of them out: what comes twice would count twice."
                raise TrajectoryError(fingerprints[second].place, words, "other vehicles, or other times", mend)
