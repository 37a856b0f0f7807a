"""Brakings and cut-outs counted in trajectories of known laws, and what is no event."""

import json
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pandas as pd
import pytest
from scipy import ndimage

from harness.campaign.sections import EnvironmentSettings
from harness.cli import main
from harness.estimators.limits import garwood
from harness.families import family_named
from harness.families.cut_out.fitting import EVENT as OF_CUT_OUT
from harness.families.cut_out.fitting import CutOutFitter, drop_law, time_law
from harness.families.following.fitting import TAIL, Seen
from harness.families.lead_brakes.fitting import EVENT, MOST_NOISE_MPS2, BrakingFitter, tail_scale
from harness.families.words import EXCLUDED
from harness.fitting.tracks import noise_of
from tests.fitting.trajectories import (
    LANE_M,
    RATE_HZ,
    braked,
    braking,
    leaving,
    led,
    overtaking,
    positions,
    recording,
    table,
)


def seen(law, recordings: list[pd.DataFrame]) -> Seen:
    """All recordings together."""
    each = [law.seen(recording(rows)) for rows in recordings]
    return Seen(sum(one.hours for one in each), np.concatenate([one.events for one in each]))


def off(number: dict, truth: float) -> float:
    """Distance in standard errors."""
    return abs(number["value"] - truth) / number["se"]


def one_braking(peak: float = 5.0, at: int = 200, n: int = 600) -> np.ndarray:
    """Speeds of a vehicle that brakes once."""
    v = np.full(n, 32.0)
    braked(v, at, peak, 1.5, 8.0)
    return v


@pytest.mark.parametrize("scale", [pytest.param(0.5, marks=pytest.mark.slow), 1.0])
def test_brakings_of_a_known_law_are_found_again(scale):
    found = seen(BrakingFitter(), braking(8.0, 30.0, 5, scale=scale))
    low, high = (end / found.hours for end in garwood(found.events.size, TAIL))
    assert low < 30.0 < high
    assert found.hours == pytest.approx(8.0, rel=0.02)
    number = BrakingFitter().numbers(found.events)["braking"]["peak_scale_mps2"]
    assert off(number, scale) < 3.0
    assert off(number, 1.5 - scale) > 3.0  # the other law is told from it


@pytest.mark.slow
def test_cut_outs_of_a_known_law_are_found_again():
    recordings = leaving(250, 0.6, 4)
    found = seen(CutOutFitter(), recordings)
    left = [set(rows.vehicle_id) >= {"2"} for rows in recordings]
    assert 0.93 * sum(left) < found.events.size <= sum(left)  # 0.03 lie beyond 12 s
    numbers = CutOutFitter().numbers(found.events)["leaving"]
    truth = {"drop_mean": 0.12, "ttc_median_s": 5.0, "ttc_log_sd": 0.45}
    truth |= {"lateral_median_mps": 0.867, "lateral_log_sd": 0.3}
    assert numbers.keys() == truth.keys()
    assert all(off(numbers[name], value) < 3.0 for name, value in truth.items())
    # Hours, frame by frame: behind a vehicle within 115 m, which sees 100 m further.
    hours = 0.0
    for rows in recordings[:3]:
        wide = rows.set_index(["time_s", "vehicle_id"])[["s_m", "lane"]].unstack()
        for s, lane in zip(wide.s_m.to_numpy(), wide.lane.to_numpy(), strict=True):
            on_lane = np.sort(s[lane == 0])
            gaps = np.diff(on_lane) - 4.5
            hours += ((gaps > 0) & (gaps <= 115) & (on_lane[1:] + 100 <= rows.s_m.max())).sum() / RATE_HZ / 3600
    assert seen(CutOutFitter(), recordings[:3]).hours == pytest.approx(hours, rel=1e-9)


def test_standard_errors_of_the_peaks_law_hold_the_truth():
    """Of 2,000 sets of 40 peaks, a third of them cut off by the end of a track."""
    random = np.random.default_rng(7)
    peaks, ends = random.exponential(0.7, (2, 2000, 40))
    seen_peaks, ended = 3.0 + np.minimum(peaks, 1.4 * ends), peaks <= 1.4 * ends
    held = {}
    for name, flags in (("known", ended), ("ignored", np.ones_like(ended))):
        each = np.array([tail_scale(*rows) for rows in zip(seen_peaks, flags, strict=True)])
        held[name] = float((np.abs(each[:, 0] - 0.7) < 1.645 * each[:, 1]).mean())
    assert 0.86 < held["known"] < 0.94
    assert held["ignored"] < 0.6  # who takes cut-off peaks for whole ones is wrong


