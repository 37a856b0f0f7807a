"""The command ``harness``: check, av-check, run, compare, pool, ladder, estimate, report, replay, validate, schema.

Results go to stdout or to files, progress and complaints to stderr. Exit codes: 0 done; 2 the campaign or the call is
wrong; 3 too many episodes failed or the world disagreed; 4 budget spent before the asked precision; 130 interrupted.
What does the work is imported inside each command, so that ``--help`` answers at once.
"""

from __future__ import annotations

import os
import sys
from collections.abc import Sequence
from contextlib import nullcontext
from pathlib import Path
from typing import TYPE_CHECKING

import click

from harness.console import (
    print_estimates,
    print_json,
    print_plan,
    print_pool,
    print_statements,
    show_error,
    show_interrupted,
    system_error,
    write_json,
    write_trace,
)
from harness.errors import EXIT_DONE, HarnessError, WorldDisagreementError

if TYPE_CHECKING:
    from harness.campaign.models import Campaign, EstimatorName

EXIT_INTERRUPTED = 130

_FOLDER = click.Path(path_type=Path, file_okay=False)
_RUN_FOLDER = click.Path(path_type=Path, file_okay=False, exists=True)
_FILE = click.Path(path_type=Path, dir_okay=False)
_CAMPAIGN = click.Path(path_type=Path)

_set_option = click.option(
    "--set",
    "overrides",
    multiple=True,
    metavar="A.B=C",
    help="Replace a value of the campaign, e.g. --set stop.rhw=0.3. May be given several times.",
)
_av_option = click.option(
    "--av",
    "av",
    metavar="[PANEL.yaml:]NAME",
    help="Test this vehicle of a panel instead of the campaign's; a bare NAME is one of the shipped panel.",
)
_json_option = click.option("--json", "as_json", is_flag=True, help="Print JSON on stdout instead of text.")


def _examples(*lines: str) -> str:
    """Lay out lines below a help text, kept as they are (the backspace is click's mark for that)."""
    return "\b\nExamples:\n" + "\n".join(f"  {line}" for line in lines)


@click.group(
    epilog=_examples(
        "harness check scenarios/smoke.yaml                  # is it right, and what will it cost?",
        "harness run scenarios/smoke.yaml --out runs/smoke   # the crash rate, with its interval",
        "harness replay runs/smoke 17                        # the same episode again, bit for bit",
    ),
    context_settings={"help_option_names": ["-h", "--help"], "max_content_width": 100},
)
@click.version_option(package_name="harness")
def cli() -> None:
    """Crash rates of automated vehicles that one can trust, from few tests in SUMO.

    A campaign is a YAML file that says which traffic meets which vehicle and when it is enough.

    Exit codes: 0 done; 2 the campaign or the call is wrong; 3 too many episodes failed, or SUMO disagreed with the
    formula; 4 the budget was spent before the asked precision; 130 interrupted.
    """


@cli.command(
    short_help="Validate a campaign, print it resolved, and its cost.",
    epilog=_examples(
        "harness check scenarios/smoke.yaml", "harness check scenarios/smoke.yaml --set av.model=fvdm > resolved.yaml"
    ),
)
@click.argument("campaign_file", metavar="CAMPAIGN", type=_CAMPAIGN)
@_av_option
@_set_option
@_json_option
def check(campaign_file: Path, overrides: Sequence[str], av: str | None, *, as_json: bool) -> None:
    """Validate CAMPAIGN; print it with every default filled in, and what it will cost.

    Nothing is simulated and nothing is written. The output is itself a campaign file; its cost stands in comments.
    """
    campaign = _load(campaign_file, overrides, av)
    from harness.campaign.dumping import dump_campaign  # noqa: PLC0415 - keeps --help fast
    from harness.runner import plan_campaign  # noqa: PLC0415 - slow to import: only once the campaign is right

    plan = plan_campaign(campaign)
    if as_json:
        print_json({"campaign": campaign.model_dump(mode="json"), "plan": plan})
        return
    click.echo(dump_campaign(campaign))
    print_plan(plan)


