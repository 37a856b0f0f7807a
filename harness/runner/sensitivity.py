"""What the answer of a stored run depends on: by how much it moves where a number of its traffic is not known.

Fitted numbers move by their standard errors or, where the environment names replicates, in blocks, as those of a block
were fitted together. Assumed numbers move over the range that is stated for them. Each move is answered by the run's
own tests and few paths (`harness.runner.stored_shells`): with the shells' new probabilities, and crash shares within
shells as they were. Of numbers that change what happens after a cut-in the shares tell nothing but what the reference
drivers show: by how much their rates, which are known there, would come out wrong.
"""

from __future__ import annotations

import math
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Literal

import numpy as np

from harness.arguments import checked
from harness.errors import CampaignError, RunFolderError
from harness.estimators.estimate import finite_json
from harness.estimators.traffic import Bar, Sensitivity
from harness.families.protocol import Parameters
from harness.progress import Progress
from harness.records.folder import MANIFEST, SENSITIVITY, require_place, write_sealed
from harness.records.replicates import read_replicates
from harness.runner.stored_shells import Nearby, StoredShells, require_shares
from harness.strata import ShellDesign
from harness.vocabulary import FAMILIES

N_REPLICATES = 50
CONFIDENCE, QUANTILE = 0.9, 1.645
_OPTION = "harness sensitivity"


@dataclass(frozen=True)
class Move:
    """Environments of a `Bar`, by the numbers that are other in each."""

    what: str
    known: Literal["fitted", "assumed"]
    values: tuple[float, float] | None
    settings: Sequence[Mapping[str, float]]


@checked("harness.sensitivity")
def sensitivity(
    folder: str | Path, *, ranges: Mapping[str, tuple[float, float]] | None = None, progress: Progress | None = None
) -> dict[str, Any]:
    """Write ``sensitivity.json`` into the folder of a run of shells, and return its content (`Sensitivity`).

    Parameters
    ----------
    folder : str or Path
        Run folder.
    ranges : mapping, optional
        Lowest and highest value of numbers, by ``section.name``, besides those that the environment states.
    progress : Progress, optional
        Who is told how far it is.

    Raises `HarnessError`: the folder is no run of shells, a number is not there, or nothing is said to be uncertain.
    """
    folder, progress = Path(folder), progress or Progress()
    require_place(folder)
    if (folder / FAMILIES).is_file():
        each = ", ".join(f"`{_OPTION} {path.parent}`" for path in sorted(folder.glob(f"*/{MANIFEST}")))
        mend = f"Ask each scenario: {each}; or other exposures of the sum: `harness estimate {folder} --exposure …`."
        raise RunFolderError(str(folder), "a run of several scenarios", "the run folder of one", mend)
    tested = StoredShells.of(folder, progress, _OPTION)
    require_shares(tested)
    settings = tested.here.campaign.environment
    parameters = tested.here.parameters
    asked = list(moves(settings.parameters, parameters, tested.here.family.shipped, ranges or {}))
    if not asked:
        found = f"{settings.parameters}, of which no number has a standard error (se) or a range"
        number = next(reversed(parameters.numbers()), "section__name").replace("__", ".")
        mend = f"State one, e.g. --range {number}=LOW:HIGH."
        raise CampaignError(_OPTION, found, "numbers that are said to be uncertain", mend)
    results = tested.nearby([each for move in asked for each in move.settings], progress)
    bars = [bar_of(move, [next(results) for _ in move.settings]) for move in asked]
    driver = next((each.name for each in tested.design.references), "")
    bars += bar_of_readings(tested.design)
    ordered, traffic = tuple(sorted(bars, key=lambda bar: -bar.span)), Path(settings.parameters).stem
    content = finite_json(Sensitivity(tested.manifest["campaign_hash"], traffic, driver, ordered))
    write_sealed(folder / SENSITIVITY, content)
    return content


def moves(
    name: str, parameters: Parameters, shipped: Path, ranges: Mapping[str, tuple[float, float]]
) -> Iterator[Move]:
    """What is said to be uncertain of an environment, a shipped name or a file, and numbers with stated ``ranges``."""
    known = parameters.numbers()
    stated = {key.replace(".", "__"): ends for key, ends in ranges.items()}
    if unknown := sorted(set(stated) - set(known)):
        mend = f"Its numbers are named section.name, such as {next(reversed(known)).replace('__', '.')}."
        raise CampaignError("--range", unknown[0].replace("__", "."), f"a number of {name}", mend)
    for key, (low, high) in ranges.items():
        if not -math.inf < low < high < math.inf:
            expected = "two finite numbers, the lower first"
            raise CampaignError(f"--range {key}", f"{low:g}:{high:g}", expected, "Correct them, or change places.")
    blocks = {section: block for block, sections in parameters.blocks.items() for section in sections}
    if parameters.replicates is not None:
        rows = [parameters.as_if_unseen(row) for row in read_replicates(name, parameters, shipped)[:N_REPLICATES]]
        for block in parameters.blocks:
            columns = [key for key in rows[0] if blocks.get(key.split("__")[0]) == block]
            if columns:
                yield Move(block, "fitted", None, [{key: row[key] for key in columns} for row in rows])
    for key, number in known.items():
        if key.startswith("exposure__"):  # moves no rate per test
            continue
        what, value, se, ends = key.replace("__", "."), number.value, number.se, stated.get(key, number.range)
        if ends is not None:
            yield Move(what, "assumed", (ends[0], ends[1]), [{key: end} for end in ends])
        elif se is not None and parameters.replicates is None:
            ends = value - QUANTILE * se, value + QUANTILE * se
            yield Move(what, "fitted", ends, [{key: end} for end in ends])


def bar_of_readings(design: ShellDesign) -> list[Bar]:
    """By how much the ratio moves where the regulation's driver is read otherwise; none where only one reading is."""
    rates = dict(zip((each.name for each in design.references), design.reference_rate.tolist(), strict=True))
    first, *others = [rates[name] for name in design.readings] or [0.0]
    ends = [first / rate for rate in others if min(first, rate) > 0.0]
    known: Literal["assumed"] = "assumed"
    whole = (1.0, 1.0), (min([*ends, 1.0]), max([*ends, 1.0])), (0.0, 0.0)
    return [Bar(f"readings of {next(iter(rates))}", known, None, *whole, n=len(ends))] if ends else []


def bar_of(move: Move, results: Sequence[Nearby | None]) -> Bar:
    """What traffic moved to some ``results`` says; a block's ends are those of what can be answered, half at least."""
    nowhere = np.full((2, 2), np.nan)
    ends = np.array([nowhere[0] if each is None or each.refused else (each.rate, each.ratio) for each in results])
    off = np.array([np.nan if each is None else each.off for each in results])
    no_laws, unlike = results.count(None), sum(each is not None and each.refused for each in results)
    if move.values is None:
        tail, told = (1.0 - CONFIDENCE) / 2.0, ~np.isnan(ends[:, 0])
        known, enough = ends[told], 2 * np.count_nonzero(told) >= len(results)
        ends = np.quantile(known, [tail, 1.0 - tail], axis=0) if enough else nowhere
        nearest = [int(np.argmin(np.abs(known[:, 0] - end))) for end in ends[:, 0]] if enough else []
        off = off[told][nearest] if enough else nowhere[0]
    rate, ratio, most_off = ((float(low), float(high)) for low, high in (*ends.T, off))
    told_by = {"n": len(results), "no_laws": no_laws, "unlike": unlike}
    return Bar(move.what, move.known, move.values, rate, ratio, most_off, **told_by)
