"""The page of a fit: data beside the fitted laws, and numbers with standard errors."""

from __future__ import annotations

import math
from collections.abc import Iterator, Sequence
from dataclasses import dataclass

import numpy as np
from scipy import special, stats

from harness import numbers
from harness.campaign.models import read_model
from harness.campaign.sections import EnvironmentSettings
from harness.errors import printable
from harness.estimators.limits import garwood
from harness.families.cut_in.fitting.hazard import TTC_EDGES_S, Acceptance, Hazard
from harness.families.cut_in.fitting.laws import BASE, FittedLaw, ObservedTraffic, bins
from harness.families.cut_in.fitting.observations import BesideCounts
from harness.families.cut_in.laws import CAR_FOLLOWING, FREE_DRIVING, Environment, InitialStates
from harness.families.cut_in.loading import evaluate_laws, load_environment
from harness.families.cut_in.parameters import SHIPPED_FOLDER, EnvironmentParameters
from harness.families.cut_in.sections import HAZARD_OF
from harness.families.cut_in.vocabulary import ACCELERATIONS_MPS2, N_ACCELERATIONS
from harness.fitting.protocol import FitRequest
from harness.numbers import number
from harness.report.drawing import Plot, PlotAxis, PlotPanel
from harness.report.templates import templates
from harness.vocabulary import FloatArray, IntArray, RecordArray

CONFIDENCE = 0.9
SHIPPED = {"ndd-overtaking-1": "muted", "ndd-overtaking-2": "vermillion"}
"""Environments drawn for comparison, and their colours."""
BIN_NAMES = ("0–1", "1–2", "2–3", "3–5", "5–8", "> 8")
MOST_ROWS = 20_000
_SEED = 1


@dataclass(frozen=True, eq=False)
class Fit:
    """Fitted traffic: ``environment`` is the result, ``laws`` has the hazard's, too.

    Numbers that are not fitted are those of ``base``; ``kept`` says why a law is kept from it, by its subject.
    """

    traffic: ObservedTraffic
    base: EnvironmentParameters
    laws: dict[str, FittedLaw]
    kept: dict[str, str]
    hazard: Hazard
    acceptance: Acceptance
    environment: EnvironmentParameters


def page(fit: Fit, tally: BesideCounts, noise_mps2: float, request: FitRequest, others: Sequence[str]) -> str:
    """The page; ``noise_mps2`` is the sd of accelerations by measurement, ``others`` is what other families found."""
    template = templates(__package__).get_template("fit.html.j2")
    html = template.render(
        fit=fit, tally=tally, asked=request, plots=list(_plots(fit)), bins=list(_bins(fit)),
        numbers=list(_numbers(fit)), noise_mps2=noise_mps2, others=others, base=BASE,
    )  # fmt: skip
    return printable(html)


def _numbers(fit: Fit) -> Iterator[tuple[str | bool, ...]]:
    """Name, value, standard error, the base's value, distance from it in standard errors, whether it is unknown."""
    base, fitted = fit.base.values(), fit.environment.numbers()
    for path, entry in fitted.items():
        if entry.se is None or path.startswith(("hazard_table", "acceptance_steps")):
            continue
        base_value = base[path]
        away = (entry.value - base_value) / entry.se if entry.se > 0.0 else math.nan
        values = number(entry.value), number(entry.se, 2), number(base_value), f"{away:+.1f}"
        yield (path.replace("__", "."), *values, entry.se > max(abs(entry.value), abs(base_value)))


def _bins(fit: Fit) -> Iterator[tuple[str, int, str, str, str]]:
    """Per bin of time to collision: its name, lane changes seen and expected, their ratio, and its limits."""
    steps = fit.acceptance
    low, high = _limits(steps.events, steps.exposure)
    for name, events, *row in zip(BIN_NAMES, steps.events, steps.exposure, steps.shares, low, high, strict=True):
        exposure, *shares = (number(float(each), 2) for each in row)
        yield name, int(events), exposure, shares[0], " to ".join(shares[1:])


