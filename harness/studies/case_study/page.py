"""The page of a study: results of its steps beside the paper's numbers, and a verdict for each claim."""

from __future__ import annotations

import json
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import matplotlib.style
from jinja2 import Environment, PackageLoader, StrictUndefined

from harness.errors import HarnessError
from harness.records.folder import write_bytes
from harness.report import number_format
from harness.report.plot_style import RC, png
from harness.studies.case_study.context import Made
from harness.studies.case_study.figures import Verdict, verdict
from harness.studies.case_study.plots import plots_of
from harness.studies.case_study.study_file import Study

PAGE, CLAIMS = "case_study.md", "claims.json"


def write_page(study: Study, folder: Path, made: Mapping[str, Made]) -> tuple[Path, list[dict[str, Any]]]:
    """Write ``case_study.md``, ``claims.json`` and ``plots/``; files that would not change are left as they are.

    Returned are the page, and the content of ``claims.json``.

    Raises
    ------
    HarnessError
        A claim or the picture asks for a figure that its step does not have.
    """
    claims = [_answered(claim.model_dump(), made, conclusive=study.conclusive) for claim in study.claims]
    with matplotlib.style.context(["default", RC]):
        plots = plots_of(study, made, {label: asked(path, made) for label, path in study.picture.items()})
        for plot in plots.values():
            _write(folder / "plots" / f"{plot.name}.png", png(plot))
    environment = Environment(
        loader=PackageLoader("harness.studies.case_study", "."),
        autoescape=False,  # noqa: S701 - Markdown, of our own results
        undefined=StrictUndefined,
        trim_blocks=True,
        lstrip_blocks=True,
    )
    environment.filters.update(shown=shown, number=number_format.number, count=count, cell=cell)
    steps = [(name, step, made[name].result) for name, step in study.steps.items()]
    page = environment.get_template("case_study.md.j2").render(
        study=study, claims=claims, steps=steps, plots=plots, figure=lambda path: asked(path, made)
    )
    _write(folder / CLAIMS, json.dumps(claims, indent=2, ensure_ascii=False).encode("utf-8") + b"\n")
    _write(folder / PAGE, page.encode("utf-8"))
    return folder / PAGE, claims


def asked(path: str, made: Mapping[str, Made]) -> dict[str, Any]:
    """The figure of a step.

    Raises
    ------
    HarnessError
        The step has no such figure.
    """
    name, _, key = path.partition(".")
    figures = made[name].result["figures"]
    if key not in figures:
        raise HarnessError(
            path,
            found=f"no figure '{key}' of the step {name}",
            expected=f"one of {', '.join(figures) or 'none'}",
            mend="Correct the name in the study; what is finished is kept.",
        )
    found: dict[str, Any] = figures[key]
    return found


def _answered(claim: dict[str, Any], made: Mapping[str, Made], *, conclusive: bool) -> dict[str, Any]:
    """A claim with our number and the verdict; the reason of a difference only where there is one."""
    found = asked(claim["ours"], made)
    answer: Verdict = "cannot be told"
    if conclusive:
        answer = verdict(claim["paper"], found, **{key: claim[key] for key in ("within", "tolerance", "at_most")})
    return {**claim, "found": found, "verdict": answer, "why": claim["why"] if answer == "not reproduced" else ""}


def shown(found: dict[str, Any]) -> str:
    """A figure with its interval, as the page has it."""
    value, low, high = found["value"], found["low"], found["high"]
    if value is None:
        return "–" if low is None else f"above {number_format.number(low)}"
    if low is None and high is None:
        return number_format.number(value)
    if low == high:
        return count(value) if float(value).is_integer() else number_format.number(value)
    if value == 0.0:
        return f"0 (to {number_format.number(high)})"
    if high is None:
        return f"at least {number_format.number(low)}"
    return number_format.with_interval(value, 0.0 if low is None else low, high)


def count(value: float | None) -> str:
    """A whole number with all its digits up to a million, else three of them."""
    return number_format.count(value) if value is None or abs(value) < 1e6 else number_format.number(value)


def cell(text: str) -> str:
    """Text within a table of Markdown."""
    return text.replace("|", "\\|").replace("\n", " ").strip()


def _write(path: Path, content: bytes) -> None:
    if not path.is_file() or path.read_bytes() != content:
        path.parent.mkdir(exist_ok=True)
        write_bytes(path, content)
