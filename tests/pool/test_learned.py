"""A surrogate learned from a vehicle that crashes beyond the library's boundaries: what its shell holds."""

from __future__ import annotations

import numpy as np
import pyarrow as pa
import pytest

from harness.pool.learned import Learned
from harness.pool.vehicle_pool import vehicle_pool
from harness.records.folder import PILOT
from harness.sampling.baseline import learned_from, prescribed_requests, run_baseline
from harness.strata import LEARNED, OUTSIDE
from harness.vocabulary import CRASH
from tests.pool.test_vehicle_pool import acting, prepared_after

pytestmark = pytest.mark.slow

AS_NEEDED = "av.controller=examples.acting:CarefulAsNeeded"


def after_pilot(*more: str):
    """Campaign, loop and runs after the baseline runs, and what the pilot tests teach."""
    ready, loop, runs = prepared_after(acting("Speeds", AS_NEEDED, *more))
    paths = ready.baseline_paths
    requests = prescribed_requests(ready.pilot(), PILOT)
    tables = [run_baseline(loop, paths, ready.resolved, each).table for each in requests]
    return ready, loop, runs, pa.concat_tables(tables)


@pytest.fixture(scope="module")
def late():
    return after_pilot("av.parameters.dead_time_s=0.5")


def counted(ready, loop, stratum: int, n: int) -> float:
    """Share of the first tests of a stratum that crash."""
    rows = ready.prescribed._order[stratum][:n]
    traffic = ready.prescribed.of_rows(rows, np.full(rows.size, stratum))
    return float((loop.run(0, traffic).episode["outcome"] == CRASH).mean())


def test_a_dead_time_is_found_and_the_shell_holds_nearly_all_crashes_beyond_the_boundaries(late):
    """By tests of its own: four of five in the shell crash, and next to none of the thousands that are left outside."""
    ready, loop, runs, tests = late
    before = vehicle_pool(ready.resolved, ready.baseline_paths, runs)
    learned = learned_from(tests, runs)
    assert (learned.dead_steps, learned.lag) == (5, 0.0)
    ready.begin_after(runs, learned)
    design = ready.design
    shell, outside = design.strata.index(LEARNED), design.strata.index(OUTSIDE)
    assert (shell, "pilot tests" in design.learned) == (design.n_inside, True)
    share = counted(ready, loop, shell, 400)
    assert share > 0.8
    assert design.p[outside] * counted(ready, loop, outside, 4000) < 0.2 * design.p[shell] * share
    # The rest is as it was: the shell is a part of what lay outside.
    names = [*before.names, "nobody"]
    former = dict(zip(names, before.shell_p, strict=True))
    np.testing.assert_allclose(design.p[: design.n_inside], [former[name] for name in design.strata[: design.n_inside]])
    beyond = sum(p for name, p in former.items() if name not in (*design.strata, "nobody"))
    assert design.p[shell] + design.p[outside] == pytest.approx(beyond)


def test_pilot_tests_are_not_counted_and_fail_like_others(late):
    ready, _, runs, tests = late
    assert tests.num_rows == pytest.approx(ready.campaign.pool.pilot_tests, abs=20)
    nothing = tests.set_column(tests.column_names.index("failure"), "failure", pa.array(["lost"] * tests.num_rows))
    assert learned_from(nothing, runs) is None


def test_a_vehicle_that_crashes_only_where_surrogates_do_has_the_pool_that_it_had():
    """And so has one whose surrogate crashes nowhere."""
    ready, _, runs = prepared_after(acting("Speeds"))
    former = ready.design.pool
    nowhere = Learned(np.full((96, 300), -9.0), 0.0, 0, 300)
    ready.begin_after(runs, nowhere)
    assert (ready.design.pool, ready.design.learned, LEARNED in ready.design.strata) == (former, "", False)
    everywhere = nowhere._replace(table=np.full_like(nowhere.table, 2.0))
    ready.begin_after(runs, everywhere)
    assert ready.design.pool != former
    assert LEARNED in ready.design.strata
