"""Stored runs: estimate again, report again, see an episode again."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

import click

from harness.commands.options import FILE, RUN_FOLDER, examples, json_option, verbose_option, written_file
from harness.commands.printing import in_folder, print_answer, print_estimates, print_json, print_table, say
from harness.errors import EXIT_BAD_INPUT, HarnessError, WorldDisagreementError
from harness.numbers import number, plain, share
from harness.vocabulary import COMPARISON, ESTIMATORS

if TYPE_CHECKING:
    from harness.runner.stored import ReplayResult
    from harness.vocabulary import EstimatorName


LATERAL = ("lead_steps", "onset_step", "onset_r2_m", "onset_ttc_s", "overlap_ttc_s", "contact")
"""What a replay tells of a cut-in that takes time."""


@click.command(
    short_help="Estimate again from the records of a run.",
    epilog=examples(
        "harness estimate runs/smoke", "harness estimate runs/smoke -e nade -e scv --confidence 0.95 --json"
    ),
)
@click.argument("folder", metavar="DIR", type=RUN_FOLDER)
@click.option(
    "--estimator",
    "-e",
    "estimators",
    type=click.Choice(ESTIMATORS),
    multiple=True,
    help="Only this one; may be given several times.",
)
@click.option("--confidence", type=click.FloatRange(0, 1, min_open=True, max_open=True), help="Level of intervals.")
@click.option("--write", is_flag=True, help="Replace DIR/estimates.json by the result.")
@click.option(
    "--environment",
    metavar="NAME|FILE",
    help="Answer for other traffic from the same tests (testing.method shells): a shipped environment, or a file.",
)
@verbose_option
@json_option
@click.pass_context
def estimate(
    ctx: click.Context,
    folder: Path,
    *,
    estimators: Sequence[EstimatorName],
    confidence: float | None,
    write: bool,
    environment: str | None,
    verbose: bool,
    as_json: bool,
) -> None:
    """Estimate the crash rate again from the records in DIR, with any estimator.

    Nothing is simulated in SUMO. Estimators that are asked for, and with -v all, are shown in a table; one that the
    records do not allow with the reason. The exit code is 2 if they allow none of those asked for.

    With --environment the shells' probabilities in other traffic are found in the twin (half a minute), and crash
    shares within shells are taken to be the same there. Traffic in which they cannot be is refused. Replicates of
    fitted traffic take a second each, so minutes for 200. What they give is kept: asked again, this run is answered in
    seconds, and so are most other vehicles tested in the same pool. The answer tells what they leave open, and with
    --write, in the run's own traffic, so do estimates.json and the page. DIR may be that of a comparison, too.
    """
    if environment is not None:
        if estimators:
            raise click.UsageError("--environment does not go with -e: tests of shells alone can be moved.")
        if (folder / COMPARISON).is_file():
            if write:
                raise click.UsageError("--write does not go with the folder of a comparison.")
            _compared_elsewhere(folder, environment, confidence, as_json=as_json)
            return
        from harness.progress import shown_progress  # noqa: PLC0415 - keeps --help fast

        with shown_progress() as bar:
            from harness.runner.other_traffic import estimate_in_other_traffic  # noqa: PLC0415 - keeps --help fast

            content = estimate_in_other_traffic(folder, environment, confidence=confidence, own=write, progress=bar)
    else:
        from harness.runner.stored import estimate_run  # noqa: PLC0415 - keeps --help fast

        content = estimate_run(folder, estimators=estimators or None, confidence=confidence)
    if write:
        from harness.records.folder import write_sealed  # noqa: PLC0415 - keeps --help fast

        write_sealed(folder / "estimates.json", content)
    if as_json:
        print_json(in_folder(content, folder))
    elif verbose or estimators:
        print_estimates(in_folder(content, folder), estimators)
    else:
        page = folder / "report.html"  # of the run's own traffic
        print_answer(content, folder, page if environment is None and page.is_file() else None)
    if estimators and all(content["estimates"][name]["crash_rate"] is None for name in estimators):
        ctx.exit(EXIT_BAD_INPUT)


def _compared_elsewhere(folder: Path, environment: str, confidence: float | None, *, as_json: bool) -> None:
    """What two vehicles' stored tests say of other traffic."""
    from harness.progress import shown_progress  # noqa: PLC0415 - keeps --help fast

    with shown_progress() as bar:
        from harness.runner.other_traffic import compare_in_other_traffic  # noqa: PLC0415 - keeps --help fast

        content = compare_in_other_traffic(folder, environment, confidence=confidence, progress=bar)
    if as_json:
        print_json(content)
    else:
        say(*content["sentences"])


