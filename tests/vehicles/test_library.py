"""A library says what is wrong with it."""

from __future__ import annotations

from pathlib import Path

import pytest

from harness.errors import CampaignError
from harness.vehicles.library import SHIPPED_FOLDER, load_library

SHIPPED = (SHIPPED_FOLDER / "ladder-1.yaml").read_text(encoding="utf-8")


@pytest.mark.parametrize(
    ("old", "new", "complaint"),
    [
        ("boundary: brakes-2-late-1s", "boundary: brakes-2-late", "Did you mean 'brakes-2-late-1s'"),
        ("boundary: brakes-2-late-1s", "boundary: full-throttle-2", "which is the envelope"),
        ("envelope: full-throttle-2", "envelope: brakes-3", "expected constant"),
        ("envelope: full-throttle-2", "envelope: never-brakes", "less than"),
        ("delay_s: 0.7", "delay_s: 0.75", "multiple of the 0.1 s step"),
        ("delay_s: 0.7", "inattention_probability: 0.7", "unknown key"),
        ("model: constant, parameters: {acceleration_mps2: 0.0}", "model: constnt", "Did you mean .constant."),
    ],
)
def test_mistakes_are_named(tmp_path: Path, old: str, new: str, complaint: str):
    assert old in SHIPPED
    file = tmp_path / "mine.yaml"
    file.write_text(SHIPPED.replace(old, new), encoding="utf-8")
    with pytest.raises(CampaignError, match=complaint):
        load_library(str(file))
