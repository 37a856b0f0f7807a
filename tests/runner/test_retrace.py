"""The twin retraces what was driven: to the last bit where nothing is wrong, and no further where anything is."""

from __future__ import annotations

import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq
import pytest

from harness.errors import WorldDisagreementError
from harness.pool.replay import Retracing
from harness.resolved import resolve
from tests.in_process import run_here
from tests.stored_runs import copy_of, golden, manifest, of_before, shard_files, stored_table

RETRACED = (
    *("nde-sumo", "forced-sumo", "step-recursive-sumo", "shells-lateral-sumo", "shells-refuted", "shells-need-based"),
    *("forced-inattentive", "forced-reference", "nde-lateral", "shells-stops"),
)


def check(name: str, table: pa.Table, *overrides: str) -> int:
    return Retracing(resolve(golden(name, "world.engine=sumo", *overrides))).check(table)


@pytest.mark.parametrize("name", RETRACED)
def test_every_episode_of_a_built_in_av_is_retraced(name, stored_run):
    table = stored_table(stored_run(name), "episodes")
    assert check(name, table) == table.num_rows
    if name.endswith("sumo"):
        said = manifest(stored_run(name))["retraced"]
        assert said["n_episodes"] == said["n_equal"] == table.num_rows
        assert ("onset_r2_m" if "lateral" in name else "cut_in_r2_m") in said["compared"]


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


@pytest.fixture
def forced(stored_run) -> pa.Table:
    return stored_table(stored_run("forced-twin"), "episodes")


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
    with pytest.raises(WorldDisagreementError, match=named):
        check("forced-twin", changed(forced, column, value))


def test_of_another_av_only_the_way_to_the_cut_in_is_known(forced):
    unknown = "av={sumo: {carFollowModel: IDM}}"
    assert check("forced-sumo", changed(forced, "impact_speed_mps", one_bit), unknown) == forced.num_rows
    with pytest.raises(WorldDisagreementError):
        check("forced-sumo", changed(forced, "cut_in_r2_m", one_bit), unknown)
    early = Retracing(resolve(golden("forced-acting-sumo")))
    assert early.check(forced) == 0
    assert "before the cut-in" in early.summary(0)["reason"]


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