def _ranges(_ctx: click.Context, _parameter: click.Parameter, texts: tuple[str, ...]) -> dict[str, tuple[float, float]]:
    found = {}
    for text in texts:
        name, _, ends = text.partition("=")
        try:
            low, high = map(float, ends.split(":"))
        except ValueError:
            mend = "Write --range cut_in.ignore_share=0.001:0.08."
            raise HarnessError(f"--range {text}", "no two numbers", "SECTION.NAME=LOW:HIGH", mend) from None
        found[name] = low, high
    return found


@click.command(
    short_help="Say which numbers of the traffic an answer depends on.",
    epilog=examples(
        "harness sensitivity runs/smoke", "harness sensitivity runs/smoke --range cut_in.ignore_share=0.001:0.08"
    ),
)
@click.argument("folder", metavar="DIR", type=RUN_FOLDER)
@click.option(
    "--range", "ranges", metavar="SECTION.NAME=LOW:HIGH", multiple=True, callback=_ranges,
    help="Where a number may lie, beside the ranges that the environment states; may be given several times.",
)  # fmt: skip
@json_option
def sensitivity(folder: Path, *, ranges: dict[str, tuple[float, float]], as_json: bool) -> None:
    """Say by how much the crash rate of the run in DIR, and its ratio to a competent driver, moves with its traffic.

    Fitted numbers move by their standard errors, or in blocks by replicates, assumed ones over their ranges. Nothing is
    simulated in SUMO: each move takes a second, once. DIR keeps it as sensitivity.json, and its page shows it.
    """
    from harness.progress import shown_progress  # noqa: PLC0415 - keeps --help fast

    with shown_progress() as bar:
        from harness.runner.sensitivity import sensitivity as found_by  # noqa: PLC0415 - keeps --help fast

        content = found_by(folder, ranges=ranges, progress=bar)
        from harness.report.page import write_report  # noqa: PLC0415 - keeps --help fast

        page = write_report(folder)
    if as_json:
        print_json(content)
        return
    print_table(f"What moves the answer: {content['environment']}", list(map(_bar, content["bars"])))
    say(
        "Crash shares within shells are taken to stay as they were. Off by: what a reference driver shows of that.",
        f"report  {page}",
    )


def _bar(bar: dict[str, Any]) -> dict[str, str]:
    def ends(of: list[float | None]) -> str:
        return "× " + " … ".join(number(end, 3) for end in of)

    values = "" if bar["values"] is None else " … ".join(map(plain, bar["values"]))
    told = {"number": bar["what"], "known": f"{bar['known']} {values}", "rate": ends(bar["rate"])}
    off = " … ".join(map(share, bar["off"])) if bar["off"] != [None, None] else ""
    return {**told, "ratio": ends(bar["ratio"]), "off by": off, "remark": bar["note"]}


@click.command(
    short_help="Write report.html of a run or comparison anew.", epilog=examples("harness report runs/smoke")
)
@click.argument("folder", metavar="DIR", type=RUN_FOLDER)
def report(folder: Path) -> None:
    """Write report.html of the run or of the comparison in DIR anew, and print where the page is."""
    if (folder / COMPARISON).is_file():
        from harness.report.compare_page import write_comparison as write  # noqa: PLC0415 - keeps --help fast
    else:
        from harness.report.page import write_report as write  # noqa: PLC0415 - keeps --help fast

    say(write(folder))


