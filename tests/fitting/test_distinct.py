"""Recordings: what is observed of motion that is known, and which come twice under another guise."""

from collections.abc import Callable

import numpy as np
import pandas as pd
import pytest

from harness.errors import TrajectoryError
from harness.families.cut_in.fitting.observations import BesideCounts, Observations, observe, require_enough
from harness.fitting.distinct import fingerprint, require_distinct
from harness.fitting.files import fit_files
from harness.fitting.table import load_mapping, recordings
from tests.fitting.trajectories import braking, leaving, overtaking, recording

ROWS = overtaking(2.0)


def at_25_hz(rows: pd.DataFrame) -> pd.DataFrame:
    """Between their rows, and by a clock that ticks elsewhere."""
    found = []
    for (name, vehicle), of in rows.groupby(["recording_id", "vehicle_id"]):
        time_s = np.arange(0.013, of.time_s.max(), 0.04)
        columns = {key: np.interp(time_s, of.time_s, of[key]) for key in ("s_m", "speed_mps", "lateral_m")}
        lane = of.lane.to_numpy()[np.searchsorted(of.time_s, time_s)]
        own = {"recording_id": name, "vehicle_id": vehicle, "length_m": of.length_m.iloc[0]}
        found.append(pd.DataFrame({"time_s": time_s, "lane": lane, **own, **columns}))
    return pd.concat(found)


GUISES: dict[str, Callable[[pd.DataFrame], pd.DataFrame]] = {
    "elsewhere": lambda rows: rows.assign(s_m=rows.s_m + 17.3, lateral_m=rows.lateral_m + 2.0),
    "mirrored": lambda rows: rows.assign(lane=1 - rows.lane, lateral_m=-rows.lateral_m, s_m=rows.s_m + 1.0),
    "rounded": lambda rows: rows.assign(s_m=rows.s_m + 73.1 * rows.recording_id).round(
        {"s_m": 1, "speed_mps": 1, "length_m": 1, "lateral_m": 1}
    ),
    "at another rate": at_25_hz,
    "half of its time": lambda rows: rows[rows.time_s >= 20.0].assign(s_m=rows.s_m - 0.5),
    "all of it": lambda rows: at_25_hz(rows).assign(s_m=lambda of: of.s_m + 3.3).round({"s_m": 1, "speed_mps": 1}),
}


FAST = "half of its time", "all of it"


@pytest.mark.parametrize(
    "guise", [pytest.param(each, marks=() if each in FAST else pytest.mark.slow) for each in GUISES]
)
def test_a_recording_that_comes_again_under_a_guise_is_refused(guise, tmp_path):
    again = GUISES[guise](ROWS)
    ROWS.to_parquet(tmp_path / "rows.parquet", index=False)
    again.assign(recording_id=again.recording_id + 5000).to_parquet(tmp_path / "b.parquet", index=False)
    found = r"b\.parquet, recording 5\d+: found \d+% of its motion also in .*rows\.parquet, recording \d+: speeds"
    with pytest.raises(TrajectoryError, match=found):
        fit_files([tmp_path / "rows.parquet", tmp_path / "b.parquet"], tmp_path / "mine.yaml")


@pytest.mark.parametrize(
    ("hours", "noise"), [(8.0, 0.1), *(pytest.param(20.0, noise, marks=pytest.mark.slow) for noise in (0.0, 0.1))]
)
def test_recordings_of_one_law_are_told_apart(hours, noise):
    """Three of five vehicles of each drive at one speed, the others speed up by one of three values."""
    whole = [rows for _, rows in overtaking(hours, 5, noise=noise).groupby("recording_id")]
    require_distinct([fingerprint(recording(rows)) for rows in whole])


def test_drivers_of_one_speed_and_headway_are_no_copies():
    """At the same places, too, but for when they brake, and how hard."""
    found = [fingerprint(recording(rows)) for rows in braking(6.0, 60.0, 3) + leaving(20, 0.6, 4)]
    require_distinct([each._replace(rows=each.rows[:0]) for each in found])


def free_traffic(seed: int) -> pd.DataFrame:
    """A thousand vehicles through one site of 420 m, nobody near ahead, of one length, rounded to 0.1."""
    rng, rows = np.random.default_rng(seed), []
    for k in range(1000):
        speed, swing, per_s, phase = rng.normal(30.0, 3.0), *rng.uniform((0.0, 0.02, 0.0), (1.0, 0.1, 6.3))
        time_s = np.arange(0.0, 440.0 / speed, 0.1)
        speed_mps = speed + swing * np.sin(2.0 * np.pi * per_s * time_s + phase)
        s_m = np.cumsum(0.1 * speed_mps) + rng.uniform(0.0, 3.0)
        own = {"recording_id": seed, "vehicle_id": k, "lane": k % 20, "lateral_m": 3.75 * (k % 20), "length_m": 4.5}
        moves = {"time_s": time_s + k, "s_m": s_m.round(1), "speed_mps": speed_mps.round(1)}
        rows.append(pd.DataFrame({**moves, **own}))
    return pd.concat(rows)


def test_what_any_traffic_of_a_site_has_in_common_is_no_copy():
    """A quarter of the rounded rows are by chance those of others, also within one recording; a copy has them all."""
    one, other = (fingerprint(recording(free_traffic(seed))) for seed in (1, 2))
    assert np.isin(other.rows, one.rows).mean() > 0.2
    assert np.isin(other.motions, one.motions).mean() > 0.5
    require_distinct([one, other])
    for again in (one._replace(rows=one.rows[:0]), one._replace(motions=one.motions[:0])):
        with pytest.raises(TrajectoryError, match="100% of its"):
            require_distinct([one, again])


def test_a_recording_too_short_to_tell_is_none():
    rows = ROWS[ROWS.time_s < 3.0].query("recording_id == 0")
    assert fingerprint(recording(rows)).motions.size == 0


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


def test_speeds_in_coarse_steps_are_noise(tmp_path):
    """As in whole miles per hour: most differences of rows are none, so that third differences alone show a third."""
    rows = overtaking(2.0)
    step = 0.447
    found = observed(rows.assign(speed_mps=step * (rows.speed_mps / step).round()), tmp_path)[0]
    assert np.mean([each.noise_mps2 for each in found]) == pytest.approx(0.953 * step / 12**0.5, rel=0.05)


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