@cli.command(
    short_help="Run a campaign until it is precise enough.",
    epilog=_examples(
        "harness run scenarios/smoke.yaml --out runs/smoke",
        "harness run scenarios/smoke.yaml --out runs/smoke --resume --set stop.rhw=0.03",
        "harness run scenarios/smoke.yaml --out runs/hard --set av.parameters.min_acceleration_mps2=-8",
        "harness run scenarios/smoke.yaml --out runs/late --av late-600ms",
    ),
)
@click.argument("campaign_file", metavar="CAMPAIGN", type=_CAMPAIGN)
@click.option("--out", "folder", type=_FOLDER, required=True, help="Run folder; made if it is not there.")
@click.option("--workers", type=click.IntRange(min=1), help="Processes that simulate. Default: one per core.")
@click.option("--resume", is_flag=True, help="Go on with what the run folder already holds.")
@click.option("--quiet", is_flag=True, help="No progress bar. There is none either when stderr is not a terminal.")
@_av_option
@_set_option
@_json_option
@click.pass_context
def run(
    ctx: click.Context,
    campaign_file: Path,
    folder: Path,
    *,
    workers: int | None,
    resume: bool,
    quiet: bool,
    av: str | None,
    overrides: Sequence[str],
    as_json: bool,
) -> None:
    """Run CAMPAIGN until it is precise enough, and print the crash rate.

    The same campaign gives the same records, bit for bit, whatever the number of workers, and also when it was
    interrupted and resumed. The run folder holds the resolved campaign, all records (Parquet), estimates.json and
    report.html.

    Exit code 4 says that stop.episodes was spent before stop.rhw was reached; the results are there all the same.
    """
    campaign = _load(campaign_file, overrides, av)
    from harness.progress import terminal_progress  # noqa: PLC0415 - keeps --help fast
    from harness.runner import run_campaign  # noqa: PLC0415 - slow to import: only once the campaign is right

    bar = None if quiet else terminal_progress(campaign.stop.rhw, campaign.min_crashes)
    with bar or nullcontext():
        result = run_campaign(campaign, folder, workers=workers, resume=resume, progress=bar)
        if bar is not None:
            bar.stage("report", total=None)
        report_file = result.report
    if as_json:
        print_json(result.estimates)
    else:
        print_statements(result.estimates)
        click.echo(str(report_file))
        click.echo(str(result.folder / "estimates.json"))
    ctx.exit(result.exit_code)


@cli.command(
    name="av-check",
    short_help="Look at the AV before a campaign is spent on it.",
    epilog=_examples(
        "harness av-check scenarios/smoke.yaml",
        "harness av-check scenarios/smoke.yaml --set av.model=null --set av.controller=my_pkg.my_module:MyController",
    ),
)
@click.argument("campaign_file", metavar="CAMPAIGN", type=_CAMPAIGN)
@click.option("--episodes", type=click.IntRange(min=2), default=48, show_default=True, help="Episodes to run.")
@_av_option
@_set_option
@_json_option
@click.pass_context
def av_check(
    ctx: click.Context,
    campaign_file: Path,
    *,
    episodes: int,
    av: str | None,
    overrides: Sequence[str],
    as_json: bool,
) -> None:
    """Run a few dozen cut-ins with the AV of CAMPAIGN, twice, and say what it is like.

    Shown are whether it gives the same bits in another order and in other cells, whether it stays finite and within
    limits, how it reacts to cut-ins, and its time per step beside the built-in IDM. Nothing is written.

    Exit code 3 says that episodes failed or were not reproduced; 2 that the campaign or the controller is wrong.
    """
    campaign = _load(campaign_file, overrides, av)
    from harness.console import print_av_check  # noqa: PLC0415 - keeps --help fast
    from harness.runner import check_av  # noqa: PLC0415 - slow to import: only once the campaign is right

    found = check_av(campaign, episodes)
    if as_json:
        print_json(found.to_json())
    else:
        print_av_check(found)
    ctx.exit(found.exit_code)