@pytest.mark.parametrize("mean", [0.12, 0.3])
def test_standard_errors_of_the_drops_law_hold_the_truth(mean):
    """Of 1,000 sets of 100 drops, none beyond 1: the plain mean of 0.3 would be 0.262, and hold it in a third."""
    random = np.random.default_rng(11)
    drops = -mean * np.log1p(random.random((1000, 100)) * np.expm1(-1.0 / mean))
    fitted = np.array([drop_law(each) for each in drops])
    assert abs(float((np.abs(fitted[:, 0] - mean) < 1.645 * fitted[:, 1]).mean()) - 0.9) < 0.04
    assert abs(float(fitted[:, 0].mean()) / mean - 1.0) < 0.02


def test_standard_errors_of_the_time_law_hold_the_truth():
    random = np.random.default_rng(8)
    held = []
    for _ in range(150):
        times = 5.0 * np.exp(0.45 * random.standard_normal(100))
        values, errors = time_law(times[times < 12.0], 0.01, 0.5, 2.5)
        held.append(np.abs(values - (5.0, 0.45)) < 1.645 * errors)
    assert (np.abs(np.mean(held, axis=0) - 0.9) < 0.08).all()


@pytest.mark.parametrize(("times", "most_off"), [("log-normal", 0.1), ("even", 0.3)])
def test_early_cut_outs_are_as_frequent_as_counted_whatever_lies_beyond_the_last_time(
    times, most_off, tmp_path, monkeypatch
):
    """Counted are some 70 % of all, or times of no log-normal law: in either case tests can be drawn from the file."""
    monkeypatch.chdir(tmp_path)
    random = np.random.default_rng(9)
    ttc_s = 8.0 * np.exp(0.6 * random.standard_normal(1000)) if times == "log-normal" else 12.0 * random.random(800)
    events = np.zeros((ttc_s < 12.0).sum(), OF_CUT_OUT)
    events["ttc_s"], events["drop"], events["lateral_mps"] = ttc_s[ttc_s < 12.0], 0.1, np.nan
    fitter, family = CutOutFitter(), family_named("cut_out")
    fitter._seen = [Seen(100.0, events)]
    ((file, content),) = fitter.fitted(SimpleNamespace(out=Path("mine.yaml"), provenance=list), {}).files.items()
    file.write_bytes(content)
    parameters = family.parameters(EnvironmentSettings(parameters=f"./{file}"))
    grid, share = parameters.grid()
    per_hour = parameters.exposure.per_hour.value * share[grid["ttc_s"] < 5.0].sum()
    assert per_hour == pytest.approx((ttc_s < 5.0).sum() / 100.0, rel=most_off)


def test_an_error_of_measurement_is_no_braking():
    steady = np.full(600, 32.0)
    spikes = led(steady)
    spikes.loc[(spikes.vehicle_id == "0") & spikes.time_s.isin([20.0, 20.1, 40.0]), "speed_mps"] -= 4.5
    track = recording(spikes)
    assert np.diff(track.v).min() * RATE_HZ < -30.0  # as differences of rows have it
    assert not BrakingFitter().seen(track).events.size
    noisy = led(steady)
    noisy["speed_mps"] += 0.3 * np.random.default_rng(1).standard_normal(len(noisy))
    track = recording(noisy)
    assert noise_of(track) > MOST_NOISE_MPS2
    found = BrakingFitter().seen(track)
    assert found.hours == 0.0
    assert "noise of 0.2" in found.why


def test_errors_that_neighbouring_rows_share_are_no_brakings():
    """As where positions were smoothed: no noise from row to row, but vehicles speed up as hard as they brake."""
    smoothed = led(np.full(6000, 32.0))
    errors = ndimage.gaussian_filter1d(np.random.default_rng(1).standard_normal(len(smoothed)), 3.0)
    smoothed["speed_mps"] += 0.6 * errors / errors.std()
    track = recording(smoothed)
    assert noise_of(track) < 0.5 * MOST_NOISE_MPS2
    found = BrakingFitter().seen(track)
    assert (found.hours, found.events.size) == (0.0, 0)
    assert "speed up by 3 m/s² or more" in found.why


