"""How hard it crashes: against records taken apart by hand, and bands that hold, by replication.

``python -m tests.estimators.test_severity`` prints how often they do for all `VEHICLES`, from 500 campaigns each.
"""

import sys

import numpy as np
import pytest

import harness
from harness.estimators.block import Block, SamplingPlan, joined
from harness.estimators.one_pass import one_pass
from harness.estimators.severity import SPEEDS_MPS, Impacts
from harness.estimators.shells import SeenShells
from harness.estimators.stopping import RoundRule
from harness.loop.loop import EpisodeLoop, RecordPolicy
from harness.pool.build import campaign_pool
from harness.resolved import resolve
from harness.runner.stored import stored_blocks
from harness.sampling import prepare
from harness.sampling.shells import ShellRounds
from harness.vocabulary import CRASH, FAILED, SAMPLING, TIMEOUT
from harness.worlds.twin import TwinWorld
from tests.in_process import run_here
from tests.stored_runs import answer_in, estimates, golden, stored_table


@pytest.mark.parametrize("name", ["nde-twin", "step-recursive-twin", "mixture-twin", "shells-twin", "shells-sumo"])
def test_it_is_the_rate_of_harder_crashes_by_the_same_estimator(name, stored_run):
    folder, own = stored_run(name), SAMPLING[golden(name).testing.method].headline
    content, rows = harness.read(folder).estimates, stored_table(folder, "episodes").to_pandas()
    crashes = rows[rows.outcome == "crash"]
    found = {row["above_mps"]: row for row in content["severity"]["exceedance"]}
    assert tuple(found) == SPEEDS_MPS
    for above in (0.0, 2.0, 5.0, 20.0):
        harder = [block.harder_than(above) for block in stored_blocks(folder, moments=False)]
        alone = one_pass(harder, [own]).headline_estimate
        n = int((crashes.impact_speed_mps > above).sum())
        assert (found[above]["n_crashes"], alone.n_crashes) == (n, n)
        for key in ("crash_rate", "ci_low", "ci_high", "upper_bound"):
            assert found[above][key] == pytest.approx(getattr(alone, key), rel=1e-9, abs=1e-30)
    weight = np.exp(crashes.log_weight.to_numpy())
    if own == "shells":
        weight /= rows.groupby("component").size()[crashes.component].to_numpy()
    order = np.argsort(crashes.impact_speed_mps.to_numpy())
    impact, share = crashes.impact_speed_mps.to_numpy()[order], np.cumsum(weight[order]) / weight.sum()
    severity = content["severity"]
    late = (rows.outcome == "timeout") & (rows.end_ttc_s < 2.0)
    tests = rows.groupby("component").size()[rows.component].to_numpy() if own == "shells" else len(rows)
    assert content["cut_off"] == pytest.approx((np.exp(rows.log_weight) / tests)[late].sum(), rel=1e-12)
    assert content["cut_off_test"] == (int(rows.episode[late].min()) if late.any() else None)
    assert severity["median_mps"] == impact[np.searchsorted(share, 0.5)]
    assert severity["share_below_1_mps"] == pytest.approx(weight[crashes.impact_speed_mps <= 1.0].sum() / weight.sum())
    assert severity["share_above_5_mps"] == pytest.approx(weight[crashes.impact_speed_mps > 5.0].sum() / weight.sum())


@pytest.mark.parametrize("method", ["nde", "shells"])
def test_a_failed_test_may_have_been_a_crash_of_any_speed(method, stored_run):
    block = joined(list(stored_blocks(stored_run(f"{method}-twin"), moments=False)))
    hardest = {n: one_pass([block.ending(np.arange(len(block)) < n, FAILED)]).severity.exceedance[-1] for n in (0, 5)}
    assert hardest[5].ci_high > hardest[0].ci_high


# -- replication: every cut-in that a pool keeps is driven once; campaigns draw from them, and the truth is known --

VEHICLES = {
    "idm": "av.parameters.min_acceleration_mps2=-4",
    "brakes-8": "av.parameters.min_acceleration_mps2=-8",
    "late": "av.reaction.delay_s=0.6",
    "fvdm": "av={model: fvdm}",
    "touches": "av.reaction.delay_s=0.6",
}
ABOVE_MPS = (0.0, 1.0, 3.0, 5.0, 10.0)


@pytest.fixture(scope="module")
def source():
    return prepare(resolve(golden("shells-twin")))


def driven(source, name):
    """Whether the vehicle crashes on each cut-in of the pool, and how hard; one only touches but for one in fifty."""
    n, scenario = source.pool.events.step.size, resolve(golden("shells-twin", VEHICLES[name])).scenario
    traffic = source.prescribed.of_rows(np.arange(n), np.zeros(n, np.int64))
    episode = EpisodeLoop(TwinWorld(256), scenario, RecordPolicy("none", 0.0)).run(0, traffic).episode
    impact = episode["impact_speed_mps"]
    if name == "touches":
        impact = np.where(np.arange(n) % 50 > 0, 0.05 * impact, impact)
    return episode["outcome"] == CRASH, impact


