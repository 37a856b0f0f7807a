"""A run folder written from blocks of a chain, with the columns that estimates need and the real schemas' types."""

import json
from pathlib import Path

import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq

from harness.estimators.block import Block
from harness.records.folder import checksum
from harness.records.schemas import episodes_schema, moments_schema
from harness.vocabulary import OUTCOMES

CAMPAIGN = """
name: chain
environment:
  lane_change_level: 3.0
surrogates:
  one: {{model: idm}}
  two: {{model: fvdm}}
testing:
  method: {method}
stop:
  episodes: 100000
  confidence: 0.8
"""


def episodes_table(block: Block) -> pa.Table:
    """The rows of an ``episodes`` shard; columns that estimates do not read are left out."""
    n, m = block.log_q.shape
    index = block.first_episode + np.arange(n)
    columns = {
        "episode": pa.array(index),
        "outcome": pa.DictionaryArray.from_arrays(pa.array(block.outcome), pa.array(OUTCOMES)),
        "cut_in_step": pa.array(np.full(n, 7, dtype=np.int16), mask=~block.cut_in),
        "n_control_steps": pa.array(block.n_control_steps.astype(np.int16)),
        "log_weight": pa.array(block.log_weight),
        "log_p_cut_in": pa.array(block.log_p_cut_in) if "log_p_cut_in" in block.columns else pa.nulls(n, pa.float64()),
        "log_q": pa.array(block.log_q.tolist(), pa.list_(pa.float64(), m)),
    }
    schema = episodes_schema(m, 2)
    return pa.table(columns, schema=pa.schema([schema.field(name) for name in columns]))


def moments_table(block: Block) -> pa.Table:
    """Control steps of a ``moments`` shard under the policy ``first_9``, with q_sampled = 1/2 throughout."""
    ratios, steps = block.first_ratios, np.minimum(block.n_control_steps, 9)
    used = np.arange(9) < steps[:, None]
    q = 0.5 * ratios[used]
    columns = {
        "episode": pa.array(np.repeat(block.first_episode + np.arange(len(block)), steps)),
        "q_sampled": pa.array(np.full(len(q), 0.5)),
        "q": pa.FixedSizeListArray.from_arrays(pa.array(q.ravel()), q.shape[1]),
    }
    schema = moments_schema(q.shape[1])
    return pa.table(columns, schema=pa.schema([schema.field(name) for name in columns]))


def write_run(folder: Path, blocks: list[Block], *, with_moments: bool = True, **manifest: object) -> Path:
    """Write campaign, manifest and shards; extra keywords go into the manifest."""
    shards = []
    for index, block in enumerate(blocks):
        files = {"episodes": f"episodes/shard-{index:06d}.parquet"}
        tables = {"episodes": episodes_table(block)}
        if with_moments and "first_ratios" in block.columns:
            files["moments"] = f"moments/shard-{index:06d}.parquet"
            tables["moments"] = moments_table(block)
        for name, table in tables.items():
            (folder / name).mkdir(parents=True, exist_ok=True)
            pq.write_table(table, folder / files[name], compression="zstd")
        shards.append({"index": index, "first_episode": block.first_episode, "n_episodes": len(block), "files": files})
    (folder / "campaign.yaml").write_text(CAMPAIGN.format(method=blocks[0].drawn.method), encoding="utf-8")
    content = {"campaign_hash": "c0ffee", "n_episodes": sum(map(len, blocks)), "shards": shards, **manifest}
    content["campaign_crc32"] = checksum(folder / "campaign.yaml")
    (folder / "manifest.json").write_text(json.dumps(content), encoding="utf-8")
    return folder
