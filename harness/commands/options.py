"""What several commands share: kinds of paths, and options."""

from __future__ import annotations

import json
import re
from collections.abc import Callable
from itertools import chain, count, takewhile
from pathlib import Path
from typing import TYPE_CHECKING

import click

from harness.errors import HarnessError
from harness.vocabulary import MOST_ASKED

if TYPE_CHECKING:
    from harness.campaign.campaign import Campaign
    from harness.progress import Progress


FOLDER = click.Path(path_type=Path, file_okay=False)
RUN_FOLDER = click.Path(path_type=Path, file_okay=False, exists=True)
FILE = click.Path(path_type=Path, dir_okay=False)
CAMPAIGN = click.Path(path_type=Path)
RUNS = Path("runs")
"""Where run folders are made that nobody has named."""


def written_file(*suffixes: str) -> Callable[[click.Context, click.Parameter, Path | None], Path | None]:
    """Callback of an option that names a file to write: it ends in one of ``suffixes``, and its folder can be made."""

    def checked(_ctx: click.Context, parameter: click.Parameter, value: Path | None) -> Path | None:
        if value is None:
            return None
        if value.suffix not in suffixes:
            option = parameter.opts[0]
            found = f"a name that ends in '{value.suffix}'"
            mend = f"Write {option} {value.parent / (value.stem or 'mine')}{suffixes[0]}."
            raise HarnessError(f"{option} {value}", found, f"a name that ends in {' or '.join(suffixes)}", mend)
        from harness.records.folder import require_place

        require_place(value.parent)
        return value

    return checked


def _junit_file(ctx: click.Context, parameter: click.Parameter, value: Path | None) -> Path | None:
    """File of the verdict; an earlier one is removed, so that a run without a verdict leaves none."""
    path = written_file(".xml")(ctx, parameter, value)
    if path is not None and path.is_file():
        path.unlink()
    return path


set_option = click.option(
    "--set", "overrides", multiple=True, metavar="A.B=C",
    help="Replace a value of the campaign, e.g. --set stop.rhw=0.3. May be given several times. A path is relative "
    "to the campaign's file, as in the file itself; else to the current folder.",
)  # fmt: skip
av_option = click.option(
    "--av", "av", metavar="VEHICLE", help="Test this vehicle instead of the campaign's; named as for `harness run`."
)
workers_option = click.option(
    "--workers", type=click.IntRange(1, MOST_ASKED),
    help="Processes that simulate. Default: one per CPU that this process may use; with Ray, as many as the cluster "
    "has room for.",
)  # fmt: skip
scenario_option = click.option(
    "--scenario", metavar="NAME",
    help="What happens in the tests: cut_in (default), lead_brakes or cut_out. `harness run`, `compare` and `check` "
    "also take several, with commas, or 'all': their answer is crashes per hour of driving.",
)  # fmt: skip


def _exposures(ctx: click.Context, parameter: click.Parameter, texts: tuple[str, ...]) -> dict[str, float]:
    """Events per hour by scenario, as ``--exposure`` has them."""
    from harness.campaign.sections import EXPOSURES
    from harness.families import family_named

    per_hour = {}
    for text in texts:
        name, equals, value = text.partition("=")
        if equals:
            family_named(name, f"--exposure {text}")
        try:
            per_hour[name] = click.FloatRange(*EXPOSURES)(value, parameter, ctx)
        except click.BadParameter:
            expected = "a scenario and its events per hour of driving, {:g} to {:g}".format(*EXPOSURES)
            mend = "Write --exposure lead_brakes=0.1, once for each; or leave a scenario out of --scenario."
            raise HarnessError(f"--exposure {text}", f"'{value or text}'", expected, mend) from None
    return per_hour


