"""Crash rates where cut-ins take time, by lead and driver: the table and the picture of docs/environment.md.

    python -m benchmarks.lateral_rates                          the table, some minutes
    python -m benchmarks.lateral_rates --paths 65536 --plot docs/images/lateral-ratio.png

The same numbers, one lead at a time, to a relative error: harness pool scenarios/smoke.yaml
--set pool.library=benchmarks/lateral_rows.yaml --set environment.cut_in_lead_s=1.0
"""

from __future__ import annotations

import argparse
from pathlib import Path
from typing import Any

import numpy as np

from harness.campaign.files import load_campaign
from harness.campaign.sections import EnvironmentSettings, PoolSettings
from harness.pool.aim import PILOT_PATHS
from harness.pool.build import take_aim
from harness.progress import Progress
from harness.resolved import resolve
from harness.vehicles.library import load_library

LIBRARY = Path(__file__).parent / "lateral_rows.yaml"
PAPER, LATERAL = "ndd-overtaking-1", "ndd-overtaking-2"
ENVIRONMENTS = {
    **{
        f"{lead:g} s": EnvironmentSettings(parameters=LATERAL, cut_in_lead_s=lead) for lead in (0.0, 0.5, 1.0, 1.5, 2.0)
    },
    "log-normal": EnvironmentSettings(parameters=LATERAL),
    "one step": EnvironmentSettings(parameters=PAPER),
}
COMPARED = {"brakes-4": "default IDM", "late-600ms": "0.6 s late", "late-1s": "1.0 s late"}
COMPETENT = "competent"


def rates(settings: EnvironmentSettings, n_paths: int) -> tuple[np.ndarray, np.ndarray]:
    """Crash rates of the library's drivers and the covariance of their errors, from so many aimed paths."""
    pool = PoolSettings(library=str(LIBRARY))
    campaign = load_campaign("scenarios/overtaking_shells.yaml")
    resolved = resolve(campaign.model_copy(update={"environment": settings, "pool": pool}))
    paths = take_aim(resolved, Progress()).enumerator.run(PILOT_PATHS, n_paths, Progress())
    found = paths.rates(len(resolved.library.surrogates))[:, :-1]
    return found.mean(0), np.cov(found.T) / n_paths


def ratio(mean: np.ndarray, covariance: np.ndarray, one: int, other: int) -> tuple[float, float]:
    """Ratio of two rates and its standard error."""
    value = mean[one] / mean[other]
    gradient = np.zeros(mean.size)
    gradient[one], gradient[other] = 1.0 / mean[other], -value / mean[other]
    return float(value), float(np.sqrt(gradient @ covariance @ gradient))


def plot(found: dict[str, tuple[np.ndarray, np.ndarray]], names: list[str], file: Path) -> None:
    """Ratio to the competent driver at both environments, on a logarithmic axis."""
    from matplotlib.figure import Figure  # noqa: PLC0415 - only for the picture

    figure = Figure(figsize=(6.4, 3.2), layout="constrained")
    axes = figure.subplots()
    styles = {"one step": ("#1f5fa8", "o", -0.1), "log-normal": ("#c03a2b", "s", 0.1)}
    labels = {"one step": "cut-ins of one step", "log-normal": "cut-ins that take time (log-normal)"}
    for name, (colour, marker, shift) in styles.items():
        mean, covariance = found[name]
        for place, driver in enumerate(COMPARED):
            value, error = ratio(mean, covariance, names.index(driver), names.index(COMPETENT))
            label = labels[name] if place == 0 else None
            style: dict[str, Any] = {
                "color": colour,
                "marker": marker,
                "markersize": 7,
                "capsize": 3,
                "linestyle": "none",
            }
            axes.errorbar(value, place + shift, xerr=1.645 * error, label=label, **style)
            where: dict[str, Any] = {
                "xytext": (0, 7 if shift < 0.0 else -17),
                "textcoords": "offset points",
                "ha": "center",
            }
            axes.annotate(f"{value:.2g}", (value, place + shift), **where)
    axes.axvline(1.0, color="#444444", linewidth=0.9, linestyle=(0, (4, 3)))
    axes.set_xscale("log")
    axes.set_xlim(0.1, 2.0)
    axes.set_xticks(ticks := [0.1, 0.2, 0.5, 1.0, 2.0], [f"{tick:g}" for tick in ticks])
    axes.minorticks_off()
    axes.set_yticks(range(len(COMPARED)), list(COMPARED.values()))
    axes.set_ylim(len(COMPARED) - 0.4, -0.6)
    axes.set_xlabel("crash rate over that of the competent driver")
    axes.legend(loc="lower left", bbox_to_anchor=(0.0, 1.0), ncols=2, frameon=False)
    figure.savefig(file, dpi=120)


def main() -> None:
    """Print the table."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--paths", type=int, default=16384)
    parser.add_argument("--only", nargs="*", choices=list(ENVIRONMENTS), default=list(ENVIRONMENTS))
    parser.add_argument("--plot", type=Path)
    arguments = parser.parse_args()
    names = list(load_library(str(LIBRARY)).surrogates)
    found = {}
    for name in arguments.only:
        found[name] = rates(ENVIRONMENTS[name], arguments.paths)
        mean, error = found[name][0], np.sqrt(np.diag(found[name][1]))
        told = ", ".join(f"{who} {1e7 * m:.3g} ± {1e7 * e:.1g}" for who, m, e in zip(names, mean, error, strict=True))
        print(f"{name}: {told} (1e-7 per test)", flush=True)
    if arguments.plot is not None:
        plot(found, names, arguments.plot)


if __name__ == "__main__":
    main()
