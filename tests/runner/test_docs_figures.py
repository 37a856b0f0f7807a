"""The weights of `harness.read` give the rate of every method, as docs/records.md has it."""

from __future__ import annotations

import re
from pathlib import Path

import numpy as np
import pytest

import harness
from tests.stored_runs import estimates

DOCS = Path(__file__).parents[2] / "docs"
ESTIMATOR = {"shells-twin": "shells", "nde-twin": "nde"}
LINES = "\n".join(re.findall(r"^```python\n(.*?)^```$", (DOCS / "records.md").read_text(), re.MULTILINE | re.DOTALL))


@pytest.mark.parametrize("name", ["shells-twin", "forced-twin", "nde-twin", "step-recursive-twin", "mixture-twin"])
def test_the_weights_give_the_rate_of_every_method(name, stored_run, capsys):
    folder = stored_run(name)
    rate = estimates(folder)["estimates"][ESTIMATOR.get(name, "nade")]["crash_rate"]
    assert rate > 0.0
    tests = harness.read(folder).episodes(["outcome", "log_weight"])
    crash = tests.outcome == "crash"
    assert (tests.weight * crash).mean() == pytest.approx(rate, rel=1e-9)
    plain = (np.exp(tests.log_weight) * crash).mean()
    assert (plain == pytest.approx(rate, rel=1e-9)) == (name != "shells-twin")
    exec(LINES.replace("runs/hard-braking", str(folder)), {})
    assert float(capsys.readouterr().out.split()[-1]) == pytest.approx(rate, rel=1e-9)