def _limits(events: FloatArray | IntArray, exposure: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Limits of rates (n,), events over exposure, each by itself."""
    low, high = garwood(events, 0.5 - 0.5 * CONFIDENCE)
    per = np.maximum(exposure, 1e-12)
    return low / per, high / per


def _plots(fit: Fit) -> Iterator[Plot]:
    yield _acceptance_plot(fit)
    yield _hazard_plot(fit)
    traffic = load_environment(EnvironmentSettings(), fit.environment)
    if fit.traffic.initial.size:
        yield _initial_plot(fit, traffic)
    accelerations = [(fit.traffic.free, "Free driving"), (fit.traffic.following, "Behind a leader")]
    panels = [_acceleration_panel(rows, title, traffic) for rows, title in accelerations if rows.size]
    if panels:
        caption = "The law draws every second independently; real drivers persist, so that simulated ones are steadier."
        yield Plot("accelerations", panels, "Accelerations seen and by the law.", caption)
    if (lead := fit.laws.get("lead")) is not None:
        yield _lead_plot(fit, lead.estimate["lateral__speed_log_sd"])


def _histogram(values: FloatArray, edges: FloatArray) -> FloatArray:
    return np.asarray(np.histogram(values, edges)[0] / max(values.size, 1) / np.diff(edges))


def _beside(
    title: str,
    label: str,
    y: PlotAxis,
    edges: FloatArray,
    seen: FloatArray,
    law: tuple[FloatArray, FloatArray],
    words: tuple[str, str] = ("seen", "law"),
) -> PlotPanel:
    """A histogram ``seen`` (n,) between edges (n + 1,), and the line of a ``law``: points on the axis, and values."""
    panel = PlotPanel(title, PlotAxis(label, float(edges[0]), float(edges[-1])), y)
    points, line = law
    low = np.full(seen.size, y.low)
    panel.add("boxes", "blue", edges[:-1], edges[1:], low, np.maximum(seen, low), opacity=0.3, label=words[0])
    panel.add("line", "vermillion", points, np.maximum(line, y.low), label=words[1])
    return panel


def _add_limits(panel: PlotPanel, edges: FloatArray, low: FloatArray, high: FloatArray, label: str) -> None:
    """Limits (n,) between edges (n + 1,), as far as they are within the panel."""
    low, high = (np.clip(each, panel.y.low, panel.y.high) for each in (low, high))
    panel.add("boxes", "blue", edges[:-1], edges[1:], low, high, opacity=0.18, label=label)


def _density(*curves: FloatArray) -> PlotAxis:
    return PlotAxis("density", 0.0, 1.15 * max(float(each.max()) for each in curves))


def _acceptance_plot(fit: Fit) -> Plot:
    acceptance, edges = fit.acceptance, np.array([0.0, *TTC_EDGES_S, 12.0])
    y = PlotAxis("share carried out", 1e-3, 3.0, log=True)
    panel = PlotPanel("", PlotAxis("time to collision, s", 0.0, 12.0), y, height=280.0)
    limits = _limits(acceptance.events, acceptance.exposure)
    _add_limits(panel, edges, *limits, f"{numbers.share(CONFIDENCE)} limits by bin")
    steps = np.repeat(edges, 2)[1:-1]
    panel.add("line", "blue", steps, np.repeat(acceptance.shares, 2), label="fitted")
    times = np.linspace(0.05, 12.0, 240)
    for name, colour in SHIPPED.items():
        n = read_model(SHIPPED_FOLDER / f"{name}.yaml", EnvironmentParameters).values()
        accept = special.expit((times - n["cut_in__accept_ttc_s"]) / n["cut_in__accept_scale_s"])
        ignored = n["cut_in__ignore_share"]
        panel.add("line", colour, times, ignored + (1.0 - ignored) * accept, dash="4 3", label=name)
    alt = "Share of lane changes carried out, by time to collision with the vehicle behind, with limits."
    caption = (
        "Of the lane changes expected with nobody closing in; as that number is itself estimated, and changes are few, "
        "a share may exceed 1. Nearly all crashes follow from times below 1.5 s."
    )
    return Plot("acceptance", [panel], alt, caption)


def _hazard_plot(fit: Fit) -> Plot:
    rows = fit.traffic.at_risk[fit.traffic.at_risk["ttc_s"] > TTC_EDGES_S[-1]]
    rate, labels = fit.hazard.rate(rows), ("speed of BV, m/s", "gap R1 to LV, m", "R1dot = v_LV − v_BV, m/s")
    panels = []
    for column, label in zip(HAZARD_OF, labels, strict=True):
        edges = np.unique(np.quantile(rows[column], np.linspace(0.0, 1.0, 9)))
        edges = edges if edges.size > 1 else edges[0] + np.array([-0.5, 0.5])
        bin_of_row = np.clip(np.searchsorted(edges, rows[column], side="right") - 1, 0, edges.size - 2)
        seen, time_s, wished, middle = (
            np.bincount(bin_of_row, weights, edges.size - 1).astype(np.float64)
            for weights in (rows["changes"], rows["duration_s"], rate * rows["duration_s"], rows[column])
        )
        middle /= np.maximum(np.bincount(bin_of_row, minlength=edges.size - 1), 1)
        per_1000_s = np.maximum(time_s, 1e-9) / 1000.0
        low, high = _limits(seen, per_1000_s)
        top = 1.1 * float(max(high.max(), (wished / per_1000_s).max()))
        y = PlotAxis("lane changes per 1,000 s", 0.0, top)
        panel = PlotPanel("", PlotAxis(label, float(edges[0]), float(edges[-1])), y)
        _add_limits(panel, edges, low, high, "seen, 90 % limits")
        panel.add("line", "blue", middle, wished / per_1000_s, label="fitted")
        panels.append(panel)
    alt = "Observed and fitted rate of lane changes, by speed, gap and speed difference."
    caption = "Where nobody closes in from behind within 8 s. One fit with all three variables."
    return Plot("hazard", panels, alt, caption)


def _initial_plot(fit: Fit, traffic: Environment) -> Plot:
    rows = fit.traffic.initial
    drawn = InitialStates(traffic.numbers).from_uniforms(np.random.default_rng(_SEED).random((MOST_ROWS, 5)))
    labels = {"v_mps": "speed of BV, m/s", "r1_m": "gap R1 to LV, m", "r1dot_mps": "R1dot, m/s"}
    panels = []
    for column, label in labels.items():
        state_column = "v_bv_mps" if column == "v_mps" else column
        low, high = np.quantile(rows[column], [0.002, 0.998])
        low, high = (low, high) if low < high else (low - 0.5, high + 0.5)
        edges = np.linspace(low, high, 31)
        seen, law = _histogram(rows[column], edges), _histogram(drawn[state_column], edges)
        line = 0.5 * (edges[1:] + edges[:-1]), law
        panels.append(_beside("", label, _density(seen, law), edges, seen, line))
    alt = "Histograms of observed initial states, and the law's densities."
    return Plot("initial", panels, alt, "States behind a leader, one per vehicle and 20 s.")


def _acceleration_panel(rows: RecordArray, title: str, traffic: Environment) -> PlotPanel:
    step = -(-rows.size // MOST_ROWS)
    sample = rows[::step]
    names = rows.dtype.names or ()
    states = np.column_stack([sample[name] if name in names else np.zeros(sample.size) for name in HAZARD_OF])
    pmf = evaluate_laws(traffic, states).pmf[CAR_FOLLOWING if "r1_m" in names else FREE_DRIVING]
    law, seen = pmf.mean(axis=0), np.bincount(bins(rows["acceleration_mps2"]), minlength=N_ACCELERATIONS) / rows.size
    y = PlotAxis("share", 10.0 ** math.floor(math.log10(min(1.0 / rows.size, 0.1))), 1.0, log=True)
    edges = np.append(ACCELERATIONS_MPS2 - 0.1, ACCELERATIONS_MPS2[-1] + 0.1)
    return _beside(title, "acceleration of one second, m/s²", y, edges, seen, (ACCELERATIONS_MPS2, law))


def _lead_plot(fit: Fit, log_sd: float) -> Plot:
    leads, n = fit.traffic.leads["lead_s"], fit.environment.values()
    longest = n["lateral__longest_lead_s"]
    median = n["lateral__distance_m"] / n["lateral__speed_median_mps"]
    edges = np.linspace(0.0, longest, 26)
    seen = _histogram(np.minimum(leads, longest - 1e-9), edges)
    times = np.linspace(0.02, longest, 250)
    law = stats.lognorm.pdf(times, log_sd, scale=median)
    label, words = "from onset of lateral motion to overlap, s", (f"seen ({leads.size})", "law")
    panel = _beside("", label, _density(seen, law), edges, seen, (times, law), words)
    caption = "How long an attentive vehicle can see a lane change coming."
    return Plot("leads", [panel], "Histogram of leads, and the law.", caption)
