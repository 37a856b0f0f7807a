"""A campaign: check it, run it, and what it may say; before all, set up the machine."""

from __future__ import annotations

import shlex
from collections.abc import Sequence
from pathlib import Path

import click

from harness.commands.options import (
    CAMPAIGN,
    FILE,
    FOLDER,
    av_option,
    examples,
    executor_option,
    json_option,
    junit_option,
    loaded,
    quiet_option,
    set_option,
    workers_option,
    written_file,
)
from harness.commands.printing import print_json, print_plan, print_statements, print_table
from harness.numbers import leaves, words


@click.command(
    short_help="Validate a campaign, print it resolved, and its cost.",
    epilog=examples(
        "harness check scenarios/smoke.yaml", "harness check scenarios/smoke.yaml --set av.model=fvdm > resolved.yaml"
    ),
)
@click.argument("campaign_file", metavar="CAMPAIGN", type=CAMPAIGN)
@av_option
@set_option
@json_option
def check(campaign_file: Path, overrides: Sequence[str], av: str | None, *, as_json: bool) -> None:
    """Validate CAMPAIGN; print it with every default filled in, and what it will cost.

    No test is run and nothing is written; an AV that is not built in is run for about a second, to see what it costs.
    The output is itself a campaign file; its cost stands in comments.
    """
    campaign = loaded(campaign_file, overrides, av)
    from harness.campaign.files import dump_campaign  # noqa: PLC0415 - keeps --help fast
    from harness.runner import plan_campaign  # noqa: PLC0415 - slow to import: only once the campaign is right

    plan = plan_campaign(campaign)
    if as_json:
        print_json({"campaign": campaign.model_dump(mode="json"), "plan": plan})
        return
    click.echo(dump_campaign(campaign))
    print_plan(plan)


@click.command(
    short_help="Run a campaign until it is precise enough.",
    epilog=examples(
        "harness run scenarios/smoke.yaml --out runs/smoke",
        "harness run scenarios/smoke.yaml --out runs/smoke --resume --set stop.rhw=0.03",
        "harness run scenarios/smoke.yaml --out runs/hard --set av.parameters.min_acceleration_mps2=-8",
        "harness run scenarios/smoke.yaml --out runs/late --av late-600ms",
        "harness run scenarios/smoke.yaml --out runs/gate --accept 3e-7 --junit gate.xml",
        "harness run scenarios/smoke.yaml --out runs/cluster --executor ray",
    ),
)
@click.argument("campaign_file", metavar="CAMPAIGN", type=CAMPAIGN)
@click.option("--out", "folder", type=FOLDER, required=True, help="Run folder; made if it is not there.")
@workers_option
@executor_option
@click.option("--resume", is_flag=True, help="Go on with what the run folder already holds.")
@click.option(
    "--accept",
    type=click.FloatRange(0.0, 1.0, min_open=True, max_open=True),
    metavar="RATE",
    help="Run until it is known whether the crash rate is below so many per test, instead of to stop.rhw.",
)
@junit_option
@quiet_option
@av_option
@set_option
@json_option
@click.pass_context
def run(
    ctx: click.Context,
    campaign_file: Path,
    folder: Path,
    *,
    workers: int | None,
    executor: str | None,
    resume: bool,
    accept: float | None,
    junit: Path | None,
    quiet: bool,
    av: str | None,
    overrides: Sequence[str],
    as_json: bool,
) -> None:
    """Run CAMPAIGN until it is precise enough, and print the crash rate.

    The same campaign gives the same records, bit for bit, whatever the number of workers, and also when it was
    interrupted and resumed. The run folder holds the resolved campaign, all records (Parquet), estimates.json and
    report.html.

    Exit code 4 says that stop.episodes or the pool was spent before stop.rhw was reached, or --accept decided; the
    results are there all the same. With --accept 0 means accepted, 5 rejected.
    """
    limit = [] if accept is None else [f"accept.crash_rate_below={accept!r}"]
    where = [] if executor is None else [f"run.executor={executor}"]
    campaign = loaded(campaign_file, [*overrides, *limit, *where], av)
    from harness.progress import shown_progress  # noqa: PLC0415 - keeps --help fast
    from harness.runner import run_campaign  # noqa: PLC0415 - slow to import: only once the campaign is right

    with shown_progress(campaign.stop.rhw, campaign.min_crashes, quiet=quiet) as bar:
        result = run_campaign(campaign, folder, workers=workers, resume=resume, progress=bar)
    if junit is not None:
        from harness.report.junit import statement_cases, write_junit  # noqa: PLC0415 - keeps --help fast

        asked = campaign.testing.shells.statement
        write_junit(junit, campaign.name, statement_cases(result.estimates, asked, result.exit_code), [result.report])
    if as_json:
        print_json(result.estimates)
    else:
        print_statements(result.estimates)
        for line in (result.ending, result.report, result.folder / "estimates.json"):
            click.echo(str(line))
    ctx.exit(result.exit_code)


