"""Observations of motion that is known, and recordings that are refused."""

import numpy as np
import pandas as pd
import pytest

from harness.families.cut_in.fitting.observations import BesideCounts, Observations, observe, require_enough
from harness.fitting.table import load_mapping, recordings
from tests.fitting.trajectories import overtaking


def observed(rows: pd.DataFrame, tmp_path, **mapping) -> tuple[list[Observations], BesideCounts]:
    file = tmp_path / "rows.parquet"
    rows.to_parquet(file, index=False)
    found = list(map(observe, recordings([file], load_mapping().model_copy(update=mapping))))
    return found, BesideCounts.of(found)


def joined(found: list[Observations], name: str) -> np.ndarray:
    return np.concatenate([getattr(each, name) for each in found])


def test_states_and_accelerations_of_a_known_motion(tmp_path):
    rows = overtaking(3.0)
    found, total = observed(rows, tmp_path)
    assert require_enough(found, "rows.parquet", load_mapping()) == total
    following, leads, at_risk = (joined(found, name) for name in ("following", "leads", "at_risk"))

    # Held accelerations are found exactly, though states are those of the beginning of their second.
    assert np.abs(following["acceleration_mps2"] - np.round(following["acceleration_mps2"] / 0.2) * 0.2).max() < 1e-9
    assert following["acceleration_mps2"].std() == pytest.approx(0.2 * np.sqrt(2 / 3), rel=0.05)
    first = found[0].following[0]
    bv, lv = (rows.query(f"recording_id == 0 and vehicle_id == {i} and time_s == 0").iloc[0] for i in (1, 0))
    assert first["v_mps"] == bv.speed_mps
    assert first["r1dot_mps"] == lv.speed_mps - bv.speed_mps
    assert first["r1_m"] == pytest.approx(60.0 - (bv.length_m + lv.length_m) / 2)

    # Each cut-in is a row with the state just before it; time at risk ends there.
    assert at_risk["changes"].sum() == total.used <= total.changes == rows.recording_id.nunique()
    assert (leads["lead_s"] * leads["lateral_speed_mps"]) == pytest.approx(1.8, abs=0.06)
    for each in found:
        risky = each.at_risk
        assert (np.flatnonzero(risky["changes"]) == len(risky) - 1).all()
        crossed = rows.query(f"recording_id == {each.recording} and vehicle_id == 1 and lane == 0").time_s.min()
        assert risky["duration_s"].sum() <= crossed - 0.05 + 1e-9
        closing = risky["r2dot_mps"] < 0
        assert risky["ttc_s"][closing] == pytest.approx(-(risky["r2_m"] / risky["r2dot_mps"])[closing])
        assert np.isinf(risky["ttc_s"][~closing]).all()


def test_time_at_risk_is_that_beside_nobody(tmp_path):
    """By hand, frame by frame: behind LV, and no vehicle alongside."""
    rows = overtaking(0.5)
    found, _ = observed(rows, tmp_path)
    wide = rows.set_index(["recording_id", "time_s", "vehicle_id"])[["s_m", "lane", "length_m"]].unstack()
    s, lane, length = (wide[name].to_numpy() for name in ("s_m", "lane", "length_m"))
    apart = np.abs(s[:, 2:] - s[:, 1:2]) - (length[:, 2:] + length[:, 1:2]) / 2
    gap = s[:, 0] - s[:, 1] - (length[:, 0] + length[:, 1]) / 2
    free = (apart > 0).all(axis=1) & (lane[:, 1] == 1) & (gap < 115)
    seen = ((s[:, 2:] < s[:, 1:2]).any(axis=1)) | (s[:, 1] - -200 > 100)
    by_hand = (free & seen).sum() / 10
    assert joined(found, "at_risk")["duration_s"].sum() == pytest.approx(by_hand, rel=0.05)


def test_noise_widens_accelerations_little_and_is_told(tmp_path):
    clean, noisy = (observed(overtaking(3.0, noise=noise), tmp_path)[0] for noise in (0.0, 0.1))
    error = joined(noisy, "free")["acceleration_mps2"] - joined(clean, "free")["acceleration_mps2"]
    told = np.mean([each.noise_mps2 for each in noisy])
    assert error.std() == pytest.approx(told, rel=0.1)
    assert told < 0.7 * 0.1 * np.sqrt(2)  # a difference of two speeds has 0.14
    assert all(each.noise_mps2 < 1e-2 for each in clean)


def test_long_leads_are_missed_no_more_often_than_short_ones(tmp_path):
    """Only crossings seen for a while count, whatever their lead; one whose onset was not seen is a long one."""
    rows = overtaking(3.0)
    whole = joined(observed(rows, tmp_path)[0], "leads")["lead_s"]
    crossing = rows[(rows.vehicle_id == 1) & (rows.lane == 0)].groupby("recording_id").time_s.min()
    assert whole.size == (crossing > 4.5).sum()
    since = rows.time_s - rows.recording_id.map(crossing)
    late = rows[(crossing.reindex(rows.recording_id).to_numpy() > 4.6) & (since > -4.65)]
    slow = late.assign(lateral_m=np.where(late.vehicle_id == 1, 1.8 - 0.3 * since[late.index], late.lateral_m))
    assert (joined(observed(slow, tmp_path)[0], "leads")["lead_s"] >= 4.5).all()