@cli.command(
    short_help="Two AVs on common random numbers: the interval of the difference.",
    epilog=_examples(
        "harness compare A.yaml B.yaml --out runs/a_b",
        "harness compare scenarios/overtaking_forced.yaml --against av.model=fvdm --out runs/idm_fvdm",
        "harness compare scenarios/overtaking_forced.yaml --av idm --against-av late-600ms --out runs/late",
    ),
)
@click.argument("file_a", metavar="A", type=_CAMPAIGN)
@click.argument("file_b", metavar="[B]", type=_CAMPAIGN, required=False)
@click.option("--out", "folder", type=_FOLDER, required=True, help="Folder; run folders a and b are made in it.")
@click.option(
    "--against",
    multiple=True,
    metavar="A.B=C",
    help="Value that B has instead; with it B may be left out. May be given several times.",
)
@click.option(
    "--against-av", metavar="[PANEL.yaml:]NAME", help="Vehicle that B has instead; with it B may be left out."
)
@click.option("--workers", type=click.IntRange(min=1), help="Processes that simulate. Default: one per core.")
@click.option("--quiet", is_flag=True, help="No progress bar. There is none either when stderr is not a terminal.")
@_av_option
@_set_option
@_json_option
@click.pass_context
def compare(
    ctx: click.Context,
    file_a: Path,
    file_b: Path | None,
    folder: Path,
    *,
    against: Sequence[str],
    against_av: str | None,
    workers: int | None,
    quiet: bool,
    av: str | None,
    overrides: Sequence[str],
    as_json: bool,
) -> None:
    """Run campaigns A and B, which differ in their AV only, on the same random numbers, and print the difference.

    Both run to their own stop rule, then the shorter one as far as the longer. Finished parts of an earlier call with
    the same folder are used again. The folder receives the run folders a and b, and compare.json.

    testing.method forced is the one to choose: there both AVs meet the very same cut-ins.
    """
    if file_b is None and not against and against_av is None:
        raise click.UsageError("Name a second campaign, or say with --against or --against-av what is different in B.")
    a, b = _load(file_a, overrides, av), _load(file_b or file_a, [*overrides, *against], against_av or av)
    from harness.progress import terminal_progress  # noqa: PLC0415 - keeps --help fast
    from harness.runner import compare_campaigns  # noqa: PLC0415 - slow to import: only once the campaigns are right

    label_b = ", ".join([b.name, *filter(None, [against_av]), *against]) if file_b is None else b.name
    bar = None if quiet else terminal_progress(a.stop.rhw, a.min_crashes)
    with bar or nullcontext():
        found = compare_campaigns(a, b, folder, workers=workers, progress=bar, labels=(a.name, label_b))
    if as_json:
        print_json(found.content)
    else:
        click.echo(found.content["statement"])
        for remark in found.difference.warnings:
            click.echo(f"note: {remark}")
        click.echo(str(folder / "compare.json"))
    ctx.exit(found.exit_code)


@cli.command(
    short_help="Build the pool of cut-ins, and show its shells.",
    epilog=_examples("harness pool scenarios/smoke.yaml", "harness pool scenarios/smoke.yaml --out pool.parquet"),
)
@click.argument("campaign_file", metavar="CAMPAIGN", type=_CAMPAIGN)
@click.option("--out", type=_FILE, help="Write the pool there, too: FILE.parquet, one row per cut-in.")
@_set_option
@_json_option
def pool(campaign_file: Path, *, out: Path | None, overrides: Sequence[str], as_json: bool) -> None:
    """Build the pool that belongs to CAMPAIGN's environment and surrogate library, and show what is in it.

    Shown are the surrogates from careful to careless with their crash rates, and how probable it is that a cut-in is
    the first in this order that a surrogate crashes on. A pool is built once and kept; `harness run` builds it, too.
    """
    campaign = _load(campaign_file, overrides)
    from harness.pool.storage import campaign_pool, write_pool  # noqa: PLC0415 - slow to import
    from harness.progress import terminal_progress  # noqa: PLC0415 - keeps --help fast

    bar = terminal_progress()
    with bar or nullcontext():
        found = campaign_pool(campaign, bar)
    if out is not None:
        write_pool(out, found)
    if as_json:
        print_json(found.to_json())
    else:
        print_pool(found.to_json())


@cli.command(
    short_help="Estimate again from the records of a run.",
    epilog=_examples(
        "harness estimate runs/smoke", "harness estimate runs/smoke -e nade -e scv --confidence 0.95 --json"
    ),
)
@click.argument("folder", metavar="DIR", type=_RUN_FOLDER)
@click.option(
    "--estimator",
    "-e",
    "estimators",
    type=click.Choice(["nde", "nade", "mixture_cv", "scv", "shells", "martingale", "replay"]),
    multiple=True,
    help="Only this one; may be given several times.",
)
@click.option("--confidence", type=click.FloatRange(0, 1, min_open=True, max_open=True), help="Level of intervals.")
@click.option(
    "--pool", "pool_file", type=_FILE, help="Pool of cut-ins to replay surrogates of. Default: the run's own."
)
@click.option("--write", is_flag=True, help="Replace DIR/estimates.json by the result.")
@_json_option
def estimate(
    folder: Path,
    *,
    estimators: Sequence[EstimatorName],
    confidence: float | None,
    pool_file: Path | None,
    write: bool,
    as_json: bool,
) -> None:
    """Estimate the crash rate again from the records in DIR, with any estimator.

    Nothing is simulated in SUMO. An estimator that the records do not allow is shown with the reason.

    'replay' puts surrogates in the AV's place, in the twin. It needs a pool of cut-ins, which is built (about half a
    minute) when 'replay' is asked for by name and it is not there yet.
    """
    from harness.estimators import estimate_run  # noqa: PLC0415 - keeps --help fast
    from harness.progress import terminal_progress  # noqa: PLC0415 - keeps --help fast

    bar = terminal_progress() if "replay" in estimators else None
    with bar or nullcontext():
        content = estimate_run(
            folder, estimators=estimators or None, confidence=confidence, pool=pool_file, progress=bar
        )
    if write:
        write_json(folder / "estimates.json", content)
    if as_json:
        print_json(content)
    else:
        print_estimates(content)


