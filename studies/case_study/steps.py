"""Make the steps of a study that are not made yet, each in a folder named after all that it depends on.

A step's key is a hash of its settings, of the content of the campaign or experiment that it names, of the code that
makes it, and of the keys of the steps that it reads. ``steps/NAME-KEY/result.json`` is written last, all at once: where
it is, the step is finished; where it is not, it is made again.
"""

from __future__ import annotations

import hashlib
import json
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

from harness.campaign.files import load_campaign
from harness.compiled import WORLD_SOURCES, source_hash
from harness.estimators.estimate import finite_json
from harness.progress import Progress
from harness.records.folder import read_as, sole_use, write_sealed
from harness.resolved import resolve
from studies.case_study.counted import compare_control_variates, count_required_tests, draw_convergence
from studies.case_study.page import write_page
from studies.case_study.repeated import test_variants, variants_of
from studies.case_study.small_case import answer_small_case
from studies.case_study.study import Context, Made, Step, Study, inputs_of
from studies.case_study.tested import keep_run, test_in_twin
from studies.case_study.theorems import check_theorems
from studies.work import sources_of

RESULT = "result.json"
_MAKERS: dict[str, Callable[[Any, Context], dict[str, Any]]] = {
    "twin_tests": test_in_twin,
    "run": keep_run,
    "convergence": draw_convergence,
    "control_variates": compare_control_variates,
    "required_tests": count_required_tests,
    "variants": test_variants,
    "theorems": check_theorems,
    "small_case": answer_small_case,
}


def run_study(study: Study, folder: Path, workers: int | None, progress: Progress) -> dict[str, Any]:
    """Make what is missing, and the page, in a folder that is new, empty, or that of an earlier study.

    Worker processes, one per core by default, change no result. Returned are the place of the page, and the seconds
    that each step took, None for one that was there before.

    Raises `HarnessError`: a file that a step names is wrong, which shows before any step is made; or the folder cannot
    be used.
    """
    keys = step_keys(study)
    made: dict[str, Made] = {}
    seconds: dict[str, float | None] = {}
    with sole_use(folder):
        for name, step in study.steps.items():
            place = folder / "steps" / f"{name}-{keys[name]}"
            seconds[name] = None
            if not (place / RESULT).is_file():
                began = time.monotonic()
                context = Context(place, study.rhw, study.confidence, made, workers, progress)
                write_sealed(place / RESULT, finite_json({"kind": step.kind, **_MAKERS[step.kind](step, context)}))
                seconds[name] = time.monotonic() - began
            result = read_as(dict[str, Any], place / RESULT, mend="Delete the folder of this step; it is made again.")
            made[name] = Made(place, result)
        return {"page": str(write_page(study, folder, made)), "seconds": seconds}


def step_keys(study: Study) -> dict[str, str]:
    """Key of every step, in their order; reads all files that the steps name."""
    keys: dict[str, str] = {}
    for name, step in study.steps.items():
        if step.kind in ("twin_tests", "run"):  # long ones, whose records follow from these sources alone
            code = source_hash(WORLD_SOURCES), sources_of("case_study/tested.py", "rnot.py")
        else:
            made_by = "*.py", "chains/*.py", "replication/*.py", "case_study/[!p]*.py"  # not page.py and plots.py
            code = source_hash((*WORLD_SOURCES, "estimators/*.py")), sources_of(*made_by)
        content = {
            "step": step.model_dump(mode="json", exclude={"campaign"}),
            "file": _content(step),
            "reads": [(key, keys[wanted]) for key, wanted in inputs_of(step)],
            "asks": (study.rhw, study.confidence),
            "code": code,
        }
        keys[name] = hashlib.sha256(json.dumps(content, sort_keys=True).encode()).hexdigest()[:12]
    return keys


def _content(step: Step) -> Any:
    """What the file that a step names says, laid-over values included."""
    if step.kind in ("twin_tests", "run"):
        campaign = load_campaign(step.campaign, step.set)
        return campaign.model_dump(mode="json", exclude={"run"}), resolve(campaign).content_hash
    if step.kind == "variants":
        forms = variants_of(step).items()
        return [(name, one.model_dump(mode="json", exclude={"run"}), resolve(one).content_hash) for name, one in forms]
    return None
