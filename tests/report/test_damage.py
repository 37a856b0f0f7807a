"""A damaged or foreign file is one error that names it, with exit code 2, and nothing is written."""

from __future__ import annotations

import json
import re
from pathlib import Path

import pyarrow as pa
import pyarrow.parquet as pq
import pytest

from harness.errors import RunFolderError
from harness.report.page import write_report
from tests.stored_runs import truncate

SHARDS = [f"{table}/shard-000001.parquet" for table in ("episodes", "moments", "traces")]
FILES = ["manifest.json", "estimates.json", "campaign.yaml"]


def pages_broken(path: Path) -> None:
    """A shard with a good footer."""
    content = bytearray(path.read_bytes())
    middle = slice(len(content) // 4, len(content) // 2)
    content[middle] = bytes(b ^ 0xFF for b in content[middle])
    path.write_bytes(bytes(content))


def holding(text: str):
    return lambda path: path.write_text(text, encoding="utf-8")


def rewritten(change):
    return lambda path: pq.write_table(change(pq.read_table(path)), path)


def of_unknown_outcome(table: pa.Table) -> pa.Table:
    place = table.schema.get_field_index("outcome")
    values = pa.array(["flew away"] * 1000, table.column("outcome").type)
    return table.set_column(place, table.schema.field(place), values)


def edited(**changes):
    return lambda path: path.write_text(json.dumps(json.loads(path.read_text()) | changes))


POINT_WITHOUT_RATE = {"n": 1, "ci_low": 0, "ci_high": 1, "rhw": 1}  # which must not be drawn as zero
DAMAGES = [
    *((shard, damage, re.escape(shard)) for shard in SHARDS for damage in (truncate, Path.unlink)),
    *((shard, pages_broken, re.escape(shard)) for shard in (SHARDS[0], SHARDS[2])),
    *((file, damage, file) for file in FILES for damage in (Path.unlink, *map(holding, ("{broken", "[]", "\x00")))),
    *(("campaign.yaml", holding(text), "expected a campaign") for text in ("{}", "testing: 5")),
    (SHARDS[0], rewritten(lambda table: table.slice(0, 990)), "found 990 rows; expected 1000 rows"),
    (SHARDS[0], rewritten(lambda table: table.drop_columns(["log_weight"])), "no column 'log_weight'"),
    (SHARDS[0], rewritten(of_unknown_outcome), "flew away"),
    ("estimates.json", edited(campaign_hash="feedfeedfeedfeed"), "feedfeedfeedfeed"),
    ("estimates.json", edited(headline="oracle"), "oracle"),
    ("estimates.json", edited(convergence=[POINT_WITHOUT_RATE]), r"convergence\.0\.crash_rate"),
    ("manifest.json", edited(shards=[{"index": 0, "first_episode": 0, "n_episodes": 1}]), "manifest.json"),
]


@pytest.mark.parametrize(("file", "damage", "said"), DAMAGES)
def test_what_no_run_has_written_is_named(run_folder, file, damage, said):
    damage(run_folder / file)
    (run_folder / "report.html").write_text("of an earlier report")
    with pytest.raises(RunFolderError, match=said) as caught:
        write_report(run_folder)
    assert caught.value.exit_code == 2
    assert caught.value.mend
    assert (run_folder / "report.html").read_text() == "of an earlier report"
