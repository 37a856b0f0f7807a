"""Run a campaign into a folder: what was asked for, whether it can be had, and then until it is enough.

Several families of events are run for one answer: rounds over the strata of all, each family in a run folder of its
own, so that everything that there is for a run, from replay to export, is there for each; the sum is `FAMILIES`.
"""

from __future__ import annotations

import sys
import time
import zlib
from collections.abc import Mapping, Sequence
from contextlib import ExitStack
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np

from harness.arguments import AtLeastOne, checked
from harness.campaign.campaign import Campaign
from harness.campaign.files import campaign_of, dump_campaign, load_campaign
from harness.errors import CampaignError, RunFolderError, told_of
from harness.estimators.answer import Estimates, ended_by
from harness.estimators.estimate import finite_json
from harness.estimators.per_hour import FamilyTests, PerHour, own_exposure
from harness.estimators.shells import SeenShells
from harness.estimators.stopping import Decision, RoundRule
from harness.families.protocol import FAR_ABOVE, Exposure
from harness.families.words import ELSEWHERE
from harness.printed import PRINTED
from harness.problems import listed
from harness.progress import Progress
from harness.records.folder import CAMPAIGN, SENSITIVITY, sole_use, write_bytes, write_sealed
from harness.report.page import write_hours
from harness.report.several import hour_lines
from harness.report.words import doubts_of, vehicle_words
from harness.resolved import Resolved, require_ready
from harness.runner.underway import Places, RunResult, begun, doubted, exit_code, taken
from harness.sampling.shells import HourRounds
from harness.shown import ShownInPython
from harness.strata import Assumed
from harness.vocabulary import FAMILIES


@checked("harness.run")
def run_campaign(
    campaign: Campaign | str | Path,
    out: str | Path,
    *,
    workers: AtLeastOne | None = None,
    resume: bool = False,
    progress: Progress | None = None,
) -> RunResult | Hours:
    """Run a campaign into a folder; one of several scenarios into a run folder each.

    Parameters
    ----------
    campaign : Campaign, str or Path
        What to run, or the path or the vehicle's name that stands for it (`harness.load_campaign`).
    out : str or Path
        New or empty folder.
    workers : int, optional
        Processes, by default as many as there are cores; their number never changes a result.
    resume : bool
        Whether ``out`` holds this campaign, interrupted, or to go on to a smaller RHW.
    progress : Progress, optional
        Who is told how far it is.

    Raises `HarnessError`: the campaign, the folder or the AV is at fault; nothing that was finished is lost.

    Examples
    --------
    >>> import harness
    >>> fast = ["world.engine=twin", "environment.parameters=ndd-overtaking-1", "testing.method=forced"]
    >>> idm = harness.load_campaign("idm", [*fast, "stop.rhw=null", "stop.episodes=1000"])
    >>> result = harness.run(idm, "runs/idm")
    >>> print(result)  # doctest: +ELLIPSIS
    idm · 1,000 tests in SUMO’s twin, cut-in · ...
      crash rate    1.95 × 10⁻⁷ per test  (0.73 to 7.14) × 10⁻⁷  0.586 per million km overtaking
      ...
    >>> result.stopped_by, result.exit_code
    ('episodes', 0)
    """
    out, progress = Path(out), progress or Progress()
    campaign = campaign_of(campaign)
    if campaign.scenarios is not None:
        return run_families(campaign, out, workers=workers, resume=resume, progress=progress)
    resolved = require_ready(campaign)
    with taken({out: resolved}, resume=resume) as places:
        with begun(places, workers, progress) as (underway,):
            rule = underway.drive_tests()
        return underway.finish(rule)


@dataclass(frozen=True, repr=False)
class Hours(ShownInPython):
    """What a finished campaign of several scenarios left: a run folder each, and ``families.json``, the ``content``.

    ``runs`` are their results. The exit code is 0, or 4 when the budget or a pool was spent before what was asked was
    known, or 5 where the rate is above the limit that was to be kept.
    """

    folder: Path
    content: dict[str, Any]
    report: Path
    runs: dict[str, RunResult]
    exit_code: int

    def _lines(self) -> list[str]:
        return hour_lines(self.content, self.report)


