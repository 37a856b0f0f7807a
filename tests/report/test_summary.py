"""Counts, weights, rankings and bins against the same numbers computed from the whole table."""

from __future__ import annotations

import math

import numpy as np
import pyarrow.parquet as pq
import pytest
from hypothesis import given
from hypothesis import strategies as st

from harness.report import crashes
from harness.report.crashes import CANDIDATES, crash_gallery, worst_crashes
from harness.report.player import UNKNOWN
from harness.report.summary import read_run_folder, summarise
from harness.report.test_plots import binned, edges_for, weighted_quantile
from harness.vocabulary import CRASH, OUTCOMES
from tests.report.test_page import edit


@pytest.fixture(scope="module")
def table(folders):
    return pq.read_table(folders["weighted"] / "episodes").to_pandas().sort_values("episode", ignore_index=True)


@pytest.fixture(scope="module")
def summary(runs):
    return summarise(runs["weighted"])


def test_counts_and_weights_by_outcome(summary, table):
    for k, outcome in enumerate(OUTCOMES):
        rows = table[table.outcome == outcome]
        assert summary.count[k] == len(rows)
        assert summary.weight[k] == pytest.approx(np.exp(rows.log_weight).sum(), rel=1e-12)


def test_of_plain_driving_tests_without_a_cut_in_are_counted_and_not_kept(runs):
    summary = summarise(runs["nde"])
    assert summary.all_weights_one
    assert summary.weight.tolist() == summary.count.tolist()
    assert summary.rows["weight"].size < summary.n_episodes == 240


@pytest.mark.parametrize(("ranking", "key"), [("impact_speed_mps", "impact_speed_mps"), ("weight", "log_weight")])
def test_worst_crashes_are_the_worst(summary, table, ranking, key):
    crash = table[(table.outcome == "crash") & (table.episode % 3 > 0)]
    crash = crash.sort_values([key, "episode"], ascending=[False, True])
    episode = summary.crashes["episode"]
    kept = episode[worst_crashes(summary.crashes[ranking], episode, episode % 3 > 0)]
    assert kept.tolist() == crash.episode.head(CANDIDATES).tolist()


@pytest.mark.parametrize(("n_episodes", "n_shards"), [(1_234, 3), (2_000, 2)])
def test_only_the_prefix_that_counts_and_listed_shards_are_read(run_folder, n_episodes, n_shards):
    shards = edit(run_folder / "manifest.json")["shards"]
    edit(run_folder / "manifest.json", n_episodes=n_episodes, shards=shards[:n_shards])
    assert summarise(read_run_folder(run_folder)).n_episodes == n_episodes


def test_gallery_prefers_traced_crashes_where_few_are_traced(run_folder, summary, monkeypatch):
    """With traces of one bad crash only, that one is there to be watched, at its true rank.

    Nobody knows who else crashes here.
    """
    monkeypatch.setattr(crashes, "_ends", lambda *_: np.full((summary.n_crashes, 2), UNKNOWN))
    tenth = int(summary.crashes["episode"][np.argsort(-summary.crashes["impact_speed_mps"], kind="stable")[9]])
    for path in sorted((run_folder / "traces").iterdir()):
        traces = pq.read_table(path)
        pq.write_table(traces.filter(np.asarray(traces.column("episode")) == tenth), path)
    rows, scenes = crash_gallery(read_run_folder(run_folder), summary)
    shown = [(row.crash.episode, row.reason.split(", ")[0], row.scene) for row in rows if row.scene is not None]
    assert shown == [(tenth, "impact no. 10", 0)]
    assert [scene["episode"] for scene in scenes] == [tenth]
    assert any(row.scene is None for row in rows)


@given(st.lists(st.floats(-3.0, 13.0), min_size=1, max_size=40), st.integers(8, 80))
def test_bins_hold_every_value_and_are_few(values, most):
    values = np.array(values)
    bins = binned(values, np.full(values.size, 0.5), edges_for(values, 0.1, most))
    assert bins.counts.sum() == values.size
    assert bins.shares.sum() == pytest.approx(100.0)
    assert bins.counts.size <= most + 1


def test_values_on_an_edge_and_weighted_quantiles():
    tenths = 0.1 * np.arange(10)  # of which 0.3 is a little less than its edge
    assert binned(tenths, tenths, 0.1 * np.arange(11)).counts.tolist() == [1.0] * 10
    values, weights = np.array([9.0, 1.0, 2.0]), np.array([8.0, 1.0, 1.0])
    assert weighted_quantile(values, weights, 0.5) == 9.0
    assert weighted_quantile(values, weights, 0.15) == 2.0
    assert math.isnan(weighted_quantile(values, 0.0 * weights, 0.5))


@pytest.mark.parametrize("name", ["shells", "shells_refuted"])
def test_weights_of_a_shells_run_add_up_to_the_rate(runs, name):
    """Those that are recorded do not: they ignore how often shells were tested."""
    run, summary = runs[name], summarise(runs[name])
    assert summary.per_test(float(summary.weight[CRASH])) == pytest.approx(run.headline.crash_rate, rel=1e-12)
    assert summary.crashes["weight"].sum() == pytest.approx(run.headline.crash_rate, rel=1e-12)
    if name == "shells_refuted":
        tested = math.fsum(shell.p for shell in run.shells.shells if shell.n_episodes)
        assert summary.weight.sum() == pytest.approx(tested, rel=1e-12)
        last = max(k for k, shell in enumerate(run.shells.shells) if shell.n_crashes)
        outside, component = run.shells.shells[last], summary.crashes["component"]
        assert component.max() == last
        assert summary.crashes["weight"][component == last] == pytest.approx(outside.p / outside.n_episodes, rel=1e-12)
