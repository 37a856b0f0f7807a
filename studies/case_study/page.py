"""The page of a study: results of its steps beside the paper's numbers, and a verdict for each claim."""

from __future__ import annotations

import json
import re
from collections import Counter
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

from jinja2 import Environment, PackageLoader, StrictUndefined

from harness import numbers
from harness.errors import HarnessError
from harness.records.folder import write_bytes
from studies.case_study.figures import LOW_MEAN_WEIGHT, Verdict, is_settled, marked, range_of, verdict
from studies.case_study.plots import plots_of
from studies.case_study.study import Made, Study

UNSETTLED = "†"
PAGE, CLAIMS = "case_study.md", "claims.json"
_POWER = re.compile(r"([\d.]+)((?: \([^()]*\))?) × 10([⁻⁰¹²³⁴⁵⁶⁷⁸⁹]+)")


def write_page(study: Study, folder: Path, made: Mapping[str, Made]) -> Path:
    """Write ``case_study.md``, ``claims.json`` and ``plots/``; files that would not change are left as they are.

    Raises `HarnessError`: a claim or the picture asks for a figure that its step does not have.
    """
    claims = [_answered(claim.model_dump(), made, conclusive=study.conclusive) for claim in study.claims]
    plots = plots_of(study, made, {label: asked(line.ours, made) for label, line in study.picture.items()})
    for name, plot in plots.items():
        _write(folder / "plots" / f"{name}.png", plot.png)
    environment = Environment(
        loader=PackageLoader("studies.case_study", "."),
        autoescape=False,  # noqa: S701 - Markdown, of our own results
        undefined=StrictUndefined,
        trim_blocks=True,
        lstrip_blocks=True,
    )
    environment.filters.update(shown=shown, number=numbers.number, point=point, count=count, cell=cell, spans=spans)
    environment.filters["mark"] = lambda found, row: marked(found, settled=row["settled"])
    steps = [(name, step, made[name].result) for name, step in study.steps.items()]
    page = environment.get_template("case_study.md.j2").render(
        study=study,
        claims=claims,
        steps=steps,
        plots=plots,
        claim_rows=claim_rows,
        remarks=_remarks(claims),
        answers=dict(Counter(claim["verdict"] for claim in claims)),
        UNSETTLED=UNSETTLED,
        LOW_MEAN_WEIGHT=LOW_MEAN_WEIGHT,
    )
    answers = json.dumps({"conclusive": study.conclusive, "claims": claims}, indent=2, ensure_ascii=False)
    _write(folder / CLAIMS, f"{answers}\n".encode())
    _write(folder / PAGE, with_exponents(page).encode())
    return folder / PAGE


def _remarks(claims: list[dict[str, Any]]) -> dict[str, list[int]]:
    """Every remark once, with the numbers of its claims."""
    said = [claim["why"] for claim in claims]
    return {why: [n for n, one in enumerate(said, start=1) if one == why] for why in dict.fromkeys(said) if why}


def asked(path: str, made: Mapping[str, Made]) -> dict[str, Any]:
    """The figure of a step.

    Raises `HarnessError`: the step has no such figure.
    """
    name, _, key = path.partition(".")
    figures = made[name].result["figures"]
    if key not in figures:
        expected = f"one of {', '.join(figures) or 'none'}"
        mend = "Correct the name in the study; what is finished is kept."
        raise HarnessError(path, f"no figure '{key}' of the step {name}", expected, mend)
    found: dict[str, Any] = figures[key]
    return found


def _answered(claim: dict[str, Any], made: Mapping[str, Made], *, conclusive: bool) -> dict[str, Any]:
    """A claim with our number and the verdict; the reason of a difference only where there is one."""
    found = asked(claim["ours"], made)
    answer: Verdict = "ours to choose" if claim["ours_to_choose"] else "cannot be told"
    conclusive |= made[claim["ours"].partition(".")[0]].result["kind"] == "theorems"  # exact whatever the sizes
    if conclusive and not claim["ours_to_choose"]:
        answer = verdict(claim["paper"], found, **{key: claim[key] for key in ("within", "tolerance", "at_most")})
    return {**claim, "found": found, "verdict": answer, "why": "" if answer == "reproduced" else claim["why"]}