def run_families(campaign: Campaign, out: Path, *, workers: int | None, resume: bool, progress: Progress) -> Hours:
    """Run the scenarios of a campaign until their sum is known; see `harness.run`."""
    began = time.monotonic()
    ready = {}
    for name in campaign.scenarios or []:
        with told_of(name):
            ready[name] = require_ready(campaign.of_family(name))
    require_same_driver(campaign, ready)
    rule = RoundRule(campaign)
    with ExitStack() as locks:
        locks.enter_context(sole_use(out))
        require_no_other(out, [*ready, FAMILIES, CAMPAIGN])
        places = locks.enter_context(taken({out / name: resolved for name, resolved in ready.items()}, resume=resume))
        began -= max(float(earlier.get("wall_time_s") or 0.0) for _, earlier in places.values())
        if any(earlier["n_episodes"] for _, earlier in places.values()):
            require_same_shares(out, campaign)
        yaml = dump_campaign(campaign).encode()
        write_bytes(out / CAMPAIGN, yaml)
        hour, results, decision = _run(campaign, places, rule, workers, progress)
    missed = campaign.stop.rhw is not None and not rule.look.stopped
    answers = {name: (result.shown.estimates, result.shown.manifest) for name, result in results.items()}
    answer = hour_answer(hour, ready, answers, campaign.stop.confidence)
    script = next(iter(ready.values())).script
    vehicle, parameters = vehicle_words(campaign.av, script and script._asdict())
    content = {
        "format": 1, "name": campaign.name, "campaign_crc32": zlib.crc32(yaml),
        "seed": campaign.seed, "engine": campaign.world.engine,
        "exposure": campaign.exposure, "counts_above_mps": campaign.crash.counts_above_mps,
        "asked_rhw": campaign.stop.rhw, "each_family": campaign.stop.each_family,
        "stopped_by": ended_by(campaign, rule, hour.totals[0]), "decision": decision and decision.to_json(),
        "vehicle": vehicle, "parameters": parameters, "wall_time_s": round(time.monotonic() - began, 3),
        **answer,
    }  # fmt: skip
    content = finite_json(content)
    write_sealed(out / FAMILIES, content)
    return Hours(out, content, write_hours(out, content), results, exit_code(decision, missed=missed))


def _run(
    campaign: Campaign, places: Places, rule: RoundRule, workers: int | None, progress: Progress
) -> tuple[PerHour, dict[str, RunResult], Decision | None]:
    """Drive rounds over all scenarios until the rule has enough: their sum, the result of each, and what is decided."""
    with begun(places, workers, progress) as each_run:
        runs = dict(zip(campaign.scenarios or [], each_run, strict=True))
        seen = {name: SeenShells(underway.prescribed.design) for name, underway in runs.items()}
        exposures = {name: exposure_of(underway.run.resolved, campaign.exposure) for name, underway in runs.items()}
        hour = PerHour([FamilyTests(name, exposures[name], tests) for name, tests in seen.items()])
        rounds = HourRounds(campaign, hour, [underway.prescribed.available for underway in runs.values()], rule)
        n_held = sum(underway.run.earlier.n_episodes for underway in runs.values())
        progress.stage("tests of all scenarios", None, done=n_held)
        while np.concatenate(added_by_family := rounds.next_round(hour)).any():
            for part, added in zip(hour.families, added_by_family, strict=True):
                runs[part.family].drive_round(part.seen, added, rule)
            if rule.observe(hour) and not any(underway.run.is_behind for underway in runs.values()):
                break
        for underway in runs.values():
            underway.require_tests()
    results = {name: underway.finish(rule, of_sum=True) for name, underway in runs.items()}
    if campaign.accept is not None:  # tests that were cut off count as crashes in its decision alone
        seen = {name: SeenShells.of_blocks(underway.run.blocks) for name, underway in runs.items()}
        hour = PerHour([part._replace(seen=seen[part.family]) for part in hour.families])
    decision = rule.look.decision and doubted(rule.look.decision, runs.values())
    return hour, results, decision