@pytest.mark.parametrize(("last_s", "known"), [(21.3, False), (22.6, True)])
def test_a_peak_is_known_once_it_is_held(last_s, known):
    """In a track that ends while the braking grows it is a lower limit, and else the one that is seen."""
    rows = led(one_braking(9.0))
    (event,) = BrakingFitter().seen(recording(rows[(rows.vehicle_id == "1") | (rows.time_s < last_s)])).events
    assert event["ended"] == known
    assert (abs(event["peak_mps2"] - 9.0) < 0.05) == known


@pytest.mark.parametrize("n_followers", [1, 3])
def test_a_braking_is_one_event_of_each_driver_who_follows(n_followers):
    """The last one has no follower; one that brakes in two pushes brakes once."""
    v = one_braking()
    rows = led(v, n_followers)
    found = BrakingFitter().seen(recording(rows))
    assert found.events["peak_mps2"] == pytest.approx([5.0] * n_followers, abs=0.15)
    again = v.copy()
    braked(again, 212, 4.0, 1.0, 8.0)
    assert BrakingFitter().seen(recording(led(np.minimum(v, again), n_followers))).events.size == n_followers


@pytest.mark.parametrize("n_recordings", [1, 8])
def test_that_events_are_of_one_vehicle_is_told(n_recordings):
    """As of a test car that brakes again and again: they are not independent, as the limits take them to be."""
    fitter, v = BrakingFitter(), np.full(4800, 32.0)
    for at in range(200, 4700, 600):
        braked(v, at, 5.0, 1.5, 8.0)
    for i in range(n_recordings):
        fitter.observe(recording(led(v if n_recordings == 1 else one_braking(at=200 + i))))
    told = fitter.fitted(SimpleNamespace(out=Path("mine.yaml"), provenance=list), {}).told
    assert "lead_brakes: 8 brakings" in told[0]
    assert any("8 of 8 brakings of 3 m/s² or more are of one vehicle" in line for line in told) == (n_recordings == 1)


def test_who_does_not_follow_meets_no_event():
    v = one_braking()
    rows = led(v)
    far = rows.assign(s_m=rows.s_m - 100.0 * (rows.vehicle_id == "1"))
    beside = rows.assign(lane=np.where(rows.vehicle_id == "1", 1, 0))
    left = rows.assign(lane=np.where((rows.vehicle_id == "1") & (rows.time_s >= 15.0), 1, 0))
    slow = led(v - 14.0)
    for each in (far, beside, left, slow):
        assert not BrakingFitter().seen(recording(each)).events.size
    assert BrakingFitter().seen(recording(left)).hours == pytest.approx(15.0 / 3600, rel=0.1)


def test_a_cut_out_that_reveals_nobody_slower_is_none():
    time = np.arange(600) / RATE_HZ
    v, lateral = np.full(600, 32.0), np.clip(1.8 + 0.9 * (time - 50.05), 0.0, LANE_M)
    lane = (lateral > 0.5 * LANE_M).astype(int)
    for revealed, events in ((30.0, 1), (32.0, 0), (34.0, 0)):
        other = table(
            2, positions(np.full(600, revealed), 70.0 + max(32.0 - revealed, 0.0) * 50), np.full(600, revealed)
        )
        ahead = table(3, positions(v, 2500.0), v)
        rows = pd.concat([table(0, positions(v), v), table(1, positions(v, 50.0), v, lane, lateral), other, ahead])
        assert CutOutFitter().seen(recording(rows)).events.size == events
    alone = pd.concat([table(1, positions(v, 50.0), v, lane, lateral), other, ahead])
    assert not CutOutFitter().seen(recording(alone)).events.size  # nobody follows


@pytest.mark.parametrize(("hours", "excluded"), [(200.0, True), (5.0, False)])
def test_that_data_exclude_an_exposure_that_is_kept_stands_in_the_file(hours, excluded, tmp_path, monkeypatch):
    """Of no braking in so many hours; the answer of a campaign says it again."""
    monkeypatch.chdir(tmp_path)
    fitter, family = BrakingFitter(), family_named("lead_brakes")
    fitter._seen = [Seen(hours, np.empty(0, EVENT))]
    found = fitter.fitted(SimpleNamespace(out=Path("mine.yaml"), provenance=list), {})
    assert ("which these data exclude" in found.told[0]) == excluded
    ((file, content),) = found.files.items()
    file.write_bytes(content)
    parameters = family.parameters(EnvironmentSettings(parameters=f"./{file}"))
    exposure = family.exposure(family.traffic(EnvironmentSettings(), parameters), parameters)
    assert (exposure.per_hour, exposure.counted) == (pytest.approx(0.1), None)
    assert (f"; {EXCLUDED}: 0 in 200 h" in exposure.source) == excluded
    assert "in scope" not in found.told[0]  # all are


