"""Kinds of events that tests are made of, one package each; `protocol` says what a family brings.

The core knows families by this file alone. An installed package brings its own as an entry point of the group
``harness.families``: a name, and the object that answers `Family`.
"""

from __future__ import annotations

import re
from functools import cache
from importlib.metadata import entry_points
from typing import TYPE_CHECKING

from harness.errors import CampaignError
from harness.problems import did_you_mean, listed, nearest

if TYPE_CHECKING:
    from collections.abc import Sequence

    from harness.families.protocol import Family

R157 = ("cut_in", "lead_brakes", "cut_out")
"""Scenarios of UN Regulation No. 157."""
GROUP = "harness.families"


@cache
def families() -> dict[str, Family]:
    """All installed families by name."""
    from harness.families.cut_in.family import CUT_IN  # noqa: PLC0415 - families are read when one is asked for
    from harness.families.cut_out.family import CUT_OUT  # noqa: PLC0415
    from harness.families.lead_brakes.family import LEAD_BRAKES  # noqa: PLC0415

    shipped: tuple[Family, ...] = CUT_IN, LEAD_BRAKES, CUT_OUT
    return {each.name: each.load() for each in entry_points(group=GROUP)} | {each.name: each for each in shipped}


def family_named(name: str, where: str = "scenario", more: Sequence[str] = ()) -> Family:
    """The family that a campaign names; ``more`` is what might have been named instead.

    Raises `CampaignError`: none has that name.
    """
    installed = families()
    if name not in installed:
        names = [*installed, *more]
        mend = did_you_mean(name, names) or "Write one of them, or install the package that brings it."
        if where.startswith("--") and "?" in mend:
            mend = f"Write {re.sub(r'[^ =,]+', lambda word: nearest(word[0], names) or word[0], where)}."
        elif name == "all":
            mend = f"Write scenarios: [{', '.join(R157)}], or --scenario all."
        raise CampaignError(where, f"'{name}'", f"a kind of events: {listed(names)}", mend)
    return installed[name]
