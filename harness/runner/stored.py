"""Stored runs: estimate again from the records, replay a test bit for bit, write pages anew."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from contextlib import closing
from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import Annotated, Any

import numpy as np
import pyarrow as pa
import pyarrow.compute as pc
from pydantic import Field

from harness.arguments import Episode, checked
from harness.campaign.campaign import Campaign
from harness.campaign.sections import Confidence, EventsPerHour
from harness.controllers.find import require_controller, run_apart
from harness.errors import CampaignError, HarnessError, RunFolderError
from harness.estimators.answer import estimate_blocks
from harness.estimators.block import BASELINE_COLUMNS, MOMENT_COLUMNS, Block, block_from_tables
from harness.estimators.estimate import finite_json
from harness.estimators.one_pass import asked_for, even
from harness.estimators.per_hour import FamilyTests, PerHour
from harness.estimators.shells import SeenShells
from harness.families import family_named
from harness.families.protocol import Environment
from harness.processes import made_ahead
from harness.records import reader
from harness.records.folder import CAMPAIGN, Part, no_episodes, read_as, read_kept, read_manifest
from harness.records.reader import N_READERS, code_of, read_campaign, require_campaign, require_trust, traffic_of
from harness.records.schemas import moments_schema, shard_tables
from harness.report.crashes import COMPARE_AGAIN
from harness.report.drawing import Plot
from harness.report.page import write_comparison, write_comparison_of_sum, write_hours, write_page_of
from harness.report.player import ReplayResult, Scenes, with_lateral
from harness.report.plots import where_plot
from harness.report.several import hour_lines
from harness.report.summary import read_estimates, read_run_folder
from harness.report.words import estimate_lines, run_lines
from harness.resolved import Resolved, require_world, resolve
from harness.runner.kept import cpu_name, require_same_pool, versions
from harness.runner.run import exposure_of, hour_answer
from harness.sampling import prepare, source_of
from harness.sampling.paths import begin, read_stored
from harness.sampling.shells import stored_design
from harness.shown import ShownInPython
from harness.vocabulary import COMPARISON, ESTIMATORS, FAMILIES
from harness.worlds import build_world

_FINISH = "Run `harness run` with --resume, which makes missing tests."


class StoredEstimates(ShownInPython, dict[str, Any]):
    """Content of ``estimates.json`` or ``families.json``; printed, the short answer, or a line per estimator."""

    def __init__(self, content: Mapping[str, Any], folder: Path, *, by_estimator: bool = False) -> None:
        super().__init__(content)
        self._folder, self._by_estimator = folder, by_estimator

    def _lines(self) -> list[str]:
        if self._by_estimator or "families" in self:
            return estimate_lines(self) if self._by_estimator else hour_lines(self)
        folder, manifest = self._folder, read_manifest(self._folder)
        return run_lines(read_campaign(folder, manifest), manifest, self, folder / "report.html")

    def _plot(self) -> Plot | None:
        """The map of its tests; none where the answer is about other traffic, or about several scenarios."""
        no_map = self.get("elsewhere") or "families" in self
        return None if no_map else where_plot(read_run_folder(self._folder, self))


@checked("harness.estimate")
def estimate_run(
    folder: str | Path,
    *,
    estimators: Annotated[Sequence[str | Any], Field(min_length=1)] | None = None,
    confidence: Confidence | None = None,
) -> StoredEstimates:
    """Estimate a stored run from its records; returns the content of ``estimates.json``, a dict.

    Parameters
    ----------
    folder : str or Path
        Run folder.
    estimators : sequence, optional
        Those to report beside the campaign's own, by default all: names, or your own (`harness.estimators.one_pass`).
    confidence : float, optional
        Level of the intervals, by default the campaign's.

    Raises `HarnessError`: if the folder is not a run, its records are damaged or incomplete; or an estimator is wrong.

    Examples
    --------
    Of the run that `harness.run` shows:

    >>> import harness
    >>> found = harness.estimate("runs/idm", estimators=["nade"], confidence=0.5)
    >>> print(found)
    idm: 95 crashes in 1,000 tests; crash rate per test (50 %)
      nade  1.95 (1.45 to 2.69) × 10⁻⁷
    >>> round(found["estimates"]["nade"]["n_effective"], 2)
    6.82
    """
    folder = Path(folder)
    manifest = read_manifest(folder)
    campaign = read_campaign(folder, manifest)
    require_trust(folder, manifest, campaign.testing.estimator, "Read that code, and run campaign.yaml yourself.")
    wanted = asked_for(estimators or ESTIMATORS, "harness.estimate(estimators=…)")
    blocks = stored_blocks(folder, moments=not {*wanted} < {*ESTIMATORS} - {"scv"})
    content = estimate_blocks(even(blocks), campaign, manifest, estimators=wanted, confidence=confidence)
    return StoredEstimates(content, folder, by_estimator=estimators is not None)


def stored_blocks(folder: Path, *, moments: bool) -> Iterator[Block]:
    """Blocks of the tests that are reported, in index order from 0; a gap or too few of them is an error.

    With ``moments`` ratios of control steps are read, which `scv` needs, where there are any on record. Raises
    `HarnessError`: if the folder is not a run, or its records are damaged or incomplete.
    """
    manifest = read_manifest(folder)
    campaign = read_campaign(folder, manifest)
    if not (n_counted := int(manifest["n_episodes"])):
        raise no_episodes(folder)
    source = source_of(campaign)
    design = stored_design(folder) if campaign.sampling.strata else None
    columns = list(source.columns)
    columns += BASELINE_COLUMNS if design is not None and design.candidates else ()
    ratios = list(MOMENT_COLUMNS) if moments and campaign.sampling.mixes_steps else []
    keeps = ratios and campaign.records.moments != "none"
    no_steps = moments_schema((), len(campaign.surrogates)).empty_table().select(ratios) if keeps else None

    def read(part: Part) -> Block:
        steps = read_kept(folder, part, "moments", ratios) if ratios and "moments" in part.files else no_steps
        return block_from_tables(campaign, read_kept(folder, part, "episodes", columns), steps, design)

    n = 0
    for block in made_ahead(read, manifest["parts"], N_READERS):
        if block.first_episode != n:
            raise RunFolderError(str(folder), f"a part that begins at test {block.first_episode}", f"test {n}", _FINISH)
        counted = block.take(slice(0, n_counted - n))
        n += len(counted)
        if len(counted):
            yield counted
        if n == n_counted:
            return
    raise RunFolderError(str(folder), f"{n} tests on record", f"{n_counted} (manifest.json)", _FINISH)


_TRUST = "Look at stored motion alone (--stored), which runs no code; or read that code, and then add --trust."
_NOT_COMPARED = ("episode", "seed", "failure")


@checked("harness.replay")
def replay_episode(
    folder: str | Path, episode: Episode | None = None, *, stored: bool = False, trust: bool = False
) -> ReplayResult:
    """Replay an episode of a run; a user's own code in a process of its own.

    Parameters
    ----------
    folder : str or Path
        Run folder; that of several scenarios for the hardest crash of all.
    episode : int, optional
        Index of the test in the campaign, from 0; by default that of the hardest crash.
    stored : bool
        Whether to give it as the run has traced it: nothing is simulated.
    trust : bool
        Whether to run code that the folder names though it was not made on this machine by this user.

    Raises `RunFolderError`: the folder is no run, has no crash or no such episode, or none that is traced, the campaign
    or the environment's parameters have changed since, or it names code that is not trusted; `CampaignError`: the AV is
    not reproducible; `HarnessError`: SUMO's system libraries are missing.

    Examples
    --------
    Of the run that `harness.run` shows:

    >>> import harness
    >>> harness.replay("runs/idm", 17)
    test 17: time up, no crash
      BV enters the lane 3.1 to 3.2 s: 26.2 m ahead and 10.1 m/s slower
      AV brakes          3.2 s, 0.1 s after BV entered the lane: at up to 4.0 m/s²
      AV                 avoids it, 12.1 m at the closest
      r157-cc            a careful and competent driver: avoids it, 9.1 m at the closest
      brakes-8           braking as soon as it sees BV come over, at up to 8 m/s²: avoids it, 18.7 m at the closest
    """
    folder, episode = reader.hardest_crash(Path(folder)) if episode is None else (Path(folder), episode)
    manifest = read_manifest(folder)
    tables = _stored(folder, manifest, episode)
    campaign = read_campaign(folder, manifest, check_files=not stored)
    if not stored:
        _require_reproducible(manifest, campaign)
        if not trust:
            for code in (code_of(campaign.av), campaign.testing.own_challenge, *campaign.own_surrogates.values()):
                require_trust(folder, manifest, code, _TRUST)
        return _simulated(folder, manifest, campaign, tables, episode)
    if "traces" not in tables or not tables["traces"].num_rows:
        again = "Simulate it again (without --stored), or run" if manifest.get("reproducible", True) else "Run"
        mend = f"{again} with --set records.traces=all, say."
        raise RunFolderError(str(folder), f"no stored motion of test {episode}", "a test that is traced", mend)
    return _result(campaign, traffic_of(campaign, manifest), tables)


def _result(campaign: Campaign, traffic: Environment | None, tables: Mapping[str, pa.Table]) -> ReplayResult:
    (row,), traces = tables["episodes"].to_pylist(), tables["traces"]
    scene = Scenes(campaign, traffic).scene(tables["episodes"], traces)
    traces = with_lateral(tables["episodes"], traces, family_named(campaign.scenario), traffic)
    return ReplayResult(str(row["outcome"]), row, traces, None, (), scene)


def _simulated(
    folder: Path, manifest: dict[str, Any], campaign: Campaign, stored: Mapping[str, pa.Table], episode: int
) -> ReplayResult:
    resolved = resolve(campaign)
    require_campaign(folder / CAMPAIGN, resolved.content_hash, manifest)
    require_world(campaign)
    again = run_apart(campaign.av, _replay, resolved, folder, episode, stored["episodes"])
    compared = tuple(name for name in again if name in stored and stored[name].num_rows)
    bit_equal = all(_equal(again[name], stored[name]) for name in compared) if compared else None
    why = None if bit_equal is not False else changed_since(manifest, campaign)
    result = _result(campaign, resolved.environment, again)
    return replace(result, bit_equal=bit_equal, compared=compared, changed=why)


def _replay(resolved: Resolved, folder: Path, episode: int, stored: pa.Table) -> dict[str, pa.Table]:
    source = prepare(resolved)
    if source.baseline_paths is not None:
        begin(source, partial(read_stored, folder, source.baseline_paths, read_manifest(folder)["before"]))
    require_same_pool(folder, source)
    with closing(build_world(resolved.campaign, 1)) as world:
        shard = source.run_again(source.loop(world, traces="all"), episode, stored)
    return shard_tables(shard, resolved.campaign.seed, keep_traces=True)


def code_changed(manifest: Mapping[str, Any], campaign: Campaign) -> str:
    """A sentence where the vehicle's code has been changed since a run, else an empty one."""
    if manifest.get("controller_sha256") == require_controller(campaign.av):
        return ""
    return f"{campaign.av.controller}, or a file that it is made of, has been changed since the run."


