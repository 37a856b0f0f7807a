"""The command ``compare``: which of two vehicles crashes less often."""

from __future__ import annotations

import re
from collections.abc import Sequence
from pathlib import Path

import click

import harness
from harness.commands import options
from harness.commands.options import CAMPAIGN, FOLDER, examples, progress_bar
from harness.commands.printing import named_if_written, print_either, prints_kept_in, say


@click.command(
    short_help="Which of two vehicles crashes less often, and by how much?",
    epilog=examples(
        "harness compare old_av.py:MyClass new_av.py:MyClass --out runs/old_new",
        "harness compare runs/old new.yaml --margin 0.1 --out runs/old_new       # is the new one 10 % worse?",
        "harness compare scenarios/smoke.yaml --av idm --against-av late-600ms --out runs/late",
    ),
)
@click.argument("source_a", metavar="A", type=CAMPAIGN)
@click.argument("file_b", metavar="[B]", type=CAMPAIGN, required=False)
@click.option("--out", "folder", type=FOLDER, help="Folder of the run folders a and b. Default: runs/A-B.")
@click.option(
    "--against", multiple=True, metavar="A.B=C",
    help="Setting that differs in B; with it B may be left out. May be given several times.",
)  # fmt: skip
@click.option("--against-av", metavar="VEHICLE", help="Vehicle of B; with it B may be left out.")
@click.option(
    "--margin", type=click.FloatRange(0.0, 1e6), metavar="R",
    help="Run until it is known whether B's crash rate is at most 1 + R times A's. Replaces the precision.",
)  # fmt: skip
@options.workers_option
@options.junit_option
@options.av_option
@options.scenario_option
@options.set_option
@options.json_option
@click.pass_context
def compare(
    ctx: click.Context,
    source_a: Path,
    file_b: Path | None,
    folder: Path | None,
    *,
    against: Sequence[str],
    against_av: str | None,
    margin: float | None,
    workers: int | None,
    junit: Path | None,
    av: str | None,
    scenario: str | None,
    overrides: Sequence[str],
    as_json: bool,
) -> None:
    """Test the vehicles of A and B (campaigns or vehicles) in the same traffic, and print the difference.

    Both meet the same events (testing.method: shells), round by round, until it is known which crashes less often, or
    the half-width of the difference is 0.1 of the larger rate, or both are below stop.below_reference; or until
    --margin is decided; or, with --set stop.rhw=R, until that half-width is R.

    B is a vehicle, which is driven as A's campaign says, or a campaign that is equal but for the vehicle.
    With --scenario all the difference is in crashes per hour, summed over three scenarios, each in a folder of its own.

    A may be a run folder: its tests are copied, not run again. So are finished tests of an earlier call with the same
    --out. The folder receives the run folders a and b, compare.json and report.html.

    Exit code 5: B is worse than A by more than --margin; 4: tests or pool were used up before that was known.
    """
    if file_b is None and not against and against_av is None:
        raise click.UsageError("Name a second campaign, or say with --against or --against-av how B differs.")
    from harness.campaign.files import names_a_campaign
    from harness.campaign.models import parse_override
    from harness.report.words import vehicle_words

    stored = source_a if source_a.is_dir() else None
    file_a = source_a if stored is None else stored / "campaign.yaml"
    overrides = [*options.of_scenario(scenario), *overrides]
    a = harness.load_campaign(file_a, overrides, av=av)
    of_b = file_b or file_a
    if names_a_campaign(file_a) and not names_a_campaign(of_b):  # a vehicle, driven as A's campaign says
        b = harness.load_campaign(file_a, [*overrides, *against], av=against_av or av or str(of_b))
        b = b.model_copy(update={"name": harness.load_campaign(of_b).name})
    else:
        b = harness.load_campaign(of_b, [*overrides, *against], av=against_av or av)
    if stored is not None:  # how far it was run before says nothing about now
        a = a.model_copy(update={"stop": b.stop})
    vehicles = vehicle_words(a.av)[0], vehicle_words(b.av)[0]
    name_b = ", ".join([*filter(None, [against_av]), *against]) if file_b is None else b.name
    labels = (a.name, b.name) if a.name != b.name else (str(source_a), str(file_b))
    if vehicles[0] != vehicles[1] or file_b is None:
        labels = vehicles if vehicles[0] != vehicles[1] else (vehicles[0], f"{vehicles[0]}, {name_b}")
    if junit is not None and margin is None:
        say("note: without --margin the JUnit file says only whether it came to an end, whichever is worse", err=True)
    if chosen := folder is None:
        folder = options.RUNS / f"{a.name}-{re.sub('[^A-Za-z0-9_.-]+', '-', name_b)}"
    rhw = a.stop.rhw if any(parse_override(each).path == ("stop", "rhw") for each in overrides) else None
    with named_if_written(folder, chosen=chosen), prints_kept_in(folder), progress_bar() as bar:
        found = harness.compare(
            a, b, folder, workers=workers, progress=bar, labels=labels, stored=stored, margin=margin, rhw=rhw
        )
    if junit is not None:
        from harness.report.junit import difference_case, write_junit

        case = difference_case(found.content, repr(found), found.exit_code)
        write_junit(junit, " and ".join(labels), case, [found.report, folder / "compare.json"])
    print_either(found.content, [found], as_json=as_json)
    ctx.exit(found.exit_code)
