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
    page = (run_folder / "report.html").read_bytes()
    with pytest.raises(RunFolderError, match=re.escape(str(shard))) as caught:
        write_report(run_folder)
    assert caught.value.exit_code == 2
    assert (run_folder / "report.html").read_bytes() == page


@pytest.mark.parametrize("table", ["episodes", "traces"])
def test_a_shard_with_a_good_footer_and_broken_pages_is_named(run_folder, table):
    shard = run_folder / table / "shard-000001.parquet"
    corrupt_middle(shard)
    with pytest.raises(RunFolderError, match=re.escape(str(shard))):
        write_report(run_folder)


def test_a_shard_that_lost_rows_is_named(run_folder):
    shard = run_folder / "episodes" / "shard-000002.parquet"
    pq.write_table(pq.read_table(shard).slice(0, 990), shard)
    with pytest.raises(RunFolderError, match=r"shard-000002.*found 990 rows; expected 1000 rows"):
        write_report(run_folder)


def test_a_missing_column_is_named(run_folder):
    shard = run_folder / "episodes" / "shard-000000.parquet"
    pq.write_table(pq.read_table(shard).drop_columns(["log_weight"]), shard)
    with pytest.raises(RunFolderError, match=r"shard-000000.*no column 'log_weight'"):
        write_report(run_folder)


def test_an_unknown_outcome_is_named(run_folder):
    shard = run_folder / "episodes" / "shard-000000.parquet"
    table = pq.read_table(shard)
    place = table.schema.get_field_index("outcome")
    field = table.schema.field(place)
    pq.write_table(table.set_column(place, field, pa.array(["flew away"] * table.num_rows).cast(field.type)), shard)
    with pytest.raises(RunFolderError, match="flew away"):
        write_report(run_folder)


def test_a_column_of_another_type_in_one_shard_is_named(run_folder):
    shard = run_folder / "episodes" / "shard-000001.parquet"
    table = pq.read_table(shard)
    place = table.schema.get_field_index("log_weight")
    pq.write_table(table.set_column(place, "log_weight", table.column("log_weight").cast(pa.float32())), shard)
    with pytest.raises(RunFolderError, match="log_weight as double and float"):
        write_report(run_folder)


@pytest.mark.parametrize("text", ["{}", "testing: 5", "[]"])
def test_a_campaign_without_its_sections_is_named(run_folder, text):
    (run_folder / "campaign.yaml").write_text(text, encoding="utf-8")
    with pytest.raises(RunFolderError, match=r"campaign.yaml: found .*; expected a campaign"):
        write_report(run_folder)


@pytest.mark.parametrize("name", ["manifest.json", "estimates.json", "campaign.yaml"])
def test_a_missing_file_is_named_with_what_to_do(run_folder, name):
    (run_folder / name).unlink()
    with pytest.raises(RunFolderError, match=rf"{name}: found no such file") as caught:
        write_report(run_folder)
    assert caught.value.mend


@pytest.mark.parametrize("name", ["manifest.json", "estimates.json", "campaign.yaml"])
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
