"""The streamed summary against the same numbers computed at once from the whole table."""

from __future__ import annotations

import numpy as np
import pyarrow.parquet as pq
import pytest
from hypothesis import given
from hypothesis import strategies as st
from report_page import edit

from harness.report.crash_gallery import crash_gallery
from harness.report.histograms import Axis, FineHistogram
from harness.report.run_folder import read_run_folder
from harness.report.summary import NUMBERS, RunSummary, summarise
from harness.vocabulary import OUTCOMES


@pytest.fixture(scope="module")
def table(folders):
    return pq.read_table(folders["full"] / "episodes").to_pandas().sort_values("episode", ignore_index=True)


@pytest.fixture(scope="module")
def summary(runs):
    return summarise(runs["full"])


def test_counts_and_weights_by_outcome(summary, table):
    for k, outcome in enumerate(OUTCOMES):
        rows = table[table.outcome == outcome]
        assert summary.count[k] == len(rows)
        assert summary.weight[k] == pytest.approx(np.exp(rows.log_weight).sum(), rel=1e-12)


def test_histograms_hold_every_crash_with_its_weight(summary, table):
    crash = table[table.outcome == "crash"]
    total = np.exp(crash.log_weight).sum()
    for name in ("log10_weight_crash", "stratum_crash", "impact_speed_mps", "crash_time_s", "response_time_s"):
        bins = getattr(summary, name).bins(30)
        assert bins.counts.sum() == len(crash)
        assert bins.weights.sum() == pytest.approx(total, rel=1e-12)


def test_strata_are_exact(summary, table):
    crash = table[table.outcome == "crash"]
    for stratum in (10, 40, 80):
        rows = crash[crash.n_control_steps == stratum]
        assert summary.stratum_crash.count[stratum] == len(rows)
        assert summary.stratum_crash.weight[stratum] == pytest.approx(np.exp(rows.log_weight).sum(), rel=1e-12)


def test_cut_in_grid_agrees_with_numpy(summary, table):
    cuts = table.dropna(subset=["cut_in_r2_m"])
    grid = summary.cut_in
    block = grid.used()
    edges = [axis.edges(of.start, of.stop) for axis, of in zip(grid.axes, block, strict=True)]
    expected, _, _ = np.histogram2d(
        cuts.cut_in_r2dot_mps, cuts.cut_in_r2_m, bins=edges, weights=np.exp(cuts.log_weight)
    )
    np.testing.assert_allclose(grid.weight[block], expected, rtol=1e-9)


@pytest.mark.parametrize(("ranking", "key"), [("hardest", "impact_speed_mps"), ("heaviest", "log_weight")])
def test_worst_crashes_are_the_worst(summary, table, ranking, key):
    crash = table[table.outcome == "crash"].sort_values([key, "episode"], ascending=[False, True])
    kept = getattr(summary, ranking).crashes
    assert [c.episode for c in kept] == crash.episode.head(len(kept)).tolist()


def test_batch_size_does_not_matter(runs, summary):
    other = RunSummary()
    for batch in runs["full"].episodes(*NUMBERS, "outcome", "failure"):
        outcome = np.array([OUTCOMES.index(str(name)) for name in batch.column("outcome").to_pylist()])
        for first in range(0, batch.num_rows, 37):
            other.add(batch.slice(first, 37), outcome[first : first + 37])
    np.testing.assert_array_equal(other.count, summary.count)
    np.testing.assert_allclose(other.weight, summary.weight, rtol=1e-12)
    assert other.hardest.crashes == summary.hardest.crashes


@pytest.mark.parametrize(("n_episodes", "n_shards"), [(1_234, 3), (2_000, 2)])
def test_only_the_prefix_that_counts_and_listed_shards_are_read(run_folder, n_episodes, n_shards):
    shards = edit(run_folder / "manifest.json")["shards"]
    edit(run_folder / "manifest.json", n_episodes=n_episodes, shards=shards[:n_shards])
    assert summarise(read_run_folder(run_folder)).n_episodes == n_episodes


def test_gallery_prefers_traced_crashes_where_few_are_traced(run_folder, summary):
    """With traces of one bad crash only, that one is shown with its diagram, at its true rank."""
    tenth = summary.hardest.crashes[9].episode
    for path in sorted((run_folder / "traces").iterdir()):
        traces = pq.read_table(path)
        pq.write_table(traces.filter(np.asarray(traces.column("episode")) == tenth), path)
    rows = crash_gallery(read_run_folder(run_folder), summary)
    shown = [(row.crash.episode, row.reason.split(", ")[0]) for row in rows if row.plot]
    assert shown == [(tenth, "impact no. 10")]
    assert any(row.plot is None for row in rows)


@given(st.lists(st.floats(-3.0, 13.0), min_size=1, max_size=40), st.integers(1, 40))
def test_merging_fine_bins_loses_nothing_and_keeps_the_limit(values, most):
    histogram = FineHistogram(Axis(0.0, 10.0, 0.1))
    histogram.add(np.full(len(values), 0.5), np.array(values))
    bins = histogram.bins(most)
    assert bins.counts.sum() == len(values)
    assert bins.weights.sum() == pytest.approx(0.5 * len(values))
    assert bins.counts.size <= most
    assert bins.edges.size == bins.counts.size + 1
    inside = np.clip(values, 0.0, 9.9999)
    assert bins.edges[0] <= inside.min() + 1e-6
    assert inside.max() <= bins.edges[-1] + 1e-6


def test_weighted_quantile():
    histogram = FineHistogram(Axis(0.0, 10.0, 0.1))
    histogram.add(np.array([1.0, 1.0, 8.0]), np.array([1.0, 2.0, 9.0]))
    assert histogram.weighted_quantile(0.5) == pytest.approx(9.05)
    assert histogram.weighted_quantile(0.15) == pytest.approx(2.05)
    assert np.isnan(FineHistogram(Axis(0.0, 1.0, 0.1)).weighted_quantile(0.5))