@click.command(
    short_help="Simulate one episode of a run again, bit for bit.",
    epilog=examples(
        "harness replay runs/smoke 17",
        "harness replay runs/smoke 17 --html episode_17.html",
        "harness replay runs/smoke 17 --gui",
    ),
)
@click.argument("folder", metavar="DIR", type=RUN_FOLDER)
@click.argument("episode", type=click.IntRange(min=0))
@click.option("--html", type=FILE, callback=written_file(".html"), help="Write a page that plays the episode.")
@click.option("--fcd", type=FILE, callback=written_file(), help="Write SUMO's floating car data (XML) of the episode.")
@click.option("--gui", is_flag=True, help="Show the episode in sumo-gui (extra 'sumo').")
@json_option
def replay(folder: Path, episode: int, *, html: Path | None, fcd: Path | None, gui: bool, as_json: bool) -> None:
    """Simulate episode number EPISODE of the run in DIR again, bit for bit, and say what happens when.

    And what would have happened with others in the vehicle's place: the careful and competent driver of UN Regulation
    No. 157 (r157-cc), and one that brakes at once, at up to 8 m/s2 (brakes-8).

    Where the run has stored the episode's trace, the replay is compared with it; a difference ends with exit code 3.
    """
    from harness.runner.stored import replay_episode  # noqa: PLC0415 - keeps --help fast

    result = replay_episode(folder, episode, gui=gui, fcd=fcd)
    files = [str(file) for file in (html, fcd) if file is not None]
    if html is not None:
        from harness.report.player import write_player  # noqa: PLC0415 - keeps --help fast

        write_player(result.scene, html)
    if as_json:
        content = {"episode": episode, "outcome": result.outcome, "bit_equal": result.bit_equal, "files": files}
        print_json({**content, **{name: result.row[name] for name in LATERAL if name in result.row}})
    else:
        compared = {None: "no stored trace to compare with", True: "bit for bit as stored", False: "NOT as stored"}
        facts = [f"  {name:<13} {fact}" for name, fact in result.scene["facts"]]
        say(f"episode {episode}: {result.outcome}; {compared[result.bit_equal]}", *facts, *files)
    _require_bits(result, folder, episode)


@click.command(
    short_help="Write one episode of a run for other tools.",
    epilog=examples(
        "harness export runs/smoke 17 --to xosc", "harness export runs/smoke 17 --to csv --out episode_17.csv"
    ),
)
@click.argument("folder", metavar="DIR", type=RUN_FOLDER)
@click.argument("episode", type=click.IntRange(min=0))
@click.option("--to", "form", type=click.Choice(["xosc", "csv"]), required=True, help="Kind of file.")
@click.option("--out", type=FILE, callback=written_file(), help="File to write. Default: episode_N.xosc or .csv, here.")
def export(folder: Path, episode: int, *, form: str, out: Path | None) -> None:
    """Simulate episode number EPISODE of the run in DIR again, bit for bit, and write its motion for other tools.

    xosc: OpenSCENARIO XML 1.2, and its OpenDRIVE road beside it (.xodr), with the motion of all three vehicles in steps
    of 0.1 s. Needs the extra 'export'.

    csv: a row for each vehicle and step; the columns' names say the units.
    """
    file = out or Path(f"episode_{episode}.{form}")
    if file.suffix != f".{form}":
        mend = f"Write --out {file.with_suffix(f'.{form}')}, or another --to."
        raise HarnessError(f"--out {file}", f"a name that ends in '{file.suffix}'", f"one that ends in .{form}", mend)
    if form == "xosc":
        try:
            from harness.report.openscenario import write_openscenario as write  # noqa: PLC0415 - an extra
        except ModuleNotFoundError as error:
            mend = "Install it, in the harness's folder: pip install -c requirements.lock -e '.[export]'."
            raise HarnessError("--to xosc", f"no package {error.name}", "the extra 'export'", mend) from error
    else:
        from harness.report.player import write_csv as write  # noqa: PLC0415 - keeps --help fast
    from harness.runner.stored import replay_episode  # noqa: PLC0415 - keeps --help fast

    result = replay_episode(folder, episode)
    _require_bits(result, folder, episode)
    write(result.trace, file)
    say(str(file), *([str(file.with_suffix(".xodr"))] if form == "xosc" else []))


def _require_bits(result: ReplayResult, folder: Path, episode: int) -> None:
    if result.bit_equal is False:
        found = "a replay that differs from the stored trace"
        raise WorldDisagreementError(f"episode {episode} of {folder}", found, "the same bits", str(result.suspects))