def hour_answer(
    hour: PerHour,
    ready: Mapping[str, Resolved],
    answers: Mapping[str, tuple[Estimates, Mapping[str, Any]]],
    confidence: float,
    *,
    counts: bool = False,
) -> dict[str, Any]:
    """The sum as ``families.json`` has it, and each scenario's part, with its ``answers``: its estimates and manifest.

    Crashes per km are those per hour at the mean speed of scenarios in which the AV follows.
    """
    follow = [resolved for resolved in ready.values() if resolved.family.follows] or list(ready.values())
    speeds = [resolved.family.mean_speed_mps(resolved.environment) for resolved in follow]
    assumed = {name: Assumed(**stored) for name, (_, run) in answers.items() if (stored := run.get("assumed"))}
    hour = PerHour([part._replace(assumed=assumed.get(part.family)) for part in hour.families])
    content = hour.to_json(confidence, sum(speeds) / len(speeds), counts=counts)
    for part, (name, (estimates, manifest)) in zip(hour.families, answers.items(), strict=True):
        entry = content["families"][name]
        entry["median_impact_mps"] = None if estimates.severity is None else estimates.severity.median_mps
        entry |= doubts_of(ready[name].campaign, manifest, estimates, part.per_hour)
        if (per_test := estimates.assumed) and per_test.times:  # other traffic has other numbers of events per test
            low, high = part.events_moved.tolist()
            entry["assumed"] = replace(per_test, times=(per_test.times[0] / low, per_test.times[1] / high))
    return content


def exposure_of(resolved: Resolved, own_exposures: Mapping[str, float]) -> Exposure:
    """How often events of a scenario are met per hour: the shipped number, or the campaign's own."""
    shipped = resolved.family.exposure(resolved.environment, resolved.parameters)
    if resolved.parameters.replicates is not None and not hasattr(resolved.parameters, "exposure"):  # a fit has none
        shipped = shipped._replace(source=f"counted {ELSEWHERE}: {shipped.source}")
    name = resolved.campaign.scenario
    if (own := own_exposures.get(name)) is not None and own > FAR_ABOVE * shipped.high:
        times = f"{own / shipped.per_hour:.0f} times the shipped one, of events in scope"
        sys.stderr.write(f"note: exposure {name}={own:g} is {times} (docs/families.md)\n")
    return own_exposure(shipped, own)


def require_same_driver(campaign: Campaign, ready: Mapping[str, Resolved]) -> None:
    """Refuse (`CampaignError`) a limit beside another driver than the one that the sum is held against."""
    if campaign.accept is None or campaign.accept.times_reference is None:
        return
    driver = campaign.accept.times_reference.driver
    for name, resolved in ready.items():
        if (first := next(iter(resolved.library.references), "")) != driver:
            expected = f"{first}, the first reference driver of {name}: the sum is held against that of each scenario"
            mend = f"Write {first}, or one scenario."
            raise CampaignError("accept.times_reference.driver", f"'{driver}'", expected, mend)


def require_same_shares(out: Path, campaign: Campaign) -> None:
    """Refuse (`RunFolderError`) to go on with tests that would now be allocated otherwise: exposures decide that."""
    was = load_campaign(out / CAMPAIGN, check_files=False)
    mend = "Repeat it, or choose another folder with --out."
    then, now = ([f"{name}={per_hour:g}" for name, per_hour in each.exposure.items()] for each in (was, campaign))
    if sorted(then) != sorted(now):
        found, expected = (f"exposure {', '.join(each) or 'as shipped'}" for each in (then, now))
        if set(was.exposure) <= set(campaign.exposure):  # else an estimate would keep one that is not asked for
            options = "".join(f" --exposure {exposure}" for exposure in now)
            mend = f"Without new tests: harness estimate {out}{options}. Or choose another folder with --out."
        raise RunFolderError(str(out), f"tests allocated with {found}", expected, mend)
    then, now = (["each_family"] * each.stop.each_family + (each.scenarios or []) for each in (was, campaign))
    if then != now:
        raise RunFolderError(str(out), f"tests of {listed(then)}", f"tests of {listed(now)}", mend)


def require_no_other(out: Path, names: Sequence[str]) -> None:
    """Refuse (`RunFolderError`) a folder with other entries than ``names`` and what commands write beside them."""
    ours = {*names, PRINTED, SENSITIVITY, "report.html"}
    if other := sorted(path.name for path in out.iterdir() if path.name[0] != "." and path.name not in ours):
        expected = "a new or empty folder, or one of the same scenarios"
        raise RunFolderError(str(out), f"a folder with {other[0]}", expected, "Choose another folder with --out.")
