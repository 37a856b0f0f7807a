"""Which episodes leave a trace, and what it says."""

from __future__ import annotations

import numpy as np
import pytest

from harness.episode.loop import traced_by_index
from harness.vocabulary import AV


def traced(recorded) -> list[int]:
    return sorted(set(recorded.tables.traces["episode"].to_pylist()))


def episodes_where(recorded, wanted) -> list[int]:
    return [row["episode"] for row in recorded.tables.episodes.to_pylist() if wanted(row)]


@pytest.mark.parametrize(
    ("policy", "wanted"),
    [
        ("all", lambda row: True),
        ("crash", lambda row: row["outcome"] == "crash"),
        ("critical", lambda row: row["outcome"] == "crash" or row["n_control_steps"] > 0),
    ],
)
def test_the_policy_says_which(policy, wanted, record):
    sometimes_critical = ("testing.method=step_mixture", "testing.criticality_threshold=3e-7")
    recorded = record(f"records.traces={policy}", *sometimes_critical, n=400)
    assert traced(recorded) == episodes_where(recorded, wanted)
    if policy != "all":
        assert 0 < len(traced(recorded)) < 400


def test_a_share_is_chosen_by_index_whatever_the_outcome(record):
    share = ("records.traces=none", "records.trace_share=0.2")
    mixture = record(*share, n=400)
    natural = record(*share, "testing.method=nde", n=400)
    brave = record(*share, "av.parameters.min_acceleration_mps2=-8", n=400)
    assert traced(mixture) == traced(natural) == traced(brave)
    assert 40 < len(traced(mixture)) < 120
    outcomes = set(mixture.tables.episodes.take(traced(mixture))["outcome"].to_pylist())
    assert outcomes >= {"crash", "timeout"}


def test_the_share_does_not_depend_on_cells_or_shards(record):
    share = ("records.traces=none", "records.trace_share=0.2")
    whole = traced(record(*share, n=300, n_cells=64))
    halves = traced(record(*share, n=150, n_cells=7)) + traced(record(*share, first=150, n=150, n_cells=3))
    assert whole == halves


def test_the_share_comes_on_top_of_the_policy(record):
    both = record("records.traces=crash", "records.trace_share=0.2", n=300)
    share = traced(record("records.traces=none", "records.trace_share=0.2", n=300))
    crashes = episodes_where(both, lambda row: row["outcome"] == "crash")
    assert traced(both) == sorted({*share, *crashes})


@pytest.mark.parametrize("share", [0.0, 0.01, 0.5, 1.0])
def test_the_share_is_the_share_and_another_seed_chooses_others(share):
    index = np.arange(200_000)
    chosen = traced_by_index(1, index, share)
    assert abs(chosen.mean() - share) < 5 * np.sqrt(share * (1 - share) / index.size) + 1e-12
    if 0.0 < share < 1.0:
        other = traced_by_index(2, index, share)
        assert abs((chosen & other).mean() - share**2) < 0.005


def test_rows_come_by_episode_step_and_vehicle(record):
    rows = record("records.traces=all", n=30).tables
    order = {"LV": 0, "BV": 1, "AV": 2}
    columns = (rows.traces[name].to_pylist() for name in ("episode", "step", "vehicle"))
    keys = [(episode, step, order[vehicle]) for episode, step, vehicle in zip(*columns, strict=True)]
    expected = [
        (row["episode"], step, vehicle)
        for row in rows.episodes.to_pylist()
        for step in range(row["n_steps"] + 1)
        for vehicle in range(3)
    ]
    assert keys == expected


def test_a_trace_tells_the_same_story_as_its_row(record):
    recorded = record("records.traces=all", n=200)
    traces = recorded.tables.traces
    table = {name: traces[name].to_numpy(zero_copy_only=False) for name in ("episode", "step", "x_m", "v_mps", "lane")}
    for row in recorded.tables.episodes.to_pylist():
        mine = table["episode"] == row["episode"]
        x, v, lane = (table[name][mine].reshape(-1, 3) for name in ("x_m", "v_mps", "lane"))
        assert x[-1, AV] - x[0, AV] == row["av_distance_m"]
        assert v[0, 1] == row["v_bv_mps"]
        np.testing.assert_allclose(x[0, 0] - 5.0 - x[0, 1], row["r1_m"], atol=1e-9)
        np.testing.assert_allclose(x[0, 1] - 5.0 - x[0, 2], row["r2_m"], atol=1e-9)
        if row["outcome"] == "crash":
            assert x[-1, 1] - 5.0 - x[-1, 2] < -0.001 <= x[-2, 1] - 5.0 - x[-2, 2]
            assert v[-1, 2] - v[-1, 1] == row["impact_speed_mps"]
        if row["cut_in_step"] is not None:
            cut = row["cut_in_step"]
            assert (lane[: cut + 1, 1] == 1).all()
            assert (lane[cut + 1 :, 1] == 0).all()
            assert x[cut, 1] - 5.0 - x[cut, 2] == row["cut_in_r2_m"]
        assert (lane[:, 0] == 1).all()
        assert (lane[:, 2] == 0).all()


def test_the_last_step_commands_nothing(record):
    traces = record("records.traces=all", n=20).tables.traces.to_pylist()
    last = {row["episode"]: row["step"] for row in traces}
    assert all((row["a_mps2"] is None) == (row["step"] == last[row["episode"]]) for row in traces)
