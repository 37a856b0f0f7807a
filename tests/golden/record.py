"""What is compared of golden runs, and how it is recorded: ``python -m tests.golden.record``.

Recording again is allowed where a release means to change bits (another law of traffic, another random stream, another
estimate), and its changelog says so. It is never allowed in a change of structure: there a golden run that differs
shows a mistake.
"""

from __future__ import annotations

import argparse
import hashlib
import json
import math
import sys
import tempfile
from collections.abc import Iterable
from pathlib import Path
from typing import Any

import numpy as np
import pyarrow as pa
import pyarrow.compute as pc
import pyarrow.parquet as pq

import harness
from tests.golden.campaigns import BASE, COMPARED, RUNS
from tests.in_process import controllers_here, one_process, run_here, without_page

GOLDEN = Path(__file__).parent / "golden.json"
TABLES = {"episodes": ["episode"], "moments": ["episode", "step"], "traces": ["episode", "step"], "shadow": ["shadow"]}
"""By what each is sorted; vehicles of a step keep their order."""
LEFT_OUT = {"diagnostics.alarm", "severity", "crc32", "traffic", "estimates.scv.details.gain"}
NOTES = {"warnings", "cautions", "unmet", "failure"}
"""Of estimates.json: what features of earlier and later days wrote; its checksum, which is of words, too; and what few
degrees of freedom leave of a variance, which rounding shows in (tests/estimators/test_scv.py has it). Notes repeat
numbers that are compared."""
WORDLESS_TYPES = bool, int, float, type(None)


def load(*overrides: str) -> Any:
    """A golden campaign."""
    return harness.load_campaign(BASE, overrides)


def compare(out: Path) -> Path:
    """Run the golden comparison, in this process."""
    shared, other = COMPARED
    with one_process(), controllers_here(), without_page():
        harness.compare(load(*shared), load(*shared, other), out, workers=1)
    return out


def column_hash(column: pa.Array | pa.ChunkedArray) -> str:
    """Of type and bits; null is not zero, and a dictionary is what it stands for."""
    column = column.combine_chunks() if isinstance(column, pa.ChunkedArray) else column
    digest = hashlib.sha256(str(column.type).encode())
    _feed(digest, column)
    return digest.hexdigest()[:10]


def _feed(digest: Any, column: pa.Array) -> None:
    if pa.types.is_dictionary(column.type):
        column = column.cast(column.type.value_type)
    digest.update(column.is_null().to_numpy(zero_copy_only=False).tobytes())
    if pa.types.is_list(column.type) or pa.types.is_fixed_size_list(column.type):
        digest.update(pc.fill_null(pc.list_value_length(column), 0).to_numpy(zero_copy_only=False).tobytes())
        _feed(digest, column.flatten())
    elif pa.types.is_floating(column.type) or pa.types.is_integer(column.type):
        digest.update(pc.fill_null(column, 0).to_numpy(zero_copy_only=False).tobytes())
    else:
        coded = column.dictionary_encode("encode")
        words = np.array([json.dumps(word) for word in coded.dictionary.to_pylist()], object)
        digest.update(f"[{', '.join(words[coded.indices.to_numpy()])}]".encode())


def tables_of(folder: Path) -> dict[str, dict[str, Any]]:
    """Hash of each column of the folder's tables, sorted by their index, by table."""
    found = {}
    for name, keys in TABLES.items():
        if files := sorted((folder / name).glob("*.parquet")):
            rows = pa.concat_tables([pq.read_table(file, partitioning=None) for file in files]).combine_chunks()
            rows = rows.take(pc.sort_indices(rows.select(keys), [(key, "ascending") for key in keys]))
            columns = {column: column_hash(rows[column]) for column in rows.column_names}
            found[name] = {"rows": rows.num_rows, **columns}
    return found


def numbers_of(content: Any, path: str = "") -> dict[str, Any]:
    """Numbers, truth values and nulls of a JSON document by their paths: no words, and no key of a pool."""
    items = content.items() if isinstance(content, dict) else enumerate(content)
    found: dict[str, Any] = {}
    for key, value in items:
        here = f"{path}.{key}" if path else str(key)
        if here in LEFT_OUT or key in NOTES:
            continue
        if isinstance(value, dict | list):
            found |= numbers_of(value, here)
        elif isinstance(value, WORDLESS_TYPES):
            found[here] = value
    return found


def seen_in(folder: Path) -> dict[str, Any]:
    """What is compared of a run folder."""
    estimates = json.loads((folder / "estimates.json").read_text())
    return {"campaign_hash": estimates["campaign_hash"], **tables_of(folder), "estimates": numbers_of(estimates)}


def seen_in_comparison(folder: Path) -> dict[str, Any]:
    """What is compared of a comparison."""
    content = json.loads((folder / "compare.json").read_text())
    return {"compare": numbers_of(content), **{side: seen_in(folder / side) for side in "ab"}}


def unlike(found: Any, golden: Any, path: str = "", *, digits: float = 0.0) -> list[str]:
    """Where two such trees differ in any bit or type; estimates may differ by so many relative ``digits``.

    BLAS adds up in an order of the CPU family's own. Records know no BLAS: these are hashes, equal or not.
    """
    if isinstance(found, dict) and isinstance(golden, dict):
        keys = sorted(found.keys() | golden.keys())
        missing = [
            f"{path}/{key}: {'new' if key in found else 'gone'}" for key in keys if (key in found) != (key in golden)
        ]
        both = [
            line
            for key in keys
            if key in found and key in golden
            for line in unlike(found[key], golden[key], f"{path}/{key}", digits=digits)
        ]
        return missing + both
    same = type(found) is type(golden) and repr(found) == repr(golden)
    if isinstance(found, float) and isinstance(golden, float):
        same |= math.isclose(found, golden, rel_tol=digits, abs_tol=digits * 1e-12)
    return [] if same else [f"{path}: {found!r}, was {golden!r}"]


def record(names: Iterable[str], workers: int | None = None) -> dict[str, Any]:
    """Golden runs as they are now: in this process, or by ``workers`` that are processes."""
    found = {}
    for name in names:
        with tempfile.TemporaryDirectory() as folder, without_page():
            if workers is None:
                run_here(load(*RUNS[name]), Path(folder))
            else:
                harness.run(load(*RUNS[name]), folder, workers=workers)
            found[name] = seen_in(Path(folder))
    return found


def main() -> int:
    """Record, or only look."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--processes", type=int, help="record nothing: do so many workers give the same?")
    parser.add_argument("--only", nargs="+", choices=RUNS, help="record nothing: are these the same?")
    parser.add_argument("--digits", type=float, default=0.0, help="how far estimates may be off, relatively")
    asked = parser.parse_args()
    runs = record(asked.only or RUNS, asked.processes)
    if asked.only or asked.processes:
        golden = json.loads(GOLDEN.read_text())["runs"]
        differences = unlike(json.loads(json.dumps(runs)), {name: golden[name] for name in runs}, digits=asked.digits)
        sys.stdout.writelines(f"{line}\n" for line in differences)
        return bool(differences)
    with tempfile.TemporaryDirectory() as folder:
        compared = seen_in_comparison(compare(Path(folder) / "compared"))
    GOLDEN.write_text(json.dumps({"runs": runs, "compared": compared}, indent=0) + "\n")
    return 0


if __name__ == "__main__":
    sys.exit(main())
