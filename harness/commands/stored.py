"""Stored runs: estimate again, report again, see an episode again."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import Any

import click

import harness
from harness.commands.options import FILE, FOLDER, RUN_FOLDER, examples, exposure_option, json_option, progress_bar
from harness.commands.printing import print_either, print_estimates, print_json, print_table, say
from harness.errors import EXIT_BAD_INPUT, HarnessError, WorldDisagreementError
from harness.numbers import number, plain, share
from harness.vocabulary import ESTIMATORS, FAMILIES


@click.command(
    short_help="Estimate again from a run's tests, also for other traffic.",
    epilog=examples(
        "harness estimate runs/smoke", "harness estimate runs/smoke -e nade -e scv --confidence 0.95 --json"
    ),
)
@click.argument("folder", metavar="DIR", type=RUN_FOLDER)
@click.option(
    "--estimator", "-e", "estimators", metavar="NAME", multiple=True,
    help=f"Only this one: {', '.join(ESTIMATORS)}, or your own, my.py:MyEstimator. May be given several times.",
)  # fmt: skip
@click.option("--confidence", type=click.FloatRange(0.01, 0.999999999), help="Level of intervals.")
@click.option(
    "--write", is_flag=True, help="Write the result into DIR, of several scenarios the page, too; the headline stays."
)
@click.option(
    "--environment", metavar="NAME|FILE",
    help="Answer for other traffic from the same tests (testing.method shells): a shipped environment, or a file.",
)  # fmt: skip
@exposure_option
@click.option(
    "--exposure-uncertainty", "counts", is_flag=True,
    help="Of several scenarios: let the interval include the error of counted exposures.",
)  # fmt: skip
@json_option
@click.pass_context
def estimate(
    ctx: click.Context,
    folder: Path,
    *,
    estimators: Sequence[str],
    confidence: float | None,
    write: bool,
    environment: str | None,
    exposures: dict[str, float],
    counts: bool,
    as_json: bool,
) -> None:
    """Estimate the crash rate again from the tests in DIR, with any estimator. Nothing is simulated in SUMO.

    Estimators named by -e are shown in a table; one that the records do not allow is listed with the reason. The exit
    code is 2 if they allow none of those named.

    --environment answers for other traffic: the probability of each shell is found anew (half a minute), and the share
    of crashes in each shell is assumed to be the same. Traffic in which it cannot be is refused. Replicates of fitted
    traffic take a second each, so minutes for 200; they are kept, so that a second call takes seconds. The answer then
    says how far the rate may be off because the fit is uncertain; --write puts that into estimates.json and the page.
    """
    several = exposures or counts or (folder / FAMILIES).is_file()
    if several and (estimators or environment is not None):
        found, expected = "a folder of several scenarios", "with -e or --environment the folder of one"
        raise HarnessError("harness estimate", found, expected, f"Name {folder / 'cut_in'}, say.")
    if estimators and environment is not None:
        raise click.UsageError("--environment does not go with -e: tests of shells alone can be moved.")
    if write:
        from harness.records.folder import require_place, write_sealed

        require_place(folder)
    if several:
        _estimate_hours(folder, exposures, confidence, counts=counts, write=write, as_json=as_json)
        return
    if environment is not None:
        with progress_bar() as bar:
            content = harness.estimate_in_other_traffic(
                folder, environment, confidence=confidence, own=write, progress=bar
            )
    else:
        from harness.estimators.one_pass import asked_for

        loaded = asked_for(estimators, "--estimator")
        estimators = list(map(str, loaded))
        content = harness.estimate(folder, estimators=loaded or None, confidence=confidence)
    if write:
        write_sealed(folder / "estimates.json", content)
    if as_json:
        print_json(content)
    elif estimators:
        print_estimates(content, estimators)
    else:
        say(content)
    if estimators and all(content["estimates"][name]["crash_rate"] is None for name in estimators):
        ctx.exit(EXIT_BAD_INPUT)


def _estimate_hours(
    folder: Path, exposures: dict[str, float], confidence: float | None, *, counts: bool, write: bool, as_json: bool
) -> None:
    """What stored tests of several scenarios say, with other exposures."""
    from harness.report.several import hour_lines
    from harness.runner.stored import estimate_families

    content, page = estimate_families(folder, exposures, confidence, counts=counts), None
    if counts and not content["counts_in_interval"]:
        say("note: no exposure here is counted: --exposure-uncertainty adds nothing to the interval", err=True)
    if write:
        from harness.records.folder import write_sealed
        from harness.report.page import write_hours

        write_sealed(folder / FAMILIES, content)
        page = write_hours(folder, content)
    print_either(content, hour_lines(content, page, readings=True), as_json=as_json)


def _ranges(_ctx: click.Context, _parameter: click.Parameter, texts: tuple[str, ...]) -> dict[str, tuple[float, float]]:
    ranges = {}
    for text in texts:
        name, _, ends = text.partition("=")
        try:
            low, high = map(float, ends.split(":"))
        except ValueError:
            mend = "Write --range cut_in.ignore_share=0.001:0.08."
            raise HarnessError(f"--range {text}", "no two numbers", "SECTION.NAME=LOW:HIGH", mend) from None
        ranges[name] = low, high
    return ranges


@click.command(
    short_help="Which numbers of the traffic does an answer depend on?",
    epilog=examples(
        "harness sensitivity runs/smoke", "harness sensitivity runs/smoke --range cut_in.ignore_share=0.001:0.08"
    ),
)
@click.argument("folder", metavar="DIR", type=RUN_FOLDER)
@click.option(
    "--range", "ranges", metavar="SECTION.NAME=LOW:HIGH", multiple=True, callback=_ranges,
    help="Range of a number, in place of the one that the environment states; may be given several times.",
)  # fmt: skip
@json_option
def sensitivity(folder: Path, *, ranges: dict[str, tuple[float, float]], as_json: bool) -> None:
    """Say by how much each number of the traffic moves the crash rate of the run in DIR, and its ratio to r157-cc.

    Fitted numbers move by their standard errors, or together by replicates; assumed ones over their ranges. Nothing is
    simulated in SUMO; it takes a minute, once. The result is kept in DIR/sensitivity.json and shown on the page.
    Of several scenarios it is the sum that moves: with the numbers of each, and with how often its events are met.
    """
    with progress_bar() as bar:
        content = harness.sensitivity(folder, ranges=ranges, progress=bar)
        page = harness.write_report(folder)
    if as_json:
        print_json(content)
        return
    from harness.estimators.traffic import LEAST_MOVE, NotMoved
    from harness.report.rows import not_moved_words

    ends = [(bar, (*bar["rate"], *bar["ratio"])) for bar in content["bars"]]
    bars = [_bar(bar) for bar, times in ends if any(t is None or abs(t - 1.0) >= LEAST_MOVE for t in times)]
    n_still = len(content["bars"]) - len(bars)
    still = "1 more number moves" if n_still == 1 else f"{n_still} more numbers move"
    if not any(bar["remark"] for bar in bars):
        bars = [{key: value for key, value in bar.items() if key != "remark"} for bar in bars]
    from harness.families import families

    traffic = content["environment"]
    usual = "the default traffic, " * (traffic in [family.default_parameters for family in families().values()])
    print_table(f"What moves the answer: {usual}{traffic}", bars)
    say(
        *(not_moved_words(NotMoved(**each)) for each in content["not_moved"]),
        *([f"{still} neither by {share(LEAST_MOVE)}."] if n_still else ()),
        "'rate' and 'ratio' (to the competent driver): times what, with the number at its lower … upper end. '–': that "
        "traffic is too unlike what was tested; only a run in it would tell.",
        "It is assumed that of each shell's events the same share end in a crash. 'may be off by': how wrong that is "
        "for a reference driver, whose shares are known.",
        f"report  {page}",
    )


def _bar(bar: dict[str, Any]) -> dict[str, str]:
    from harness.report.rows import bar_note

    def ends(factors: list[float | None]) -> str:
        return "× " + " … ".join(number(end, 3) for end in factors)

    values = "" if bar["values"] is None else " … ".join(map(plain, bar["values"]))
    cells = {"number": bar["what"], "known": f"{bar['known']} {values}", "rate": ends(bar["rate"])}
    off = " … ".join(share(off, least=0.001) for off in bar["off"]) if bar["off"] != [None, None] else ""
    return {**cells, "ratio": ends(bar["ratio"]), "may be off by": off, "remark": bar_note(bar)}


@click.command(
    short_help="Write the report of a run or comparison again.", epilog=examples("harness report runs/smoke")
)
@click.argument("folder", metavar="DIR", type=RUN_FOLDER)
def report(folder: Path) -> None:
    """Write report.html of the run or comparison in DIR again, and print its path."""
    say(harness.write_report(folder))


@click.command(
    short_help="Simulate one test of a run again, bit for bit; watch or write it.",
    epilog=examples(
        "harness replay runs/smoke                         # the hardest crash",
        "harness replay runs/smoke 17                      # test 17, crash or not",
        "harness replay runs/smoke 17 --out test_17.html   # or .csv, .xosc, .xml",
        "harness replay runs/smoke 17 --stored --out test_17.csv",
        "harness replay runs/smoke 17 --gui                # halts at the onset",
        "harness replay runs/smoke 17 --sumo test_17       # then: sumo -c test_17/test.sumocfg",
    ),
)
@click.argument("folder", metavar="DIR", type=RUN_FOLDER)
@click.argument("episode", metavar="[TEST]", type=click.IntRange(min=0), required=False)
@click.option(
    "--out", "files", metavar="FILE", type=FILE, multiple=True,
    help="Write the motion. The suffix says how: .html, a page that plays it; .csv, a row for each vehicle and step "
    "(time_s, vehicle, lane, x_m, v_mps, a_mps2, lateral_m); "
    ".xosc, OpenSCENARIO XML 1.2 and its road (.xodr; extra 'export'); .xml, SUMO's floating car data; "
    ".sumocfg, as --sumo. May be given several times.",
)  # fmt: skip
@click.option("--gui", is_flag=True, help="Show it in sumo-gui, halted at the onset (extra 'sumo').")
@click.option(
    "--sumo", "sumo_folder", metavar="DIR", type=FOLDER,
    help="Write what SUMO needs to repeat it: DIR/test.sumocfg, which sumo and sumo-gui run (-c; extra 'sumo').",
)  # fmt: skip
@click.option(
    "--stored", is_flag=True, help="Use the motion that the run has kept: nothing is simulated, no code of others runs."
)
@click.option("--trust", is_flag=True, help="Run the vehicle's code even if DIR was not made by you on this machine.")
@json_option
def replay(
    folder: Path,
    episode: int | None,
    *,
    files: Sequence[Path],
    gui: bool,
    sumo_folder: Path | None,
    stored: bool,
    trust: bool,
    as_json: bool,
) -> None:
    """Simulate test number TEST of the run in DIR again, or the hardest crash, bit for bit, and say what happens when.

    It also says how two others would have fared in the vehicle's place: the careful and competent driver of UN
    Regulation No. 157 (r157-cc), and one that brakes as soon as it sees the event, at up to 8 m/s2 (brakes-8).

    If the run has kept the test's motion, the replay is compared with it; a difference ends with exit code 3.

    A vehicle of your own is code that DIR names; the replay runs it and says which. If DIR was not made by you on this
    machine, that takes --trust.
    """
    from harness.records.folder import read_manifest, require_place
    from harness.records.reader import code_of, hardest_crash, read_campaign
    from harness.report.motion import gui_program, watch, writer_of
    from harness.runner.stored import code_changed

    files = [*files, *([] if sumo_folder is None else [sumo_folder / "test.sumocfg"])]
    for file in files:  # can be written, before anything is simulated for them
        writer_of(file)
        require_place(file.parent)
    given_folder = folder
    folder, episode = hardest_crash(folder) if episode is None else (folder, episode)
    manifest = read_manifest(folder)
    campaign = read_campaign(folder, manifest, check_files=not stored)
    if not stored and (code := code_of(campaign.av)) is not None:
        say(f"The vehicle is {code}.", err=True)
    program = gui_program() if gui else None
    result = harness.replay(folder, episode, stored=stored, trust=trust)
    written = [path for file in files for path in harness.write_motion(result, file)]
    content = {"folder": str(folder), "episode": episode, "outcome": result.outcome, "bit_equal": result.bit_equal}
    content |= {"files": [str(file) for file in written]}
    compared = {None: "no stored motion to compare with", True: "bit for bit as stored", False: "NOT as stored"}
    words = "the motion that the run has kept" if stored else compared[result.bit_equal]
    head, *facts = repr(result).splitlines()
    head = head if folder == given_folder else f"{folder}, {head}"
    print_either(content, [f"{head}; {words}", *facts, *written], as_json=as_json)
    if not stored and result.bit_equal is not False and (note := code_changed(manifest, campaign)):
        say(f"note: {note}", err=True)
    if program is not None:
        watch(result, program)
    if result.changed is not None:
        found = "a replay that differs from the stored motion"
        raise WorldDisagreementError(f"test {episode} of {folder}", found, "the same bits", result.changed)