def changed_since(manifest: Mapping[str, Any], campaign: Campaign) -> str:
    """Sentences on what may have made a replay differ, by what the run's manifest says."""
    here = {**versions(), "CPU": cpu_name()}
    there = {**manifest.get("versions", {}), "CPU": manifest.get("cpu")}
    other = ", ".join(f"{name} {was} (here {here.get(name)})" for name, was in there.items() if was != here.get(name))
    causes = [f"The run was made with {other}; bits are promised for equal ones."] if other else []
    if code := code_changed(manifest, campaign):
        causes.append(code)
    elif campaign.av.model is None:
        same = "" if other else "Versions, CPU and the controller's files are the run's. "
        causes.append(
            f"{same}Or the vehicle does not do the same again: random numbers of its own, memory of earlier tests, "
            "or a file that it reads. `harness av-check --tests 400` looks for that."
        )
    return " ".join(causes) or "Versions and CPU are the run's: the records have been changed, or it is a defect."


def _require_reproducible(manifest: dict[str, Any], campaign: Campaign) -> None:
    if campaign.av.reproducible and manifest.get("reproducible", True):
        return
    if repeated := manifest.get("repeated"):
        differing, n = len(repeated["differing"]), repeated["n_episodes"]
        found = f"a run that is not reproducible: {differing} of the {n} tests that it ran twice differed"
        mend = "`harness av-check` finds the cause. The kept traces (--stored) are what happened."
        raise CampaignError("av", found, "an AV that does the same again on the same observations and stream", mend)
    found = "a run that is not reproducible: a program outside of the harness drove the AV"
    mend = "Look at the traces that the run has kept (--stored; records.traces: crash), or let the program write a log."
    raise CampaignError("av.traci", found, "an AV that does the same again: model, controller, sumo or fmu", mend)


