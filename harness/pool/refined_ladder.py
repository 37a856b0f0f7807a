"""The adaptive ladder: a library with a driver fitted to the AV that a run has tested, and one a little more careless.

The nearer the surrogates of a library are to the AV, the fewer tests it needs; a wrong one costs tests and never
correctness. So a first, rough run pays for a second, precise one. How far the fitted driver may be believed is told by
the tests that it was not fitted to.
"""

from __future__ import annotations

from dataclasses import dataclass
from itertools import chain, count
from pathlib import Path
from typing import Any

import numpy as np

from harness.campaign.campaign import Campaign
from harness.campaign.files import load_campaign, yaml_text
from harness.campaign.vehicle import Reflexes
from harness.errors import CampaignError, RunFolderError
from harness.pool.fit_driver import MOST_DELAY_STEPS, FittedDriver, agreement, fit_driver
from harness.pool.library import Library, LibraryDriver, LibraryIDM, load_library
from harness.pool.observed import Observed, read_observed
from harness.pool.predicted import Prediction, predict, replay_drivers
from harness.records.folder import read_manifest, write_text
from harness.traffic.loading import load_environment

MOST_FITTED = 200
"""Cut-ins that a driver is fitted to; more change nothing but the time."""
CARELESS_BRAKING, CARELESS_DELAY_STEPS = 0.9, 2
"""The neighbour brakes at most this share as hard, and so much later."""
ENOUGH = 0.5
"""Share of variance, and of the crash rate, from which on a driver is called a prediction."""


@dataclass(frozen=True)
class RefinedLadder:
    """What came of it.

    Attributes
    ----------
    library : Library
        With the drivers added: ``name``, the fitted one, and its neighbour ``careless``.
    fitted : FittedDriver
        With its agreement in the cut-ins that it was fitted to.
    rms_mps2, explained : float
        Agreement of accelerations in ``n_checked`` other cut-ins.
    prediction : Prediction
        Of crashes in all tests that it was not fitted to.
    """

    library: Library
    name: str
    careless: str
    fitted: FittedDriver
    rms_mps2: float
    explained: float
    n_checked: int
    prediction: Prediction

    @property
    def predicted(self) -> bool:
        """Whether the driver describes the AV: most of the variance of its accelerations, and most of its crashes."""
        p = self.prediction
        crashes = (p.caught is None or p.caught >= ENOUGH) and (p.false_alarms is None or p.false_alarms <= ENOUGH)
        return self.explained >= ENOUGH and crashes

    @property
    def statements(self) -> list[str]:
        """What a person wants to read, a sentence each."""
        p = self.prediction
        said = [
            f"{self.name}: {describe(self.fitted.driver)}.",
            f"Fitted to {self.fitted.n_cut_ins} cut-ins; in {self.n_checked} others it explains "
            f"{100.0 * self.explained:.1f} % of the variance of the accelerations (RMS {self.rms_mps2:.2f} m/s²).",
            f"In the {p.both + p.only_av + p.only_driver + p.neither:,} tests that it was not fitted to, both crash "
            f"{p.both:,} times, the AV alone {p.only_av:,}, the driver alone {p.only_driver:,}.",
        ]
        if p.caught is not None:
            false = "" if p.false_alarms is None else f", with {100.0 * p.false_alarms:.1f} % false alarms"
            said.append(f"By weight it predicts {100.0 * p.caught:.1f} % of the AV's crash rate{false}.")
        if not self.predicted:
            why = "the driver does not crash where the AV does"
            if self.explained < ENOUGH:
                why = "the driver does not describe how the AV accelerates, so that crashes in common say little "
                why += "beyond these"
            said.append(f"NOT PREDICTED: {why}. Using this driver costs tests, not correctness.")
        return said

    def to_json(self) -> dict[str, Any]:
        """Plain content for a file."""
        return {
            "name": self.name,
            "careless": self.careless,
            "driver": self.fitted.driver.model_dump(),
            "n_cut_ins_fitted": self.fitted.n_cut_ins,
            "n_cut_ins_checked": self.n_checked,
            "rms_mps2": self.rms_mps2,
            "explained": self.explained,
            "prediction": dict(vars(self.prediction)),
            "predicted": self.predicted,
            "boundary": self.library.boundary,
        }


def refine_ladder(folder: Path, out: Path) -> RefinedLadder:
    """Fit a driver to the AV of a run, write the run's library with it to ``out``, and see how well it predicts.

    Raises
    ------
    CampaignError
        The AV acts before the cut-in, cut-ins take time, or the library's file is gone.
    RunFolderError
        The run's traces depend on the outcome or hold too few cut-ins, or ``out`` is there already.
    """
    _require_new(out)
    campaign = load_campaign(folder / "campaign.yaml")
    if campaign.av.acts_before_cut_in:
        raise CampaignError(
            "av.before_cut_in",
            found="controller",
            expected="hold_speed: a fitted driver keeps its speed until the cut-in, as all surrogates do",
            mend="Run the campaign with --set av.before_cut_in=hold_speed.",
        )
    if load_environment(campaign.environment).lateral.present:
        raise CampaignError(
            "environment",
            found="cut-ins that take time (`lateral` of the environment)",
            expected="cut-ins of one step: when the vehicle began to see BV come over is not fitted",
            mend="Fit the driver to a run with environment.parameters=ndd-overtaking-1, and set perceives_lateral_m in "
            "the file that is written.",
        )
    library = load_library(campaign.pool.library)
    observed = read_observed(folder, campaign)
    cut_ins = np.arange(observed.episode.size)
    to_fit, to_check = observed.part(cut_ins[::2][:MOST_FITTED]), observed.part(cut_ins[1::2])
    fitted = fit_driver(to_fit, library.envelope_mps2)
    refined = _refined(folder, campaign, library, fitted, to_fit, to_check)
    write_text(out, _text(refined, folder))
    return refined