@pytest.mark.parametrize(("hours", "far"), [(0.1, True), (2.0, False)])
def test_a_rate_far_above_the_shipped_range_is_remarked(hours, far):
    fitter = BrakingFitter()
    fitter._seen = [Seen(hours, np.zeros(6, EVENT))]  # below what a law takes
    found = fitter.fitted(SimpleNamespace(out=Path("mine.yaml"), provenance=list), {})
    assert (" times the shipped one" in found.told[0]) == far


def test_of_cut_outs_those_in_scope_are_told_as_a_campaign_counts_them(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    fitter, family = CutOutFitter(), family_named("cut_out")
    fitter._seen = [Seen(2.0, np.zeros(7, OF_CUT_OUT))]  # too few for a law
    found = fitter.fitted(SimpleNamespace(out=Path("mine.yaml"), provenance=list), {})
    ((file, content),) = found.files.items()
    file.write_bytes(content)
    parameters = family.parameters(EnvironmentSettings(parameters=f"./{file}"))
    exposure = family.exposure(family.traffic(EnvironmentSettings(), parameters), parameters)
    assert f"; in scope, as --exposure takes them: {exposure.per_hour:.3g} per hour" in found.told[0]


@pytest.mark.slow
def test_what_a_fit_writes_is_what_a_campaign_reads(tmp_path, monkeypatch, capsys):
    """Counted exposures and laws where there are enough; where not, what is missing, and the default."""
    monkeypatch.chdir(tmp_path)
    following = [*braking(1.5, 30.0, 5), *leaving(3, 1.0, 4)]
    apart = [rows.assign(recording_id=f"following {i}", s_m=rows.s_m + 3.37 * i) for i, rows in enumerate(following)]
    own = overtaking(2.0).astype({"recording_id": str, "vehicle_id": str})
    pd.concat([own, *apart]).to_parquet("rows.parquet", index=False)
    assert main(["fit", "rows.parquet", "--out", "mine.yaml", "--replicates", "2", "--quiet"]) == 0
    told = capsys.readouterr().out
    assert "cut_out: 3 cut-outs that reveal a slower vehicle within 12 s in" in told
    assert "at least 5 are needed, some" in told
    assert "kept is 1.00 per hour [assumed], and the law of cut-out-1" in told
    assert "peak_scale_mps2" in told
    page = (tmp_path / "mine.html").read_text()
    assert "lead_brakes: " in page
    assert "cut_out: " in page

    def parameters(name):
        file = f"./mine.{name}.yaml"
        return family_named(name).parameters(EnvironmentSettings(parameters=file))

    family, leads = family_named("lead_brakes"), parameters("lead_brakes")
    shipped = family.parameters(EnvironmentSettings())
    given = family.exposure(family.traffic(EnvironmentSettings(), leads), leads)
    assert given.counted is not None
    assert given.counted[0] > 20
    assert given.counted[0] / given.counted[1] == pytest.approx(given.per_hour, rel=1e-3)
    assert given.low < 30.0 * 1.5 / given.counted[1] < given.high
    assert leads.braking.peak_scale_mps2.source == "fitted"
    same = {name for name, value in leads.values().items() if value == shipped.values()[name]}
    assert shipped.values().keys() - same == {"exposure__per_hour", "braking__peak_scale_mps2"}
    assert (
        parameters("cut_out").content_hash() == family_named("cut_out").parameters(EnvironmentSettings()).content_hash()
    )
    assert main(["fit", "rows.parquet", "--out", "mine.yaml", "--replicates", "2", "--quiet", "--json"]) == 0
    found = json.loads(capsys.readouterr().out)
    assert found["lead_brakes"]["events"] == given.counted[0]
    assert found["cut_out"]["events"] == 3
    (tmp_path / "mine.cut_out.yaml").write_text("of my own")
    assert main(["fit", "rows.parquet", "--out", "mine.yaml", "--quiet"]) == 2