def _stored(folder: Path, manifest: dict[str, Any], episode: int) -> dict[str, pa.Table]:
    """The run's rows of one test, by table, without moments."""
    for part in manifest["parts"]:
        if part.first_episode <= episode < part.end:
            tables = {name: read_kept(folder, part, name) for name in part.files if name != "moments"}
            return {name: table.filter(pc.equal(table["episode"], episode)) for name, table in tables.items()}
    if not manifest["n_episodes"]:
        raise no_episodes(folder)
    expected, mend = f"a number from 0 to {manifest['n_episodes'] - 1}", "The report lists the tests of interest."
    raise RunFolderError(str(folder), f"no test {episode}", expected, mend)


def _equal(again: pa.Table, stored: pa.Table) -> bool:
    """Compare by bits: ``repr`` gives each float a text of its own, 0.0 and -0.0 differ, and NaN equals itself."""
    columns = [name for name in again.column_names if name not in _NOT_COMPARED]
    return repr(again.select(columns).to_pylist()) == repr(stored.select(columns).to_pylist())


# -- of several scenarios --

MEND = "Run the campaign again into the same folder with --resume."


def read_families(folder: Path) -> dict[str, Any]:
    """``families.json`` of a folder; a `RunFolderError` where it is missing, damaged, or another version's."""
    if not (folder / FAMILIES).is_file():
        found, expected = "a comparison, or a run of one scenario", "a folder of several, which has families.json"
        mend = "Leave out --exposure: one scenario has that of its traffic; compare takes --set exposure.lead_brakes=…"
        raise RunFolderError(str(folder), found, expected, mend)
    return read_as(dict[str, Any], folder / FAMILIES, mend=MEND, key="families")


