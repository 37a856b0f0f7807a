"""How cut-ins showed themselves before BV overlapped, where they take time."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import pyarrow.compute as pc

from harness.records.reader import stored_columns
from harness.report.run_folder import RunFolder, floats
from harness.vehicles.kinematics import STEP_S

COLUMNS = ("lead_steps", "cut_in_step", "onset_ttc_s", "overlap_ttc_s", "contact")


@dataclass(frozen=True)
class LateralFacts:
    """Of the tests as sampled: leads (s) of cut-ins, crashes, and times to collision (s) in those that crash.

    ``lead_s`` are the 5 %, 50 % and 95 % quantiles. ``onset_ttc_s`` and ``overlap_ttc_s`` are medians over the crashes
    in which the AV was closing in; NaN without one. ``n_side`` crashes are side contacts.
    """

    n_cut_ins: int
    lead_s: tuple[float, float, float]
    n_crashes: int
    n_side: int
    onset_ttc_s: float
    overlap_ttc_s: float


def lateral_facts(run: RunFolder) -> LateralFacts | None:
    """What the records say; None where cut-ins are one step.

    Raises
    ------
    RunFolderError
        A shard is damaged.
    """
    if "lead_steps" not in stored_columns(run.path):
        return None
    leads, onset, overlap = [np.zeros(0)], [np.zeros(0)], [np.zeros(0)]
    contacts = []
    for batch in run.episodes(*COLUMNS):
        crashed = batch.filter(pc.is_valid(batch.column("contact")))
        leads.append(floats(batch.filter(pc.is_valid(batch.column("cut_in_step"))).column("lead_steps")))
        onset.append(floats(crashed.column("onset_ttc_s")))
        overlap.append(floats(crashed.column("overlap_ttc_s")))
        contacts += crashed.column("contact").to_pylist()
    lead = STEP_S * np.concatenate(leads)
    low, middle, high = np.quantile(lead, (0.05, 0.5, 0.95)).tolist() if lead.size else [np.nan] * 3
    return LateralFacts(
        n_cut_ins=lead.size,
        lead_s=(low, middle, high),
        n_crashes=len(contacts),
        n_side=contacts.count("side"),
        onset_ttc_s=_median(np.concatenate(onset)),
        overlap_ttc_s=_median(np.concatenate(overlap)),
    )


def _median(values: np.ndarray) -> float:
    known = values[np.isfinite(values)]
    return float(np.median(known)) if known.size else float("nan")
