"""Kinds of events that tests are made of, one package each; `protocol` says what a family brings."""

from __future__ import annotations

from harness.families.protocol import Family


def family_named(name: str) -> Family:
    """The family that a campaign names."""
    from harness.families.cut_in.family import CUT_IN  # noqa: PLC0415 - families are read when one is asked for

    return {each.name: each for each in (CUT_IN,)}[name]
