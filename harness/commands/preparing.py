"""Commands for what is done once: set up the machine, get the schema for an editor, fit traffic of one's own."""

from __future__ import annotations

import shlex
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import click

import harness
from harness.commands.options import FILE, examples, json_option, progress_bar, written_file
from harness.commands.printing import print_json, say
from harness.vocabulary import MOST_ASKED


@click.command(
    short_help="Fit traffic of your own to recorded trajectories.",
    epilog=examples(
        "harness fit trajectories.parquet --out my-traffic.yaml",
        "harness fit 01_tracks.csv 02_tracks.csv --mapping highd --out highway.yaml",
        "harness run my_av.py:MyAV --set environment.parameters=my-traffic.yaml --out runs/mine",
        "harness estimate runs/mine --environment my-traffic.yaml",
        "harness run my_av.py:MyAV --scenario lead_brakes --set environment.parameters=my-traffic.lead_brakes.yaml",
    ),
)
@click.argument("files", metavar="FILE...", nargs=-1, required=True, type=click.Path(path_type=Path))
@click.option("--out", type=FILE, required=True, callback=written_file(".yaml"), help="Environment file to write.")
@click.option("--mapping", metavar="highd|ngsim|FILE.yaml", help="How to read columns that differ from these.")
@click.option(
    "--mirror/--no-mirror", default=None, help="Fit lane changes to the left: vehicles close in there, or not."
)
@click.option("--leave-out", multiple=True, metavar="NAME", help="A recording that is not fitted; also several times.")
@click.option(
    "--replicates", type=click.IntRange(2, MOST_ASKED), default=200, show_default=True, help="Environments to draw."
)
@click.option("--seed", type=click.IntRange(min=0), default=1, show_default=True, help="Seed of the replicates.")
@click.option("--force", is_flag=True, help="Write over files that no fit has written.")
@json_option
def fit(files: Sequence[Path], out: Path, *, replicates: int, as_json: bool, **options: Any) -> None:
    """Fit the traffic's laws to trajectories in CSV or Parquet FILEs, and write an environment file.

    One row per vehicle and time, 10 Hz or more: vehicle_id, time_s, s_m (centre, along the road), speed_mps, lane (0 =
    right), length_m; if known recording_id, lateral_m, class, direction. Leaders and followers need not be given.

    Beside the environment file are written a page that shows data and fit, and FILE.replicates.parquet with
    environments that other trajectories of the same kind would have given: from these `harness estimate --environment`
    computes how uncertain the rate is; and FILE.lead_brakes.yaml and FILE.cut_out.yaml, by what drivers met who follow.
    """
    with progress_bar() as bar:
        fitted = harness.fit(files, out, n_replicates=replicates, progress=bar, **options)
    names = repr(fitted).splitlines()
    if as_json:
        print_json({"files": names, **fitted.facts})
    else:
        run, first = "harness run my_av.py:MyAV", f"--set {shlex.quote(f'environment.parameters={out}')}"
        yamls = {name: file for name, each in fitted.families.items() for file in each.files if file.suffix == ".yaml"}
        others = [shlex.quote(f"environments.{name}={file}") for name, file in yamls.items() if file != out]
        all_of_them = f"or: {run} --scenario all {' --set '.join([first, *others])}"
        say(*fitted.told, *names, f"next: {run} {first}", *([all_of_them] if others else []))


@click.command(
    short_help="Print the JSON schema of a campaign.", epilog=examples("harness schema > campaign.schema.json")
)
def schema() -> None:
    """Print the JSON schema of a campaign, with which an editor completes and checks campaign files.

    Let the first line of a campaign name the file: '# yaml-language-server: $schema=campaign.schema.json'.
    """
    from harness.campaign.files import schema_text

    click.echo(schema_text(), nl=False)


@click.command(
    short_help="Set up this machine: SUMO's system libraries, and compiling.",
    epilog=examples(
        "harness setup             # once per machine and version",
        "harness setup --dry-run   # only print the commands",
    ),
)
@click.option("--dry-run", is_flag=True, help="Print the commands that would be run, and run none.")
def setup(*, dry_run: bool) -> None:
    """Install the system libraries that SUMO needs, if any are missing; compile, and build a pool (a minute).

    pip cannot install these few (X11, GL); a desktop has them. They are installed with apt-get or dnf, as root or
    with sudo, which may ask for your password at a terminal. A campaign with world.engine twin needs none.

    Exit code 2 says that they could not be installed; the message names the packages.
    """
    from harness.runner.setup import compile_kernels
    from harness.worlds.system_libraries import install, install_commands, missing_libraries, require_libsumo

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
    with progress_bar() as bar:
        compiled = compile_kernels(bar)
    click.echo("Kernels are compiled." if compiled else "Kernels are compiled already.")
