"""Environments with tables in place of formulas."""

import copy
from pathlib import Path
from typing import Any

import pyarrow as pa
import pyarrow.parquet as pq

from harness.campaign.models import read_model
from harness.campaign.yaml_text import read_yaml
from harness.families.cut_in.parameters import SHIPPED_FOLDER, EnvironmentParameters
from harness.families.cut_in.sections import REPLACED
from harness.files import content_hash
from harness.records.reader import OF_REPLICATES

SHIPPED = SHIPPED_FOLDER / "ndd-overtaking-1.yaml"
DATA, _ = read_yaml(SHIPPED)
TEXT = SHIPPED.read_text()


def fitted(folder: Path, text: str = TEXT, **columns: list[float]) -> str:
    """File of an environment, given as text, with replicates."""
    file, rows = folder / "mine.yaml", folder / "replicates.parquet"
    file.write_text(text)
    of = read_model(file, EnvironmentParameters).content_hash()
    pq.write_table(pa.table(columns, metadata={OF_REPLICATES: of}), rows)
    tied = f"{{file: replicates.parquet, sha256: '{content_hash(rows.read_bytes())}'}}"
    file.write_text(text.replace("version: 1\n", f"version: 1\nreplicates: {tied}\n", 1))
    return str(file)


def of(values, **more):
    return [{"value": float(value), "source": "fitted", **more} for value in values]


def tabled(**changes: Any) -> dict[str, Any]:
    """The paper's numbers with tables: a wish by three knots each, and six steps of acceptance."""
    content = copy.deepcopy(DATA)
    for name in [each for names in REPLACED.values() for each in names]:
        del content["cut_in"][name]
    knots = {"v_mps": [20.0, 30.0, 40.0], "r1_m": [0.0, 20.0, 110.0], "r1dot_mps": [-8.0, 0.0, 8.0]}
    logs = {"v_log": [-8.0, -9.0, -8.0], "r1_log": [0.0, -2.0, -3.5], "r1dot_log": [1.0, 0.0, 1.5]}
    content["hazard_table"] = {name: of(values) for name, values in (knots | logs).items()}
    steps = {"ttc_s": of([1.0, 2.0, 3.0, 5.0, 8.0]), "share": of([0.01, 0.02, 0.03, 0.1, 0.5, 1.0], se=0.1)}
    content["acceptance_steps"] = {**steps, "events": [0, 0, 1, 2, 9, 90], "exposure": [30.0] * 6}
    for path, value in changes.items():
        section, name = path.split("__")
        content[section][name] = value
    return content