def campaign_of(source, crashed, impact, rows, rng):
    """One campaign to its own precision, its tests drawn from the cut-ins of each stratum with replacement."""
    campaign = golden("shells-twin", "stop.rhw=0.4", "stop.episodes=20000", "testing.shells.first_tests=20")
    design = source.design.without_references()
    rounds = ShellRounds(campaign, design, np.full(design.p.size, 20_000), RoundRule(campaign))
    seen, sums = SeenShells(design), Impacts(SeenShells)
    while (added := rounds.next_round(seen)[0]).any():
        stratum = np.repeat(np.arange(added.size), added)
        chosen = np.concatenate([rng.choice(rows[s], k) for s, k in enumerate(added.tolist()) if k])
        n, crash = stratum.size, crashed[chosen]
        columns = {
            "happened": np.ones(n, bool), "stratum": stratum, "cell": stratum, "impact_mps": impact[chosen],
            "cell_mass": np.zeros((n, design.p.size)),
        }  # fmt: skip
        outcome = np.where(crash, CRASH, TIMEOUT).astype(np.int8)
        block = Block(int(seen.tally.tests.sum()), outcome, np.zeros(n), columns, SamplingPlan("shells", shells=design))
        sums.add(block)
        seen.add(block)
        if rounds.rule.observe(seen):
            break
    return {row.above_mps: row for row in sums.result(0.9).exceedance}


@pytest.fixture(scope="module")
def harder():
    """Where only crashes above 5 m/s count."""
    return prepare(resolve(golden("shells-twin", "crash.counts_above_mps=5")))


@pytest.mark.slow
def test_drivers_of_the_pool_are_judged_by_the_speed_that_counts(harder, source):
    """But the envelope: of it every crash counts."""
    crashed, impact = driven(harder, "brakes-8")
    counts = crashed & (impact > 5.0)
    resolved = resolve(golden("shells-twin", "crash.counts_above_mps=5"))
    pool, before = campaign_pool(resolved), campaign_pool(resolve(golden("shells-twin")))
    place = {name: pool.names.index(name) for name in ("brakes-8", "full-throttle-2")}
    assert 0 < counts.sum() < crashed.sum()
    assert np.array_equal(pool.events.crashes[:, place["brakes-8"]], counts)
    mu = {name: (pool.mu[of], before.mu[before.names.index(name)]) for name, of in place.items()}
    assert mu["brakes-8"][0] < 0.7 * mu["brakes-8"][1]
    assert mu["full-throttle-2"][0] == pytest.approx(mu["full-throttle-2"][1], rel=0.2)
    assert np.all(pool.reference_rate < 0.8 * before.reference_rate)


def test_a_campaign_that_counts_harder_crashes_alone_agrees_with_the_severity_of_all(tmp_path, stored_run):
    """In rate, ratio, statements and stop rule, with the same limits at 5 m/s and no row below."""
    run_here(golden("shells-twin", "crash.counts_above_mps=5"), tmp_path / "run")
    found, of_all = estimates(tmp_path / "run"), estimates(stored_run("shells-twin"))
    rows = stored_table(tmp_path / "run", "episodes").to_pandas()
    assert found["n_crashes"] == (rows.impact_speed_mps > 5.0).sum() < (rows.outcome == "crash").sum()
    first, same = found["severity"]["exceedance"][0], found["estimates"]["shells"]
    assert (first["above_mps"], first["crash_rate"], first["ci_high"]) == (5.0, same["crash_rate"], same["ci_high"])
    [at_5] = [row for row in of_all["severity"]["exceedance"] if row["above_mps"] == 5.0]
    assert same["ci_low"] < at_5["ci_high"]
    assert at_5["ci_low"] < same["ci_high"]
    assert answer_in(tmp_path / "run")["rows"][0]["what"] == "crash rate > 5 m/s"


def held(source, name, n_campaigns):
    """Shares of campaigns whose band (first row) and one-sided bound hold at each speed."""
    crashed, impact = driven(source, name)
    rows = [source.prescribed._order[s] for s in range(source.design.p.size)]

    def rate(above):
        return sum(
            p * np.mean(crashed[events] & ((impact[events] > above) | (above == 0.0)))
            for p, events in zip(source.design.p, rows, strict=True)
        )

    truth, rng, found = {above: rate(above) for above in ABOVE_MPS}, np.random.default_rng(20), []
    for _ in range(n_campaigns):
        of = campaign_of(source, crashed, impact, rows, rng)
        found.append([(of[v].ci_low <= truth[v] <= of[v].ci_high, truth[v] <= of[v].upper_bound) for v in ABOVE_MPS])
    return np.mean(found, axis=0).T


@pytest.mark.slow
@pytest.mark.parametrize("name", ["idm", "touches"])
def test_bands_and_bounds_hold_at_each_speed(name, source):
    """At 90 %, where each campaign stops by its own rate; the pool's own error is not in it."""
    assert np.all(held(source, name, 60) >= 0.9 - 2.0 * np.sqrt(0.09 / 60))


if __name__ == "__main__":
    pool = prepare(resolve(golden("shells-twin")))
    for name in VEHICLES:
        sys.stdout.write(f"{name} {ABOVE_MPS} {held(pool, name, 500).round(3).tolist()}\n")