@checked("harness.estimate_families")
def estimate_families(
    folder: str | Path,
    exposure: Mapping[str, EventsPerHour] | None = None,
    confidence: Confidence | None = None,
    *,
    counts: bool = False,
) -> StoredEstimates:
    """Estimate a stored run of several scenarios; returns the content of ``families.json``.

    Parameters
    ----------
    folder : str or Path
        Folder of several scenarios; nothing is run or written.
    exposure : mapping of str to float, optional
        Events per hour of driving, by scenario, in place of the campaign's.
    confidence : float, optional
        Level of the intervals, by default the campaign's.
    counts : bool
        Whether the interval of the sum holds what few counted events leave open of their exposures.

    Raises `HarnessError`: a run is missing or damaged, or an exposure is of no scenario in it.
    """
    folder, exposure = Path(folder), exposure or {}
    stored = read_families(folder)
    names = list(stored["families"])
    if unknown := sorted(set(exposure) - set(names)):
        found = f"an exposure of {', '.join(unknown)}"
        raise HarnessError("--exposure", found, f"one of {', '.join(names)}", "Name a scenario of this folder.")
    exposures = {**stored["exposure"], **exposure}
    families, ready, answers = [], {}, {}
    for name in names:
        run = folder / name
        manifest, tests = read_manifest(run), SeenShells.of_blocks(stored_blocks(run, moments=False))
        resolved = ready[name] = resolve(read_campaign(run, manifest))
        require_campaign(run / CAMPAIGN, resolved.content_hash, manifest)  # exposures are those of its file
        families.append(FamilyTests(name, exposure_of(resolved, exposures), tests))
        answers[name] = read_estimates(run, manifest), manifest
    answer = hour_answer(PerHour(families), ready, answers, confidence or stored["confidence"], counts=counts)
    ran = stored.pop("ran", None) or {name: stored[name] for name in ("exposure", "decision")}
    was = [exposure_of(resolved, ran["exposure"]).per_hour for resolved in ready.values()]
    now = [family.exposure.per_hour for family in families]
    moved = not np.allclose(was, now, rtol=1e-9, atol=0.0)  # the run's verdict holds for the run's exposures alone
    stored |= {"decision": None, "ran": ran} if moved else {"decision": ran["decision"]}
    return StoredEstimates(finite_json({**stored, "exposure": exposures, **answer}), folder)


@checked("harness.write_report")
def write_report(folder: str | Path) -> Path:
    """Write ``report.html`` and ``plots/`` (SVG) into a run folder anew, or the page of a comparison, or of scenarios.

    Parameters
    ----------
    folder : str or Path
        Run folder, or the folder of a comparison, or of several scenarios.

    The page is self-contained: it can be mailed, archived and opened offline. The same folder gives the same bytes if
    it is reached by the same relative path, by which the commands on the page name it.

    Raises `RunFolderError`: if the folder misses a file, or a file is damaged or belongs to another run.
    """
    if (Path(folder) / COMPARISON).is_file():
        return _write_comparison(Path(folder))
    if (Path(folder) / FAMILIES).is_file():
        return write_hours(Path(folder), read_families(Path(folder)))
    return write_page_of(read_run_folder(Path(folder)))


def _write_comparison(folder: Path) -> Path:
    """Write the page of a comparison; where it is a sum, those of its scenarios as well."""
    stored = read_as(dict[str, Any], folder / COMPARISON, mend=COMPARE_AGAIN, key="difference")
    if "families" in stored:
        for name in stored["families"]:
            _write_comparison(folder / name)
        return write_comparison_of_sum(folder, stored)
    runs = [read_run_folder(folder / side) for side in ("a", "b")]
    for run, campaign in zip(runs, stored["campaigns"].values(), strict=True):
        if (campaign_hash := run.manifest["campaign_hash"]) != campaign["campaign_hash"]:
            expected = f"campaign {campaign['campaign_hash']} ({COMPARISON})"
            raise RunFolderError(str(run.path), f"a run of campaign {campaign_hash}", expected, COMPARE_AGAIN)
    return write_comparison(folder, stored, runs, replay_episode)