@cli.command(short_help="Write report.html of a run anew.", epilog=_examples("harness report runs/smoke"))
@click.argument("folder", metavar="DIR", type=_RUN_FOLDER)
def report(folder: Path) -> None:
    """Write DIR/report.html and its plots anew, and print where the page is."""
    from harness.report import write_report  # noqa: PLC0415 - keeps --help fast

    click.echo(str(write_report(folder)))


def _trace_file(_ctx: click.Context, _parameter: click.Parameter, value: Path | None) -> Path | None:
    if value is not None and value.suffix not in (".parquet", ".csv"):
        raise click.BadParameter("the name must end in .parquet or .csv")
    return value


@cli.command(
    short_help="Simulate one episode of a run again, bit for bit.",
    epilog=_examples(
        "harness replay runs/smoke 17",
        "harness replay runs/smoke 17 --out episode_17.csv",
        "harness replay runs/smoke 17 --gui",
    ),
)
@click.argument("folder", metavar="DIR", type=_RUN_FOLDER)
@click.argument("episode", type=click.IntRange(min=0))
@click.option("--out", type=_FILE, callback=_trace_file, help="Write the trace: FILE.parquet or FILE.csv.")
@click.option("--fcd", type=_FILE, help="Write SUMO's floating car data (XML) of the episode.")
@click.option("--gui", is_flag=True, help="Show the episode in sumo-gui (extra 'sumo').")
@_json_option
def replay(folder: Path, episode: int, *, out: Path | None, fcd: Path | None, gui: bool, as_json: bool) -> None:
    """Simulate episode number EPISODE of the run in DIR again, bit for bit.

    Where the run has stored the episode's trace, the replay is compared with it; a difference ends with exit code 3.
    """
    from harness.runner import replay_episode  # noqa: PLC0415 - keeps --help fast

    result = replay_episode(folder, episode, gui=gui, fcd=fcd)
    files = [str(file) for file in (out, fcd) if file is not None]
    if out is not None:
        write_trace(result.trace, out)
    if as_json:
        print_json({"episode": episode, "outcome": result.outcome, "bit_equal": result.bit_equal, "files": files})
    else:
        compared = {None: "no stored trace to compare with", True: "bit for bit as stored", False: "NOT as stored"}
        click.echo(f"episode {episode}: {result.outcome}; {compared[result.bit_equal]}")
        for file in files:
            click.echo(file)
    if result.bit_equal is False:
        raise WorldDisagreementError(
            f"episode {episode} of {folder}",
            found="a replay that differs from the stored trace",
            expected="the same bits",
            mend="Compare versions and CPU in manifest.json with this machine's; bits are promised for equal ones.",
        )