def _refined(
    folder: Path, campaign: Campaign, library: Library, fitted: FittedDriver, to_fit: Observed, to_check: Observed
) -> RefinedLadder:
    careless = more_careless(fitted.driver)
    names = free_names(library)
    drivers: list[LibraryDriver] = [fitted.driver, careless, library.surrogates[library.boundary]]
    replayed = replay_drivers(folder, campaign, drivers).apart_from(to_fit.episode)
    prediction, of_careless, of_boundary = (predict(replayed, driver) for driver in range(3))
    # The statement library is about vehicles inside its boundary: it must not lie within the AV's own neighbour.
    beyond = of_careless.crash_rate_driver > of_boundary.crash_rate_driver
    surrogates = {**library.surrogates, names[0]: fitted.driver, names[1]: careless}
    boundary = names[1] if beyond else library.boundary
    assumes = library.assumes if boundary == library.boundary else ""
    refined = Library.model_validate(
        {**dict(library), "surrogates": surrogates, "boundary": boundary, "assumes": assumes}
    )
    agreed = agreement(fitted.driver, to_check)
    return RefinedLadder(refined, *names, fitted, *agreed, to_check.episode.size, prediction)


def more_careless(driver: LibraryIDM) -> LibraryIDM:
    """A neighbour that brakes a little less and a little later."""
    braking = float(f"{CARELESS_BRAKING * driver.parameters.min_acceleration_mps2:.4g}")
    late = min(round(driver.reaction.delay_s * 10.0) + CARELESS_DELAY_STEPS, MOST_DELAY_STEPS + CARELESS_DELAY_STEPS)
    return LibraryIDM(
        model="idm",
        parameters=driver.parameters.model_copy(update={"min_acceleration_mps2": braking}),
        reaction=Reflexes(delay_s=late / 10.0, max_jerk_mps3=driver.reaction.max_jerk_mps3),
    )


def describe(driver: LibraryIDM) -> str:
    """A driver in words."""
    p, r = driver.parameters, driver.reaction
    jerk = "" if r.max_jerk_mps3 is None else f", changing its acceleration by at most {r.max_jerk_mps3:.3g} m/s³"
    return (
        f"an IDM that reacts after {r.delay_s:.1f} s and brakes with at most {-p.min_acceleration_mps2:.3g} m/s²{jerk}"
        f" (alpha {p.acceleration_mps2:.3g}, b {p.comfortable_deceleration_mps2:.3g}, T {p.time_headway_s:.3g}, "
        f"s0 {p.minimum_gap_m:.3g}, v0 {p.desired_speed_mps:.3g})"
    )


def free_names(library: Library) -> tuple[str, str]:
    """Names for the two drivers that the library does not have yet."""
    endings = chain([""], (f"-{k}" for k in count(2)))
    pairs = ((f"fitted{ending}", f"fitted{ending}-careless") for ending in endings)
    return next(pair for pair in pairs if not set(pair) & set(library.surrogates))


def _require_new(out: Path) -> None:
    if out.suffix not in (".yaml", ".yml"):
        raise CampaignError(
            "--out", found=str(out), expected="a name that ends in .yaml", mend=f"Write --out {out.name}.yaml."
        )
    if out.exists():
        raise RunFolderError(
            str(out),
            found="a file that is there already",
            expected="a new one: a library that runs have used must not change",
            mend="Choose another name, or delete it.",
        )


def _text(refined: RefinedLadder, folder: Path) -> str:
    """The library as a file: what the new drivers were fitted to, then every driver on a line."""
    manifest, library, p = read_manifest(folder), refined.library, refined.prediction
    comment = [
        f"Surrogate library with a driver fitted to the vehicle of campaign {manifest.get('name')}",
        f"({manifest['campaign_hash']}, {manifest['n_episodes']:,} tests), by `harness ladder`.",
        "",
        *refined.statements,
        "",
        f"Weighted crash rates in those tests: vehicle {p.crash_rate:.3g}, {refined.name} {p.crash_rate_driver:.3g}.",
        f"{refined.careless} brakes {100.0 * (1.0 - CARELESS_BRAKING):.0f} % less and "
        f"{CARELESS_DELAY_STEPS / 10.0:g} s later.",
    ]
    content = library.model_dump(exclude={"surrogates", "references"})
    lines = [f"{key}: {_line(value)}" for key, value in content.items()]
    for key, drivers in (("surrogates", library.surrogates), ("references", library.references)):
        lines.append(f"{key}:" if drivers else f"{key}: {{}}")
        lines += [f"  {name}: {_line(model.model_dump(exclude_unset=True))}" for name, model in drivers.items()]
    return "\n".join([*(f"# {line}".rstrip() for line in comment), "", *lines, ""])


def _line(value: Any) -> str:
    return yaml_text(value, one_line=True).strip()
