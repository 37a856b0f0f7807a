"""The twin retraces what was driven: to the last bit where nothing is wrong, and no further where anything is."""

from __future__ import annotations

import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq
import pytest

from harness.campaign.campaign import Campaign
from harness.campaign.drivers import IDMParameters, Reaction
from harness.campaign.vehicle import AutomatedVehicle
from harness.errors import WorldDisagreementError
from harness.pool.replay import Retracing
from harness.records.schemas import episodes_table
from harness.resolved import resolve
from harness.runner.prepare import prepare
from harness.worlds.twin import TwinWorld
from tests.chains.seed import SEED
from tests.in_process import run_here
from tests.stored_runs import copy_of, golden, manifest, of_before, shard_files, stored_table

N = 600
AVS = {
    "idm": AutomatedVehicle(),
    "late, smooth, now and then inattentive": AutomatedVehicle(
        parameters=IDMParameters(min_acceleration_mps2=-3.0),
        reaction=Reaction(delay_s=0.4, max_jerk_mps3=8.0, inattention_probability=0.3, inattention_delay_s=1.0),
    ),
    "fvdm": AutomatedVehicle(model="fvdm"),
    "constant": AutomatedVehicle(model="constant"),
}


def of_av(method: str, av: AutomatedVehicle) -> Campaign:
    one = Campaign(name="retraced", seed=SEED, av=av)
    level = 1e5 if method == "nde" else 1.0
    environment = one.environment.model_copy(update={"lane_change_level": level})
    return one.model_copy(
        update={"environment": environment, "testing": one.testing.model_copy(update={"method": method})}
    )


def retracing(one: Campaign) -> Retracing:
    return Retracing(resolve(one))


def drive(one: Campaign) -> pa.Table:
    ready = prepare(resolve(one))
    return episodes_table(ready.loop(TwinWorld(64)).run(0, ready.states(0, N)), one.seed)


@pytest.fixture(scope="module")
def forced() -> tuple[Campaign, pa.Table]:
    one = of_av("forced", AVS["constant"])
    return one, drive(one)


@pytest.mark.parametrize("name", AVS)
@pytest.mark.parametrize("method", ["nde", "forced"])
def test_every_episode_of_a_built_in_av_is_retraced(method, name):
    one = of_av(method, AVS[name])
    assert retracing(one).check(drive(one)) == N


def changed(table: pa.Table, name: str, value) -> pa.Table:
    """The table with another value in the first row that has a crash."""
    row = table.column("outcome").to_pylist().index("crash")
    values = table.column(name).to_pylist()
    values[row] = value(values[row])
    at = table.column_names.index(name)
    field = table.schema.field(at)
    column = pa.array(values, pa.string()).dictionary_encode() if name == "outcome" else pa.array(values, field.type)
    return table.set_column(at, name, column)


def one_bit(value: float) -> float:
    return float(np.nextafter(value, np.inf))


@pytest.mark.parametrize(
    ("column", "value", "named"),
    [
        ("cut_in_r2_m", one_bit, "cut_in_r2_m"),
        ("cut_in_r2dot_mps", one_bit, "cut_in_r2dot_mps"),
        ("impact_speed_mps", one_bit, "impact_speed_mps"),
        ("crash_time_s", one_bit, "crash_time_s"),
        ("r2_m", lambda r2: r2 + 1e-9, "cut_in_r2_m"),
        ("outcome", lambda _: "timeout", "outcome"),
        ("n_steps", lambda n: n - 1, "outcome"),
        ("bv_maneuvers", lambda path: [30 - path[0], *path[1:]], "cut_in_r2_m"),
        ("bv_maneuvers", lambda path: path[:1], "maneuvers"),
    ],
)
def test_one_changed_value_raises_the_alarm(forced, column, value, named):
    one, table = forced
    assert retracing(one).check(table) == N
    with pytest.raises(WorldDisagreementError, match=named):
        retracing(one).check(changed(table, column, value))


def test_of_another_av_only_the_way_to_the_cut_in_is_known(forced):
    one, table = forced
    unknown = one.model_copy(update={"av": AutomatedVehicle(sumo={"carFollowModel": "IDM"})})
    impact = changed(table, "impact_speed_mps", one_bit)
    assert retracing(unknown).check(impact) == N
    assert "outcome" not in retracing(unknown).summary(N)["compared"]
    with pytest.raises(WorldDisagreementError):
        retracing(unknown).check(changed(table, "cut_in_r2_m", one_bit))


def test_an_av_that_acts_before_the_cut_in_cannot_be_retraced(forced):
    one, table = forced
    early = one.model_copy(update={"av": one.av.model_copy(update={"before_cut_in": "controller"})})
    assert retracing(early).check(table) == 0
    assert "before the cut-in" in retracing(early).summary(0)["reason"]


def test_a_run_in_sumo_says_that_all_is_equal(sumo_run):
    said = manifest(sumo_run)["retraced"]
    assert said["n_episodes"] == said["n_equal"] == stored_table(sumo_run, "episodes").num_rows
    assert {"cut_in_r2_m", "impact_speed_mps"} <= set(said["compared"])


def test_a_stored_shard_is_retraced_when_a_run_goes_on(sumo_run, tmp_path):
    folder = of_before(copy_of(sumo_run, tmp_path / "run"))  # without checksums, which would notice it first
    path = shard_files(folder)[0]
    table = pq.read_table(path, partitioning=None)
    values = table.column("cut_in_r2_m").to_pylist()
    row = next(i for i, value in enumerate(values) if value is not None)
    values[row] = one_bit(values[row])
    at = table.column_names.index("cut_in_r2_m")
    pq.write_table(table.set_column(at, table.schema.field(at), pa.array(values, pa.float64())), path)
    with pytest.raises(WorldDisagreementError, match=f"episode {row}"):
        run_here(golden("mixture-seven"), folder, resume=True)
