"""The weights of `harness.read` give the rate of every method, as docs/records.md has it."""

from __future__ import annotations

import re
from pathlib import Path

import numpy as np
import pytest

import harness
from tests.runner.test_shells_runs import SHELLS

DOCS = Path(__file__).parents[2] / "docs"
TWIN = ("world.engine=twin", "records.traces=none", "records.trace_share=0", "records.moments=none")
METHODS = {
    "shells": SHELLS,
    "forced": ("testing.method=forced", "stop.episodes=1600"),
    "nde": ("testing.method=nde", "environment.lane_change_level=1e4", "stop.episodes=8000", "run.shard_size=4000"),
    "step_mixture": ("testing.method=step_mixture", "stop.episodes=400"),
    "episode_mixture": ("testing.method=episode_mixture", "stop.episodes=400"),
}
MEAN = {"shells": "shells", "nde": "nde"}


LINES = "\n".join(re.findall(r"^```python\n(.*?)^```$", (DOCS / "records.md").read_text(), re.MULTILINE | re.DOTALL))


@pytest.mark.parametrize("method", METHODS)
def test_the_weights_give_the_rate_of_every_method(method, campaign, run_here, tmp_path, capsys):
    result = run_here(campaign(*METHODS[method], *TWIN), tmp_path / "run")
    rate = result.estimates["estimates"][MEAN.get(method, "nade")]["crash_rate"]
    assert rate > 0.0
    tests = harness.read(result.folder).episodes(["outcome", "log_weight"])
    crash = tests.outcome == "crash"
    assert (tests.weight * crash).mean() == pytest.approx(rate, rel=1e-9)
    plain = (np.exp(tests.log_weight) * crash).mean()
    assert (plain == pytest.approx(rate, rel=1e-9)) == (method != "shells")
    exec(LINES.replace("runs/hard-braking", str(result.folder)), {})
    assert float(capsys.readouterr().out.split()[-1]) == pytest.approx(rate, rel=1e-9)