exposure_option = click.option(
    "--exposure", "exposures", metavar="SCENARIO=N", multiple=True, callback=_exposures,
    help="Events per hour of driving, of one scenario of several: cut-ins closing by 5 m/s or more, brakings of 3 m/s² "
    "or more, cut-outs in scope (0.4 % of all). May be given several times.",
)  # fmt: skip
executor_option = click.option(
    "--executor", type=click.Choice(["local", "ray"]),
    help="Where tests run: on this machine, or on a Ray cluster ($RAY_ADDRESS, or run.ray.address of the campaign).",
)  # fmt: skip
quiet_option = click.option(
    "--quiet", is_flag=True, expose_value=False, callback=lambda ctx, _, value: ctx.meta.update(quiet=value),
    help="No progress: no bar on a terminal, no line every 30 s elsewhere.",
)  # fmt: skip
"""Common to all commands: `progress_bar` asks for it."""


def of_scenario(text: str | None) -> list[str]:
    """Settings that ``--scenario`` stands for."""
    from harness.families import R157, family_named

    if text is None:
        return []
    names = R157 if text == "all" else tuple(name.strip() for name in text.split(","))
    for name in names:
        family_named(name, f"--scenario {text}", more=("all",))
    if len(names) == 1:
        return [f"scenario={names[0]}", "scenarios=null"]
    return [f"scenario={R157[0]}", f"scenarios=[{', '.join(names)}]"]


def progress_bar() -> Progress:
    """Progress of a command, which shows nothing with ``--quiet``."""
    from harness.progress import Progress, ShownProgress

    return Progress() if click.get_current_context().meta.get("quiet") else ShownProgress()


junit_option = click.option(
    "--junit", type=FILE, callback=_junit_file, help="Also write the result as JUnit XML, with one test case."
)

json_option = click.option("--json", "as_json", is_flag=True, help="Print JSON on stdout instead of text.")


def campaign_options(command: Callable[..., None]) -> Callable[..., None]:
    """Add the options of a command that takes a campaign or a vehicle: changes of it, and ``--json``."""
    for option in (json_option, set_option, av_option, scenario_option):
        command = option(command)
    return command


def examples(*lines: str) -> str:
    """Lay out lines below a help text, kept as they are (the backspace is click's mark for that)."""
    return "\b\nExamples:\n" + "\n".join(f"  {line}" for line in lines)


def accepting(limit: str) -> list[str]:
    """Settings that ``--accept`` stands for: crashes per test, or those of a driver by its name, as in 0.5*r157-cc."""
    try:
        keys, value = ("crash_rate_below", "times_reference"), f"{float(limit)!r}"
    except ValueError:
        times, star, driver = limit.rpartition("*")
        if re.fullmatch(r"[\s\d.]+", driver):  # r157-cc*0.5
            times, driver = driver, times
        if not star:  # 0.5r157-cc can mean nothing else
            times, driver = re.findall(r"^([\d.]*)(.*)$", limit)[0]
        if not re.fullmatch(r"\s*[A-Za-z0-9][\w.-]*\s*", driver):
            expected = "crashes per test (3e-7), or a driver (r157-cc, 0.5*r157-cc)"
            raise HarnessError("--accept", limit, expected, "Write one of these.") from None
        keys = ("times_reference", "crash_rate_below")
        value = f"{{driver: {json.dumps(driver.strip())}, at_most: {times.strip() or 1}}}"
    return [f"accept.{keys[0]}={value}", f"accept.{keys[1]}=null"]


def in_name(scenario: str | None) -> str:
    """What ``--scenario`` adds to the name of a folder."""
    return "" if scenario is None else f"-{scenario.replace(',', '-').replace(' ', '')}"


def run_folder(campaign: Campaign, scenario: str | None, *, resume: bool) -> Path:
    """``runs/NAME``, or the first of ``runs/NAME-2``, ``-3``, … that is free; to resume, the last that exists."""
    name = campaign.name + in_name(scenario)
    existing = list(takewhile(Path.exists, chain([RUNS / name], (RUNS / f"{name}-{number}" for number in count(2)))))
    if resume and existing:
        return existing[-1]
    return RUNS / (f"{name}-{len(existing) + 1}" if existing else name)