def shown(found: dict[str, Any]) -> str:
    """A figure with its interval, as the page has it, and its mark."""
    return _plainly(found) + _mark(found)


def point(found: dict[str, Any]) -> str:
    """A figure without its interval, with its mark."""
    return numbers.number(found["value"]) + _mark(found)


def _mark(found: dict[str, Any]) -> str:
    return "" if is_settled(found) else " " + UNSETTLED


def _plainly(found: dict[str, Any]) -> str:
    value, low, high = found["value"], found["low"], found["high"]
    if value is None:
        return "–" if low is None else f"above {numbers.number(low)}"
    if low == high:
        return count(value) if float(value).is_integer() and low is not None else numbers.number(value)
    if {numbers.number(end, like=value) for end in (low, high)} == {numbers.number(value)}:
        return numbers.number(value)
    if value == 0.0:
        return f"0 (to {numbers.number(high)})"
    if high is None:
        return f"at least {numbers.number(low)}"
    return numbers.interval(0.0 if low is None else low, high, value)


def count(value: float | None) -> str:
    """A whole number with all its digits up to a million, else three of them."""
    return numbers.count(value) if value is None or abs(value) < 1e6 else numbers.number(value)


def claim_rows(claims: list[dict[str, Any]], answer: Verdict) -> list[tuple[str, str, str, str]]:
    """Numbers, words, the paper's and our number, a row for each fact.

    Claims share a row that are the same fact, or of which but the last word and the paper's number differ.
    """
    groups: dict[Any, list[tuple[int, dict[str, Any]]]] = {}
    for number, claim in enumerate(claims, start=1):
        if claim["verdict"] == answer:
            key = claim["fact"] or (claim["says"].rpartition(" ")[0], shown(claim["found"]))
            groups.setdefault(key, []).append((number, claim))
    rows = []
    for group in groups.values():
        numbered, (first, *others) = [number for number, _ in group], [claim for _, claim in group]
        ends = [claim["says"].rpartition(" ")[2] for claim in others]
        says, paper = ", ".join([first["says"], *ends]), ", ".join(map(_asked_for, (first, *others)))
        here = shown(first["found"])
        if first["fact"]:
            says = first["fact"]
            least, *_, most = sorted([claim["paper"] for claim in (first, *others)] * 2)
            paper = f"{numbers.number(least)} to {numbers.number(most)}"
            here = shown(range_of([claim["found"] for claim in (first, *others)]))
        rows.append((spans(numbered), cell(says), paper, here))
    return rows


def _asked_for(claim: dict[str, Any]) -> str:
    """The paper's number, and what counts as the same where it is not a factor of 2."""
    paper = count(claim["paper"]) if float(claim["paper"]).is_integer() else numbers.number(claim["paper"])
    if claim["at_most"]:
        return f"≤ {paper}"
    if claim["tolerance"]:
        return f"{paper} ± {claim['tolerance']:.0e}"
    return paper if claim["within"] == 2.0 else f"{paper} (factor {claim['within']:g})"


def spans(of: Sequence[int]) -> str:
    """Rising numbers with a dash for neighbours, such as 13, 20–31."""
    first = [n for n in of if n - 1 not in of]
    last = [n for n in of if n + 1 not in of]
    return ", ".join(f"{a}–{b}" if a < b else str(a) for a, b in zip(first, last, strict=True))


def with_exponents(page: str) -> str:
    """``1.34 (1.33 to 1.36) × 10⁻⁷`` as ``1.34e-7 (1.33 to 1.36)``, as all pages of docs have it."""
    ascii_digits = str.maketrans("⁻⁰¹²³⁴⁵⁶⁷⁸⁹", "-0123456789")
    return _POWER.sub(lambda found: f"{found[1]}e{found[3].translate(ascii_digits)}{found[2]}", page)


def cell(text: str) -> str:
    """Text within a table of Markdown."""
    return text.replace("|", "\\|").replace("\n", " ").strip()


def _write(path: Path, content: bytes) -> None:
    if not path.is_file() or path.read_bytes() != content:
        path.parent.mkdir(exist_ok=True)
        write_bytes(path, content)
