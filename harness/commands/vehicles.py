"""Vehicles: look at one, compare two."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

import click

from harness.commands.options import (
    CAMPAIGN,
    FOLDER,
    av_option,
    examples,
    json_option,
    junit_option,
    loaded,
    quiet_option,
    set_option,
    workers_option,
)
from harness.commands.printing import print_json, print_table
from harness.numbers import leaves


@click.command(
    name="av-check",
    short_help="Look at the AV before a campaign is spent on it.",
    epilog=examples(
        "harness av-check scenarios/smoke.yaml",
        "harness av-check scenarios/smoke.yaml --set av.model=null --set 'av.parameters={}' --set av.controller=m:MyAV",
    ),
)
@click.argument("campaign_file", metavar="CAMPAIGN", type=CAMPAIGN)
@click.option("--episodes", type=click.IntRange(min=2), default=48, show_default=True, help="Episodes to run.")
@av_option
@set_option
@json_option
@click.pass_context
def av_check(
    ctx: click.Context, campaign_file: Path, *, episodes: int, av: str | None, overrides: Sequence[str], as_json: bool
) -> None:
    """Run a few dozen cut-ins with the AV of CAMPAIGN, twice, and say what it is like.

    Shown are whether it gives the same bits in another order and in other cells, whether it stays finite and within
    limits, how it reacts to cut-ins, and its time per step beside the built-in IDM. Nothing is written.

    Exit code 3 says that episodes failed, were not reproduced, or ended the process; 2 that the campaign or the
    controller is wrong.
    """
    campaign = loaded(campaign_file, overrides, av)
    from harness.runner.av_check import check_av_apart  # noqa: PLC0415 - slow to import: only once the campaign is right

    found = check_av_apart(campaign, episodes)
    if as_json:
        print_json(found.to_json())
    else:
        print_table("What the AV is like", [{"what": name, "found": value} for name, value in leaves(found.to_json())])
    ctx.exit(found.exit_code)


@click.command(
    short_help="Two AVs on common random numbers: the interval of the difference.",
    epilog=examples(
        "harness compare old.yaml new.yaml --out runs/old_new",
        "harness compare runs/old new.yaml --margin 0.1 --out runs/old_new       # is the new one 10 % worse?",
        "harness compare scenarios/smoke.yaml --av idm --against-av late-600ms --out runs/late",
    ),
)
@click.argument("source_a", metavar="A", type=CAMPAIGN)
@click.argument("file_b", metavar="[B]", type=CAMPAIGN, required=False)
@click.option("--out", "folder", type=FOLDER, required=True, help="Folder; run folders a and b are made in it.")
@click.option(
    "--against",
    multiple=True,
    metavar="A.B=C",
    help="Value that B has instead; with it B may be left out. May be given several times.",
)
@click.option(
    "--against-av", metavar="[PANEL.yaml:]NAME", help="Vehicle that B has instead; with it B may be left out."
)
@click.option(
    "--margin",
    type=click.FloatRange(min=0.0),
    metavar="R",
    help="Run until it is known whether B's crash rate is at most 1 + R times A's.",
)
@workers_option
@junit_option
@quiet_option
@av_option
@set_option
@json_option
@click.pass_context
def compare(
    ctx: click.Context,
    source_a: Path,
    file_b: Path | None,
    folder: Path,
    *,
    against: Sequence[str],
    against_av: str | None,
    margin: float | None,
    workers: int | None,
    junit: Path | None,
    quiet: bool,
    av: str | None,
    overrides: Sequence[str],
    as_json: bool,
) -> None:
    """Drive the AVs of campaigns A and B, which differ in nothing else, in the same traffic; print the difference.

    Both meet the same cut-ins (testing.method: shells), round by round, until the half-width of the difference is
    stop.rhw of the larger rate, or --margin is decided.

    A may be a run folder: its tests are copied and not driven again. Finished parts of an earlier call with the same
    --out are used again, too. The folder receives the run folders a and b, and compare.json.

    Exit code 5 says that B is worse than A by more than --margin; 4 that the budget was spent before it was known.
    """
    if file_b is None and not against and against_av is None:
        raise click.UsageError("Name a second campaign, or say with --against or --against-av what is different in B.")
    stored = source_a if source_a.is_dir() else None
    file_a = source_a if stored is None else stored / "campaign.yaml"
    a, b = loaded(file_a, overrides, av), loaded(file_b or file_a, [*overrides, *against], against_av or av)
    if stored is not None:  # how far it was run before says nothing about now
        a = a.model_copy(update={"stop": b.stop})
    from harness.progress import shown_progress  # noqa: PLC0415 - keeps --help fast
    from harness.runner import compare_campaigns  # noqa: PLC0415 - slow to import: only once the campaigns are right

    label_b = ", ".join([b.name, *filter(None, [against_av]), *against]) if file_b is None else b.name
    labels = a.name, label_b
    bar = shown_progress(a.stop.rhw, a.min_crashes, quiet=quiet)
    with bar:
        found = compare_campaigns(
            a, b, folder, workers=workers, progress=bar, labels=labels, stored=stored, margin=margin
        )
    if junit is not None:
        from harness.report.junit import Case, outcome_of, write_junit  # noqa: PLC0415 - keeps --help fast

        case = Case("difference", found.content["statement"], outcome_of(found.exit_code))
        write_junit(junit, " and ".join(labels), [case], [folder / "compare.json"])
    if as_json:
        print_json(found.content)
    else:
        for sentence in found.content.get("statements", [found.content["statement"]]):
            click.echo(sentence)
        for remark in found.difference.warnings:
            click.echo(f"note: {remark}")
        click.echo(str(folder / "compare.json"))
    ctx.exit(found.exit_code)