@click.command(
    short_help="Build the pool of cut-ins, and show its shells.",
    epilog=examples("harness pool scenarios/smoke.yaml", "harness pool scenarios/smoke.yaml --out pool.parquet"),
)
@click.argument("campaign_file", metavar="CAMPAIGN", type=CAMPAIGN)
@click.option(
    "--out",
    type=FILE,
    callback=written_file(".parquet"),
    help="Write the pool there, too: FILE.parquet, one row per cut-in.",
)
@set_option
@json_option
def pool(campaign_file: Path, *, out: Path | None, overrides: Sequence[str], as_json: bool) -> None:
    """Build the pool that belongs to CAMPAIGN's environment and surrogate library, and show what is in it.

    Shown are the surrogates from careful to careless with their crash rates, and how probable it is that a cut-in is
    the first in this order that a surrogate crashes on. A pool is built once and kept; `harness run` builds it, too.
    """
    campaign = loaded(campaign_file, overrides)
    from harness.pool.storage import campaign_pool, write_pool  # noqa: PLC0415 - slow to import
    from harness.progress import shown_progress  # noqa: PLC0415 - keeps --help fast
    from harness.resolved import resolve  # noqa: PLC0415 - slow to import

    bar = shown_progress()
    with bar:
        found = campaign_pool(resolve(campaign), bar)
    if out is not None:
        write_pool(out, found)
    if as_json:
        print_json(found.to_json() | ({} if out is None else {"file": str(out)}))
        return
    content = found.to_json()
    print_table(f"Pool {content['pool']}: {content['n_paths']:,} paths", content.pop("surrogates"))
    if references := content.pop("references", ()):
        print_table("Reference drivers", references)
    for name, value in leaves(content):
        click.echo(f"{name.replace('_', ' ')}: {words(value, 4)}")
    if out is not None:
        click.echo(str(out))


@click.command(
    short_help="Print the JSON schema of a campaign.", epilog=examples("harness schema > campaign.schema.json")
)
def schema() -> None:
    """Print the JSON schema of a campaign, by which an editor completes and checks campaign files.

    Let the first line of a campaign name the file: '# yaml-language-server: $schema=campaign.schema.json'.
    """
    from harness.campaign.files import schema_text  # noqa: PLC0415 - keeps --help fast

    click.echo(schema_text(), nl=False)


@click.command(
    short_help="Install the system libraries that SUMO needs.",
    epilog=examples(
        "harness setup             # does and asks nothing where nothing is missing",
        "harness setup --dry-run   # only print the commands",
    ),
)
@click.option("--dry-run", is_flag=True, help="Print the commands that would be run, and run none.")
def setup(*, dry_run: bool) -> None:
    """Install the system libraries that SUMO needs, where they are missing: once per machine.

    pip cannot install these few (X11, GL); a desktop has them. They are installed with apt-get, dnf or apk, directly as
    root and else by sudo, which may ask for your password at a terminal. A campaign with world.engine twin needs none.

    Exit code 2 says that they could not be installed; the message names the packages.
    """
    from harness.worlds.system_libraries import (  # noqa: PLC0415 - keeps --help fast
        install,
        install_commands,
        missing_libraries,
        require_libsumo,
    )

    missing = missing_libraries()
    commands = install_commands(missing) if missing else []
    if dry_run:
        click.echo("\n".join(map(shlex.join, commands)) or "Nothing to install.")
        return
    if missing:
        click.echo(f"Installing what SUMO needs: {shlex.join(commands[-1])}", err=True)
        install(missing, commands)
    require_libsumo()
    click.echo("SUMO's system libraries are installed." if missing else "SUMO's system libraries are there.")
