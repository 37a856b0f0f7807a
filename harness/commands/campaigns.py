"""Commands that take a campaign: check, run and compare it, check its vehicle, show its pool."""

from __future__ import annotations

import re
import textwrap
from collections.abc import Sequence
from pathlib import Path

import click

import harness
from harness.commands import options
from harness.commands.options import CAMPAIGN, FOLDER, examples, progress_bar
from harness.commands.printing import error_in, holds_tests, print_either, print_json, print_table, prints_kept_in, say
from harness.errors import HarnessError
from harness.numbers import leaves, words
from harness.processes import start_server
from harness.vocabulary import FAMILIES, MOST_ASKED


@click.command(
    short_help="Validate a campaign, and print it with all defaults.",
    epilog=examples(
        "harness check scenarios/smoke.yaml",
        "harness check my_av.py:MyClass > my.yaml          # a campaign of one's own to begin with",
    ),
)
@click.argument("campaign_file", metavar="CAMPAIGN|VEHICLE", type=CAMPAIGN)
@options.campaign_options
def check(
    campaign_file: Path, *, overrides: Sequence[str], av: str | None, scenario: str | None, as_json: bool
) -> None:
    """Validate CAMPAIGN, or that of VEHICLE, and print it as a campaign file with every default filled in.

    No test is run, nothing is written.
    """
    campaign = harness.load_campaign(campaign_file, [*options.of_scenario(scenario), *overrides], av=av)
    from harness.campaign.files import dump_campaign, names_a_campaign
    from harness.files import real_path
    from harness.resolved import require_ready

    if campaign.scenarios is None:
        campaign = require_ready(campaign).campaign
    for name in campaign.scenarios or ():
        require_ready(campaign.of_family(name))
    if as_json:
        print_json(campaign.model_dump(mode="json"))
    else:
        folder = campaign_file.parent if names_a_campaign(campaign_file) else Path()
        text = dump_campaign(campaign)
        prefix = f"{real_path(folder)}/"
        # Paths are made relative again, as the file may move; but not where a vehicle's own parameter holds one.
        click.echo(text if prefix in repr(campaign.av.parameters) else text.replace(prefix, ""))


@click.command(
    short_help="Test a vehicle until its crash rate is known precisely enough.",
    epilog=examples(
        "harness run my_av.py:MyClass                        # or module:Class, my_av.fmu, sumo:ACC, r157-cc",
        "harness run my_script.py                            # a TraCI script as it is",
        "harness run my_av.py:MyClass --set av.parameters.hardest_mps2=8",
        "harness run my_av.py:MyClass --scenario all         # cut-in, lead braking, cut-out: crashes per hour",
        "harness run scenarios/smoke.yaml --out runs/smoke",
        "harness run scenarios/smoke.yaml --out runs/smoke --resume --set stop.rhw=0.03",
        "harness run scenarios/smoke.yaml --out runs/mine --set av.controller=my_av.py:MyClass",
        "harness run scenarios/smoke.yaml --out runs/gate --accept 3e-7 --junit gate.xml",
        "harness run my_av.py:MyClass --accept r157-cc       # better than a competent driver?",
        "harness run scenarios/smoke.yaml --out runs/cluster --executor ray",
    ),
)
@click.argument("campaign_file", metavar="CAMPAIGN|VEHICLE", type=CAMPAIGN)
@click.option("--out", "folder", type=FOLDER, help="Run folder; made if it is not there. Default: a new one in runs/.")
@options.workers_option
@options.executor_option
@click.option("--resume", is_flag=True, help="Go on with what the run folder already holds.")
@click.option(
    "--accept", metavar="RATE|DRIVER",
    help="Run until it is known whether the crash rate is below this limit: crashes per test (of several scenarios per "
    "hour), or that of a reference driver, r157-cc or 0.5*r157-cc. Replaces stop.rhw, and `accept` of the campaign.",
)  # fmt: skip
@click.option(
    "--independent", type=click.IntRange(min=0, max=2**63 - 1), metavar="N",
    help="Repeat the run with other random numbers throughout: sets seed and pool.seed to N.",
)  # fmt: skip
@options.exposure_option
@options.junit_option
@options.campaign_options
@click.pass_context
def run(
    ctx: click.Context,
    campaign_file: Path,
    folder: Path | None,
    *,
    scenario: str | None,
    exposures: dict[str, float],
    workers: int | None,
    executor: str | None,
    resume: bool,
    accept: str | None,
    independent: int | None,
    junit: Path | None,
    av: str | None,
    overrides: Sequence[str],
    as_json: bool,
) -> None:
    """Run CAMPAIGN until it is precise enough, or test VEHICLE to ± 30 %, and print the crash rate.

    VEHICLE is a Python class or function (my_av.py:MyClass, package.module:MyClass), a TraCI script (my_script.py), an
    FMU (my_av.fmu), one of SUMO's models (sumo:ACC), an entry of a file (PANEL.yaml:NAME) or a built-in driver
    (r157-cc). A function is called as step(seen) every 0.1 s and returns the acceleration in m/s².

    The same campaign gives the same records, bit for bit, whatever the number of workers, and also when it was
    interrupted and resumed. The run folder holds the resolved campaign, all records (Parquet), estimates.json and
    report.html.

    Exit code 4: stop.episodes or the pool was used up before stop.rhw was reached or --accept decided; the results are
    written all the same. With --accept, 0 means accepted and 5 rejected.
    """
    settings = [*options.of_scenario(scenario), *(f"exposure.{name}={n!r}" for name, n in exposures.items())]
    settings += [] if independent is None else [f"seed={independent}", f"pool.seed={independent}"]
    settings += overrides
    settings += [] if executor is None else [f"run.executor={executor}"]
    with error_in(junit, str(campaign_file)):
        settings += [] if accept is None else options.accepting(accept)
        campaign = harness.load_campaign(campaign_file, settings, av=av)
    if junit is not None and campaign.accept is None:
        say("note: without a limit (--accept) the JUnit file says only whether the run reached its end", err=True)
    ran = campaign_file.name == "campaign.yaml"  # which a run has written into its folder
    if resume and ran and any((campaign_file.parent / name).is_file() for name in ("manifest.json", FAMILIES)):
        folder = folder or campaign_file.parent
    if folder is None:
        folder = options.run_folder(campaign, scenario, resume=resume)
        say(f"into {folder}", err=True)
    if resume and not holds_tests(folder):
        say(f"note: nothing to resume in {folder}: starts anew", err=True)
    if campaign.run.executor == "local":
        start_server()
    with error_in(junit, campaign.name), prints_kept_in(folder), progress_bar() as bar:
        result = harness.run(campaign, folder, workers=workers, resume=resume, progress=bar)
    from harness.runner.underway import RunResult

    content = result.estimates if isinstance(result, RunResult) else result.content
    if junit is not None:
        from harness.report.junit import statement_case, write_junit

        case = statement_case(content, repr(result), campaign.testing.shells.statement, result.exit_code)
        write_junit(junit, campaign.name, case, [result.report])
    print_either(content, [result], as_json=as_json)
    ctx.exit(result.exit_code)


