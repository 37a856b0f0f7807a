"""What an AV was seen to do after cut-ins, in episodes that were traced whatever came of them."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

import numpy as np
import pyarrow as pa

from harness.campaign.campaign import Campaign
from harness.episode.loop import traced_by_index
from harness.errors import RunFolderError
from harness.records.folder import MEND_SHARD, read_manifest, read_table
from harness.vehicles.kinematics import VEHICLE_LENGTH_M
from harness.vocabulary import AV, BV, VEHICLES, BoolArray, FloatArray, IntArray

WINDOW_STEPS = 60
"""Steps after a cut-in that are looked at: within 6 s it is decided whether it was dangerous."""
FEWEST_CUT_INS = 40
_COLUMNS = ["episode", "step", "vehicle", "x_m", "v_mps", "a_mps2"]
_SERIES = ("speed", "lead_speed", "gap", "acceleration")


@dataclass(frozen=True, eq=False)
class Observed:
    """Cut-ins and what the AV did in the steps after them, one cut-in after another.

    ``episode`` (m,) is the index in the campaign, ascending; ``begin`` (m + 1,) says where each cut-in's steps begin,
    its cut-in step first, and the end. ``speed``, ``lead_speed``, ``gap``, ``acceleration`` (n,) are the AV's and BV's
    speed (m/s), the bumper-to-bumper gap (m), and the AV's acceleration (m/s²).
    """

    episode: IntArray
    begin: IntArray
    speed: FloatArray
    lead_speed: FloatArray
    gap: FloatArray
    acceleration: FloatArray

    def part(self, cut_ins: IntArray) -> Observed:
        """Some of the cut-ins, by their place."""
        lengths = np.diff(self.begin)[cut_ins]
        begin = np.concatenate([[0], np.cumsum(lengths)]).astype(np.int64)
        rows = np.arange(begin[-1]) + np.repeat(self.begin[cut_ins] - begin[:-1], lengths)
        return Observed(self.episode[cut_ins], begin, *(getattr(self, name)[rows] for name in _SERIES))


def read_observed(folder: Path, campaign: Campaign) -> Observed:
    """Read them from a run.

    Raises
    ------
    RunFolderError
        The run has kept no traces that do not depend on the outcome, or too few with a cut-in.
    """
    if campaign.records.traces != "all" and campaign.records.trace_share == 0.0:
        raise RunFolderError(
            str(folder),
            found=f"records.traces {campaign.records.traces} and records.trace_share 0",
            expected="traces that were chosen whatever came of the episode: a driver fitted to crashes alone would "
            "brake too little",
            mend="Run the campaign again with --set records.trace_share=0.2, or records.traces=all.",
        )
    shards = [_shard(folder, shard["files"], campaign) for shard in read_manifest(folder)["shards"]]
    parts = [part for part in shards if part is not None]
    n = sum(part.episode.size for part in parts)
    if n < FEWEST_CUT_INS:
        raise RunFolderError(
            str(folder),
            found=f"{n} cut-ins among the episodes traced whatever came of them",
            expected=f"at least {FEWEST_CUT_INS}: half to fit a driver to, half to check it",
            mend="Raise records.trace_share, or choose testing.method shells or forced, where every test has a cut-in.",
        )
    return _joined(parts)


def _shard(folder: Path, files: dict[str, str], campaign: Campaign) -> Observed | None:
    episodes = read_table(folder / files["episodes"], ["episode", "cut_in_step", "failure"])
    index = np.asarray(episodes.column("episode")).astype(np.int64)
    cut = np.asarray(episodes.column("cut_in_step").fill_null(-1)).astype(np.int64)
    usable = (cut >= 0) & np.asarray(episodes.column("failure").is_null().to_numpy(zero_copy_only=False))
    if campaign.records.traces != "all":
        usable &= traced_by_index(campaign.seed, index, campaign.records.trace_share)
    if not usable.any() or "traces" not in files:
        return None
    traces = read_table(folder / files["traces"], _COLUMNS)
    return _after_cut_ins(traces, index, np.where(usable, cut, -1))


def _after_cut_ins(traces: pa.Table, index: IntArray, cut: IntArray) -> Observed:
    """Steps after the cut-ins of a shard whose episodes are ``index`` (k,), with cut-in steps (k,) or -1."""
    names: BoolArray = np.asarray(traces.column("vehicle").cast(pa.string()).to_pylist()).reshape(-1, len(VEHICLES))
    if not (names == np.array(VEHICLES)).all():
        raise RunFolderError(
            "traces",
            found="rows in another order",
            expected=f"{', '.join(VEHICLES)} of each step",
            mend=MEND_SHARD,
        )
    episode, step = (np.asarray(traces.column(name)).astype(np.int64)[:: len(VEHICLES)] for name in _COLUMNS[:2])
    x, v = (np.asarray(traces.column(name)).reshape(-1, len(VEHICLES)) for name in ("x_m", "v_mps"))
    a = traces.column("a_mps2").fill_null(np.nan).to_numpy().reshape(-1, len(VEHICLES))[:, AV]
    since = step - cut[episode - index[0]]
    kept = (cut[episode - index[0]] >= 0) & (since >= 0) & (since < WINDOW_STEPS) & np.isfinite(a)
    found, first = np.unique(episode[kept], return_index=True)
    begin = np.append(first, kept.sum()).astype(np.int64)
    gap = x[:, BV] - VEHICLE_LENGTH_M - x[:, AV]
    return Observed(found, begin, v[kept, AV], v[kept, BV], gap[kept], a[kept])


def _joined(parts: list[Observed]) -> Observed:
    episode, *series = (np.concatenate([getattr(part, name) for part in parts]) for name in ("episode", *_SERIES))
    lengths = np.concatenate([np.diff(part.begin) for part in parts])
    return Observed(episode, np.concatenate([[0], np.cumsum(lengths)]).astype(np.int64), *series)