@cli.command(
    short_help="Repeat a campaign thousands of times: what are its intervals worth?",
    epilog=_examples("harness validate scenarios/validate/shells_panel.yaml --out runs/shells_panel"),
)
@click.argument("experiment_file", metavar="EXPERIMENT", type=_CAMPAIGN)
@click.option("--out", "folder", type=_FOLDER, required=True, help="Folder of the results; made if it is not there.")
@click.option("--replications", type=click.IntRange(min=2), help="Instead of the experiment's own number.")
@click.option("--workers", type=click.IntRange(min=1), help="Processes. Default: one per core.")
@click.option("--quiet", is_flag=True, help="No progress bar. There is none either when stderr is not a terminal.")
@_json_option
def validate(
    experiment_file: Path, folder: Path, *, replications: int | None, workers: int | None, quiet: bool, as_json: bool
) -> None:
    """Repeat the campaign of EXPERIMENT for each of its vehicles or chains, and judge its intervals by that.

    Printed are bias, true and claimed variance, coverage with its binomial interval and Holm-corrected p-value, and
    the tests needed. The folder receives results.json, replications.parquet (one row each) and coverage.png.
    """
    from harness.validation.experiment import load_experiment  # noqa: PLC0415 - keeps --help fast

    experiment = load_experiment(experiment_file)
    if replications is not None:
        experiment = experiment.model_copy(update={"replications": replications})
    from harness.progress import terminal_progress  # noqa: PLC0415 - keeps --help fast
    from harness.validation import validate as repeat  # noqa: PLC0415 - slow to import: only once the file is right
    from harness.validation.results import RESULTS, table_lines  # noqa: PLC0415

    bar = None if quiet else terminal_progress(None, 0)
    with bar or nullcontext():
        done = repeat(experiment, folder, workers=workers, progress=bar)
    if as_json:
        print_json([one.to_json() for one in done.judgements])
        return
    for line in table_lines(done.judgements):
        click.echo(line)
    click.echo(str(folder / RESULTS))


@cli.command(
    short_help="Fit a surrogate to the AV of a run.",
    epilog=_examples(
        "harness run my.yaml --out runs/rough --set records.trace_share=0.2",
        "harness ladder runs/rough --out my-ladder.yaml",
        "harness run my.yaml --out runs/fine --set testing.method=shells --set pool.library=./my-ladder.yaml",
    ),
)
@click.argument("folder", metavar="DIR", type=_RUN_FOLDER)
@click.option("--out", type=_FILE, required=True, help="Library to write, a new .yaml file.")
@_json_option
def ladder(folder: Path, out: Path, *, as_json: bool) -> None:
    """Fit a driver to the AV of the run in DIR, and write the run's surrogate library with it.

    The driver is an IDM with a reaction delay and limits to braking and jerk. It is fitted to accelerations in episodes
    that were traced whatever came of them (records.trace_share, or records.traces all); how well it predicts the AV's
    crashes is told by the tests that it was not fitted to. A more careless neighbour is added beside it.
    """
    from harness.pool.refined_ladder import refine_ladder  # noqa: PLC0415 - keeps --help fast

    refined = refine_ladder(folder, out)
    if as_json:
        print_json({**refined.to_json(), "file": str(out)})
        return
    for sentence in refined.statements:
        click.echo(sentence)
    click.echo(str(out))


@cli.command(
    short_help="Print the JSON schema of a campaign.", epilog=_examples("harness schema > campaign.schema.json")
)
def schema() -> None:
    """Print the JSON schema of a campaign, by which an editor completes and checks campaign files.

    Let the first line of a campaign name the file: '# yaml-language-server: $schema=campaign.schema.json'.
    """
    from harness.campaign.schema import schema_text  # noqa: PLC0415 - keeps --help fast

    click.echo(schema_text(), nl=False)


def main(arguments: Sequence[str] | None = None) -> int:
    """Run the command line and turn every error that a user can cause into plain words.

    Returns
    -------
    int
        Exit code; anything that is not a user's error is a defect and leaves as its own exception.
    """
    try:
        code = cli.main(args=None if arguments is None else list(arguments), prog_name="harness", standalone_mode=False)
        sys.stdout.flush()
    except HarnessError as error:
        show_error(error)
        return error.exit_code
    except click.ClickException as error:
        error.show()
        return error.exit_code
    except (click.Abort, KeyboardInterrupt):
        show_interrupted(can_resume=_is_run(arguments))
        return EXIT_INTERRUPTED
    except BrokenPipeError:
        _discard_stdout()
        return EXIT_DONE
    except OSError as error:
        return _show_system_error(error)
    return code if isinstance(code, int) else EXIT_DONE


def _load(campaign_file: Path, overrides: Sequence[str], av: str | None = None) -> Campaign:
    from harness.campaign.loading import load_campaign  # noqa: PLC0415 - keeps --help fast

    return load_campaign(campaign_file, overrides, av=av)


def _is_run(arguments: Sequence[str] | None) -> bool:
    command = sys.argv[1:2] if arguments is None else arguments[:1]
    return "run" in command


def _show_system_error(error: OSError) -> int:
    known = system_error(error)
    if known is None:
        raise error
    show_error(known)
    return known.exit_code


def _discard_stdout() -> None:
    """Let the interpreter flush into nothing at exit: the reader of the pipe is gone."""
    os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())