@click.command(
    short_help="Which of two vehicles crashes less often, and by how much?",
    epilog=examples(
        "harness compare old_av.py:MyClass new_av.py:MyClass --out runs/old_new",
        "harness compare runs/old new.yaml --margin 0.1 --out runs/old_new       # is the new one 10 % worse?",
        "harness compare scenarios/smoke.yaml late-600ms --av idm --out runs/late",
    ),
)
@click.argument("source_a", metavar="A", type=CAMPAIGN)
@click.argument("file_b", metavar="[B]", type=CAMPAIGN, required=False)
@click.option("--out", "folder", type=FOLDER, help="Folder of the run folders a and b. Default: runs/A-B.")
@click.option(
    "--against", multiple=True, metavar="A.B=C",
    help="Setting that differs in B; with it B may be left out. May be given several times.",
)  # fmt: skip
@click.option(
    "--margin", type=click.FloatRange(0.0, 1e6), metavar="R",
    help="Run until it is known whether B's crash rate is at most 1 + R times A's. Replaces the precision.",
)  # fmt: skip
@options.workers_option
@options.junit_option
@options.campaign_options
@click.pass_context
def compare(
    ctx: click.Context,
    source_a: Path,
    file_b: Path | None,
    folder: Path | None,
    *,
    against: Sequence[str],
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
    if file_b is None and not against:
        mend = f"Write harness compare {source_a} OTHER_AV, or say with --against SETTING=VALUE how B differs."
        raise HarnessError("harness compare", f"{source_a} alone", "two vehicles, or campaigns", mend)
    from harness.campaign.files import names_a_campaign
    from harness.campaign.models import parse_override
    from harness.records.folder import read_manifest
    from harness.report.words import vehicle_words

    stored = source_a if source_a.is_dir() else None
    if stored is not None and not (stored / FAMILIES).is_file():
        read_manifest(stored)
    file_a = source_a if stored is None else stored / "campaign.yaml"
    overrides = [*options.of_scenario(scenario), *overrides]
    source_b = file_b or file_a
    with error_in(junit, f"{source_a} and {source_b}"):
        a = harness.load_campaign(file_a, overrides, av=av)
        if names_a_campaign(file_a) and not names_a_campaign(source_b):  # a vehicle, driven as A's campaign says
            b = harness.load_campaign(file_a, [*overrides, *against], av=str(source_b))
            b = b.model_copy(update={"name": harness.load_campaign(source_b).name})
        else:
            b = harness.load_campaign(source_b, [*overrides, *against], av=av)
    if stored is not None:  # the precision of the stored run is not what is asked for now
        a = a.model_copy(update={"stop": b.stop})
    # A driver by its name, as brakes-8, has the name of its campaign; its model is that of others, too.
    vehicle_a, vehicle_b = (
        each.name if each.av.model and not names_a_campaign(source) else vehicle_words(each.av)[0]
        for each, source in ((a, file_a), (b, source_b))
    )
    name_b = ", ".join(against) if file_b is None else b.name
    if vehicle_a != vehicle_b:
        labels = vehicle_a, vehicle_b
    elif file_b is None:
        labels = vehicle_a, f"{vehicle_a}, {name_b}"
    else:
        labels = (a.name, b.name) if a.name != b.name else (str(source_a), str(file_b))
    if junit is not None and margin is None:
        say("note: without --margin the JUnit file says only whether it came to an end, whichever is worse", err=True)
    if folder is None:
        folder = options.RUNS / f"{a.name}-{re.sub('[^A-Za-z0-9_.-]+', '-', name_b)}{options.in_name(scenario)}"
    if a.av == b.av:
        say("note: A and B are the same vehicle", err=True)
    rhw = a.stop.rhw if any(parse_override(each).path == ("stop", "rhw") for each in overrides) else None
    with error_in(junit, " and ".join(labels)), prints_kept_in(folder), progress_bar() as bar:
        comparison = harness.compare(
            a, b, folder, workers=workers, progress=bar, labels=labels, stored=stored, margin=margin, rhw=rhw
        )
    if junit is not None:
        from harness.report.junit import difference_case, write_junit

        case = difference_case(comparison.content, repr(comparison), comparison.exit_code)
        write_junit(junit, " and ".join(labels), case, [comparison.report, folder / "compare.json"])
    print_either(comparison.content, [comparison], as_json=as_json)
    ctx.exit(comparison.exit_code)


@click.command(
    name="av-check",
    short_help="Check a vehicle before it is tested: deterministic, within limits, fast?",
    epilog=examples("harness av-check my_av.py:MyClass", "harness av-check my.yaml --set av.parameters.hardest_mps2=8"),
)
@click.argument("campaign_file", metavar="CAMPAIGN|VEHICLE", type=CAMPAIGN)
@click.option(
    "--tests", "episodes", type=click.IntRange(2, MOST_ASKED), default=48, show_default=True, help="Tests to run."
)
@options.campaign_options
@click.pass_context
def av_check(
    ctx: click.Context,
    campaign_file: Path,
    *,
    episodes: int,
    scenario: str | None,
    av: str | None,
    overrides: Sequence[str],
    as_json: bool,
) -> None:
    """Run a few dozen tests of VEHICLE, or of that of CAMPAIGN, twice, and say whether it is ready for a run.

    Shown are whether it repeats itself in another order and beside other tests, whether it stays within limits, how it
    follows and reacts, and its time per step beside the built-in IDM. Nothing is written.

    Exit code 3: tests failed, were not reproduced, or ended the process; 2: campaign or controller are wrong.
    """
    campaign = harness.load_campaign(campaign_file, [*options.of_scenario(scenario), *overrides], av=av)
    from harness.controllers.find import run_apart
    from harness.report.av_check import rows, verdict
    from harness.runner.look import check_av

    with prints_kept_in():
        result = run_apart(campaign.av, check_av, campaign, episodes)
    if as_json:
        print_json(result.to_json())
    else:
        say(*textwrap.wrap(verdict(result), 100, break_on_hyphens=False))
        print_table("Vehicle under test", rows(result))
    ctx.exit(result.exit_code)


@click.command(
    short_help="Build the pool of events that a run draws from, and show it.",
    epilog=examples("harness pool scenarios/smoke.yaml", "harness pool idm --set environment.cut_in_lead_s=0.5"),
)
@click.argument("campaign_file", metavar="CAMPAIGN|VEHICLE", type=CAMPAIGN)
@options.scenario_option
@options.set_option
@options.json_option
def pool(campaign_file: Path, *, scenario: str | None, overrides: Sequence[str], as_json: bool) -> None:
    """Build the pool of events for the traffic and the surrogate library of CAMPAIGN, and show it.

    With VEHICLE it is the pool that `harness run VEHICLE` draws from; the vehicle itself does not matter. Shown are the
    surrogates from careful to careless, with their crash rates and the probabilities of their shells: the events on
    which a surrogate crashes and no more careful one does. `p event` is the probability of an event in a test, `no
    surrogate crashes` that of one that all survive; `envelope` is at full throttle. A pool is built once and kept;
    `harness run` builds it, too.
    """
    campaign = harness.load_campaign(campaign_file, [*options.of_scenario(scenario), *overrides])
    with progress_bar() as bar:
        from harness.pool.build import campaign_pool
        from harness.resolved import resolve

        content = campaign_pool(resolve(campaign), bar).to_json()
    if as_json:
        print_json(content)
        return
    print_table(f"Pool {content['pool']}: {content['n_paths']:,} paths", content.pop("surrogates"))
    if references := content.pop("references", ()):
        print_table("Reference drivers", references)
    for name, value in leaves(content):
        say(f"{name.replace('_', ' ')}: {words(value, 4)}")
