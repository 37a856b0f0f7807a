"""What a comparison says, in words, from the numbers of ``compare.json``."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from typing import Any

from harness.numbers import count, duration, share, two_digits_up
from harness.report.notes import note_words
from harness.report.words import unseen_words
from harness.strata import LIBRARY_STATEMENT


def pair_words(decision: Mapping[str, Any]) -> str:
    """What is known of who crashes less often (``decision`` in ``compare.json``)."""
    margin, verdict = decision["margin"], decision["verdict"]
    if not margin:
        told = {"proven": "B crashes less often than A", "refuted": "B crashes more often than A"}
        return told.get(verdict, "Not told apart")
    most = share(margin)
    told = {"proven": f"B is at most {most} worse than A", "refuted": f"B is more than {most} worse than A"}
    return told.get(verdict, f"Open whether B is more than {most} worse than A")


def pair_warnings(content: Mapping[str, Any]) -> Iterator[str]:
    """What changes the meaning of a comparison (``compare.json``)."""
    sides = {name: content[name.lower()] for name in "AB"}
    for name, of in sides.items():
        if n := of["details"]["n_failed"]:
            yield f"{count(n)} tests of {name} FAILED"
    for name, of in sides.items():
        yield from (f"{name}: {note_words(each)}" for each in of["warnings"])
    if where := content.get("unseen"):
        yield unseen_words(where)


def deciding_words(content: Mapping[str, Any], s_per_pair: float | None = None) -> str | None:
    """What would decide a comparison (``compare.json``) that was left open, and its cost; None of a decided one."""
    if content["decision"]["verdict"] != "open":
        return None
    if (needed := content["to_decide"]) is None:
        return "how many pairs would decide is not known: so far the two are too alike"
    where, done = (" and a new --out", 0) if needed["new_folder"] else ("", content["n_pairs"])
    n = two_digits_up(needed["pairs"] - done)
    cost = "" if s_per_pair is None else f", {duration(n * s_per_pair)}"
    settings = "".join(f" --set {key}={value}" for key, value in needed["settings"].items())
    options = f"--margin {content['decision']['margin']:g}{settings}"
    return f"to decide, repeat the command with {options}{where}: some {count(n)} more pairs{cost}"


def pair_asked(content: Mapping[str, Any]) -> Mapping[str, Any]:
    """What lies between A and B under the statement that the comparison (``compare.json``) was asked for."""
    given = content.get("asked") == LIBRARY_STATEMENT and not content["conditional"].get("refuted")
    asked: Mapping[str, Any] = content["conditional"] if given else content
    return asked
