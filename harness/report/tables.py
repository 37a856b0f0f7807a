"""What the tables of the page say: rates in one power of ten, warnings, outcomes, settings with their meaning."""

from __future__ import annotations

from dataclasses import dataclass, fields
from typing import Any, NamedTuple

from pydantic import BaseModel

from harness.campaign.campaign import Campaign
from harness.campaign.files import written_out
from harness.estimators.shells import ShellDetails, Within
from harness.report.number_format import (
    MISSING,
    count,
    exponent_of,
    fixed,
    half_width,
    number,
    percent,
    power_of_ten,
    significant,
    value,
)
from harness.report.run_folder import RunFolder
from harness.report.summary import RunSummary
from harness.stopped_by import MENDS
from harness.vocabulary import OUTCOMES


@dataclass(frozen=True)
class RateUnit:
    """The power of ten in which a table writes its rates."""

    exponent: int

    @property
    def text(self) -> str:
        """`` × 10⁻⁷``, to follow the unit in the head of a column."""
        return f" × {power_of_ten(self.exponent)}" if self.exponent else ""

    def digits(self, rate: float, digits: int) -> str:
        """A rate with so many significant digits."""
        return significant(rate / 10.0**self.exponent, digits)

    def rate(self, rate: float | None) -> str:
        """A rate, by its own power of ten where this one would show no digit of it or too many."""
        if rate is None:
            return MISSING
        return fixed(rate, self.exponent, rate) if rate == 0.0 or self._fits(rate) else self._full(rate)

    def ends(self, low: float | None, high: float | None) -> str:
        """Both ends of an interval, with the decimals that the upper one needs."""
        if low is None or high is None:
            return MISSING
        if high == 0.0 or self._fits(high):
            return f"{fixed(low, self.exponent, high)} to {fixed(high, self.exponent, high)}"
        return f"{self._full(low)} to {self._full(high)}"

    def _fits(self, rate: float) -> bool:
        return 1e-2 <= rate / 10.0**self.exponent < 1e4

    def _full(self, rate: float) -> str:
        text = number(rate)
        return text if self.exponent == 0 or exponent_of(rate) != 0 else f"{text} × 10⁰"


def run_notes(run: RunFolder, summary: RunSummary) -> list[str]:
    """Return what the reader must know about this run as a whole."""
    notes = list(run.headline.warnings)
    n_tests, n_estimated = summary.n_episodes, run.estimates.n_episodes
    if n_estimated is not None and n_estimated not in (n_tests, n_tests - summary.n_failed):
        notes.append(
            f"The estimates cover {count(n_estimated)} tests but the records hold {count(n_tests)}: run "
            "harness estimate DIR --write."
        )
    target, rhw = run.campaign.stop.rhw, run.headline.rhw
    if run.asked_statement and run.shells is not None:
        rhw = next(each.rhw for each in run.shells.statements if each.name == run.asked_statement)
    if target is not None and (rhw is None or rhw > target):
        reached = "it is not known" if rhw is None else f"it is {half_width(rhw)}"
        mend = MENDS.get(run.manifest.get("stopped_by") or "")
        why = f" ({mend})" if mend else ""
        notes.append(f"The asked relative half-width of {target:g} was not reached: {reached}{why}.")
    if summary.n_failed:
        share = percent(summary.n_failed / n_tests)
        notes.append(
            f"{count(summary.n_failed)} of {count(n_tests)} tests failed ({share}). They are kept as rows and "
            "listed under Outcomes; a crash rate over the others is biased if failing and crashing go together."
        )
    return notes


def verdict(found: Within) -> str:
    """What the tests say about the assumption of a statement."""
    if found.refuted:
        return "refuted by these tests"
    if found.n_ahead:
        return "no longer justified: this vehicle does not keep to it"
    if found.n_checked:
        return "kept to in every test" + ("" if found.n_episodes_outside else ", none of them outside")
    return "no crash seen outside" if found.n_episodes_outside else "not put to the test"


def outcome_rows(summary: RunSummary) -> list[tuple[str, float, float, float]]:
    """Per outcome: name, tests, share of the tests, how often it happens per naturalistic test."""
    n = max(summary.n_episodes, 1)
    counted = zip(OUTCOMES, summary.count.tolist(), summary.weight.tolist(), strict=True)
    return [(name, tests, tests / n, summary.per_test(weight)) for name, tests, weight in counted]


def diagnostics(run: RunFolder) -> list[tuple[str, Any]]:
    """Return sums of the run as (key, value); of shells without those about weights, which have none to say."""
    leaves = flat(run.estimates.diagnostics or {})
    return leaves if run.shells is None else [(path, leaf) for path, leaf in leaves if leaf not in (None, {})]


def details(run: RunFolder) -> list[tuple[str, Any]]:
    """Return what single estimators report about themselves and no other section shows, as (estimator.key, value)."""
    in_section = {entry.name for entry in fields(ShellDetails)}
    found = {
        name: {key: content for key, content in e.details.items() if name != "shells" or key not in in_section}
        for name, e in run.estimates.estimates.items()
        if e.details
    }
    return flat(found)


def flat(content: Any, path: str = "") -> list[tuple[str, Any]]:
    """Leaves of nested mappings as (dotted path, value), in order; none of an empty one."""
    if isinstance(content, dict) and (content or not path):
        return [leaf for key, part in content.items() for leaf in flat(part, f"{path}.{key}" if path else str(key))]
    return [(path, content)]


class Setting(NamedTuple):
    """One setting: its path inside the section, its value as text, and what it means."""

    path: str
    value: str
    meaning: str


def setting_sections(campaign: Campaign, *, reproducible: bool | None = None) -> list[tuple[str, list[Setting]]]:
    """Settings by top-level key, as in the file; scalars come first, as ``campaign``, with what the manifest adds."""
    meanings, content = dict(_described(campaign, "")), written_out(campaign)
    top = _settings({key: part for key, part in content.items() if not isinstance(part, dict)}, "", meanings)
    if reproducible is not None:
        top.append(Setting("reproducible", value(reproducible), "whether an episode runs again bit for bit (manifest)"))
    parts = [(key, _settings(part, f"{key}.", meanings)) for key, part in content.items() if isinstance(part, dict)]
    return [("campaign", top), *((title, settings) for title, settings in parts if settings)]


def _settings(content: dict[str, Any], prefix: str, meanings: dict[str, str]) -> list[Setting]:
    return [Setting(path, value(leaf), meanings.get(prefix + path, "")) for path, leaf in flat(content)]


def _described(content: Any, path: str) -> list[tuple[str, str]]:
    """Follow the validated instances, not the schema, so that the chosen driver model decides what a name means."""
    found: list[tuple[str, str]] = []
    if isinstance(content, BaseModel):
        for name, info in type(content).model_fields.items():
            inner = f"{path}.{name}" if path else name
            found.append((inner, info.description or ""))
            found += _described(getattr(content, name), inner)
    elif isinstance(content, dict):
        for name, part in content.items():
            found += _described(part, f"{path}.{name}")
    return found
