from __future__ import annotations

import re
from pathlib import Path

import pyarrow as pa
import pyarrow.parquet as pq
import pytest
from report_page import edit

from harness.errors import RunFolderError
from harness.report import write_report


def truncate(path: Path) -> None:
    content = path.read_bytes()
    path.write_bytes(content[: len(content) // 2])


def corrupt_middle(path: Path) -> None:
    content = bytearray(path.read_bytes())
    middle = slice(len(content) // 4, len(content) // 2)
    content[middle] = bytes(b ^ 0xFF for b in content[middle])
    path.write_bytes(bytes(content))


@pytest.mark.parametrize("table", ["episodes", "moments", "traces"])
@pytest.mark.parametrize("damage", [truncate, Path.unlink])
def test_a_damaged_or_missing_shard_is_named(run_folder, table, damage):
    shard = run_folder / table / "shard-000001.parquet"
    damage(shard)
    (run_folder / "report.html").write_text("of an earlier report")
    with pytest.raises(RunFolderError, match=re.escape(str(shard))) as caught:
        write_report(run_folder)
    assert caught.value.exit_code == 2
    assert (run_folder / "report.html").read_text() == "of an earlier report"


@pytest.mark.parametrize("table", ["episodes", "traces"])
def test_a_shard_with_a_good_footer_and_broken_pages_is_named(run_folder, table):
    shard = run_folder / table / "shard-000001.parquet"
    corrupt_middle(shard)
    with pytest.raises(RunFolderError, match=re.escape(str(shard))):
        write_report(run_folder)


def with_column(table: pa.Table, name: str, values: pa.Array) -> pa.Table:
    place = table.schema.get_field_index(name)
    return table.set_column(place, table.schema.field(place).with_type(values.type), values)


@pytest.mark.parametrize(
    ("changed", "match"),
    [
        (lambda table: table.slice(0, 990), r"shard-000001.*found 990 rows; expected 1000 rows"),
        (lambda table: table.drop_columns(["log_weight"]), r"shard-000001.*no column 'log_weight'"),
        (
            lambda table: with_column(table, "outcome", pa.array(["flew away"] * 1000, table.column("outcome").type)),
            "flew away",
        ),
        (
            lambda table: with_column(table, "log_weight", table.column("log_weight").cast(pa.float32())),
            "log_weight as double and float",
        ),
    ],
    ids=["rows are lost", "a column is missing", "an unknown outcome", "a column of another type"],
)
def test_a_shard_that_does_not_fit_is_named(run_folder, changed, match):
    shard = run_folder / "episodes" / "shard-000001.parquet"
    pq.write_table(changed(pq.read_table(shard)), shard)
    with pytest.raises(RunFolderError, match=match):
        write_report(run_folder)


@pytest.mark.parametrize("text", ["{}", "testing: 5", "[]"])
def test_a_campaign_without_its_sections_is_named(run_folder, text):
    (run_folder / "campaign.yaml").write_text(text, encoding="utf-8")
    with pytest.raises(RunFolderError, match=r"campaign.yaml: found .*; expected a campaign"):
        write_report(run_folder)


FILES = ["manifest.json", "estimates.json", "campaign.yaml"]


@pytest.mark.parametrize("name", FILES)
def test_a_missing_file_is_named_with_what_to_do(run_folder, name):
    (run_folder / name).unlink()
    with pytest.raises(RunFolderError, match=rf"{name}: found no such file") as caught:
        write_report(run_folder)
    assert caught.value.mend


@pytest.mark.parametrize("name", FILES)
@pytest.mark.parametrize("content", ["{broken", "[]", "\x00"])
def test_a_broken_file_is_named(run_folder, name, content):
    (run_folder / name).write_text(content)
    with pytest.raises(RunFolderError, match=name):
        write_report(run_folder)


@pytest.mark.parametrize(
    ("name", "changes", "match"),
    [
        ("estimates.json", {"campaign_hash": "feedfeedfeedfeed"}, "feedfeedfeedfeed"),
        ("estimates.json", {"headline": "oracle"}, "oracle"),
        # An absent rate is refused, not drawn as zero.
        (
            "estimates.json",
            {"convergence": [{"n": 1, "ci_low": 0, "ci_high": 1, "rhw": 1}]},
            r"convergence\.0\.crash_rate",
        ),
        ("manifest.json", {"shards": [{"index": 0, "first_episode": 0, "n_episodes": 1}]}, r"manifest\.json"),
    ],
)
def test_what_no_run_has_written_is_refused(run_folder, name, changes, match):
    edit(run_folder / name, **changes)
    with pytest.raises(RunFolderError, match=match):
        write_report(run_folder)


def test_a_folder_that_is_no_run_is_refused_and_stays_empty(tmp_path):
    with pytest.raises(RunFolderError, match=r"manifest\.json"):
        write_report(tmp_path)
    assert list(tmp_path.iterdir()) == []
