"""A driver beside the AV: equal to a walk of its own, in both worlds, and never ahead of itself."""

from __future__ import annotations

import numpy as np
import pytest

from harness import estimate, replay
from harness.campaign.drivers import NeedBasedParameters
from harness.vehicles.kinematics import CONTACT_M, VEHICLE_LENGTH_M
from tests.pool.conftest import SMALL_POOL
from tests.stored_runs import stored_table, unlike_columns

SHELLS = (
    "testing.method=shells", "stop.episodes=400", "stop.rhw=null", "stop.min_crashes=null", *SMALL_POOL,
    "testing.shells.first_tests=50",
)  # fmt: skip
TWIN = "world.engine=twin"
EQUAL = "av={model: need-based}"
KEEN = "{min_acceleration_mps2: -2.0, acceleration_mps2: 6.0, time_headway_s: 0.6}"
FASTER = f"av={{model: idm, parameters: {KEEN}, reaction: {{delay_s: 0.3}}}}"


def walked_beside(trace, cut_in_step: int) -> int | None:
    """Step after which the AV was first ahead of the need-based driver, from the trace, in plain Python."""
    p = NeedBasedParameters()
    of = {name: trace[trace["vehicle"] == name].sort_values("step") for name in ("AV", "BV")}
    x_av, x_bv, v_bv = of["AV"]["x_m"].to_numpy(), of["BV"]["x_m"].to_numpy(), of["BV"]["v_mps"].to_numpy()
    first = cut_in_step + 1
    x, v, needed_since = x_av[first], of["AV"]["v_mps"].to_numpy()[first], None
    for step in range(first, len(x_av) - 1):
        gap, closing = x_bv[step] - VEHICLE_LENGTH_M - x, v - v_bv[step]
        if gap < CONTACT_M:
            return None
        room = 2.0 * (gap - p.standstill_gap_m)
        needs = closing > 0.0 and closing**2 >= p.needed_mps2 * room
        needed_since = step if needs and needed_since is None else needed_since
        a = p.acceleration_mps2
        if needs and step - needed_since >= 5:
            a = -min(closing**2 / room, p.deceleration_mps2) if room > 0.0 else -p.deceleration_mps2
        after = max(v + 0.1 * a, 0.0)
        x, v = x + 0.05 * (v + after), after
        if x_av[step + 1] > x + 1e-6:
            return step + 1
    return None


@pytest.fixture(scope="module")
def faster(campaign, run_here, tmp_path_factory):
    """A vehicle that brakes too little, in the twin, with all its motion."""
    return run_here(campaign(*SHELLS, TWIN, FASTER, "records.traces=all"), tmp_path_factory.mktemp("faster") / "run")


def test_it_is_ahead_where_a_plain_walk_says_so(faster):
    episodes = stored_table(faster.folder, "episodes").to_pandas()
    traces = stored_table(faster.folder, "traces").to_pandas()
    ahead, motion = 0, dict(list(traces.groupby("episode")))
    for row in episodes.itertuples():
        expected = walked_beside(motion[row.episode], int(row.cut_in_step))
        assert (None if np.isnan(row.ahead_step) else int(row.ahead_step)) == expected, row.episode
        ahead += expected is not None
    assert 10 < ahead < len(episodes) - 10


def test_the_statement_says_so_where_it_matters(faster):
    """A vehicle that is ahead and never comes within 4 s of a collision does no harm; one that crashes has."""
    need = faster.estimates["estimates"]["shells"]["details"]["statements"][1]
    tests = stored_table(faster.folder, "episodes").to_pandas()
    was_ahead, crashed = tests["ahead_step"].notna(), tests["outcome"] == "crash"
    ahead = (was_ahead & (crashed | (tests["min_ttc_s"] < 4.0))).to_numpy()
    assert 0 < (was_ahead & crashed).sum() < ahead.sum() < was_ahead.sum()
    assert (need["n_checked"], need["n_ahead"]) == (400, ahead.sum())
    assert need["ahead_in"] == np.flatnonzero(ahead)[:10].tolist()
    assert estimate(faster.folder)["boundary_statements"] == faster.estimates["boundary_statements"]
    first = need["ahead_in"][0]
    assert (
        replay(faster.folder, first).row["ahead_step"]
        == stored_table(faster.folder, "episodes").column("ahead_step")[first].as_py()
    )


def test_the_boundary_itself_is_never_ahead_in_sumo_or_twin(campaign, run_here, tmp_path):
    """Bit for bit the same motion; and both worlds leave the same rows."""
    twin, sumo = (
        run_here(campaign(*SHELLS, EQUAL, f"world.engine={engine}"), tmp_path / engine) for engine in ("twin", "sumo")
    )
    assert [name for name in unlike_columns(twin.folder, sumo.folder) if name != "estimates.json"] == []
    tests = stored_table(sumo.folder, "episodes")
    assert tests.column("ahead_step").null_count == tests.num_rows
    assert tests.column("outcome").to_pylist().count("crash") > 100
