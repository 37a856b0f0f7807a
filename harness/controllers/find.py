"""Find the controller that a campaign names, and put the right host around it; run it in a process of its own."""

from __future__ import annotations

import hashlib
import importlib
import sys
from collections.abc import Callable, Mapping
from contextlib import closing
from copy import deepcopy
from functools import partial
from importlib.metadata import entry_points
from inspect import signature
from multiprocessing.connection import Connection
from pathlib import Path
from typing import Any, TypeVar, get_type_hints

from harness.campaign.campaign import Campaign
from harness.campaign.vehicle import AutomatedVehicle
from harness.controllers.hosts import (
    BatchHost,
    ControllerHost,
    Death,
    Guard,
    VehicleHost,
    cause_of,
    death_cause,
)
from harness.controllers.protocol import BatchController
from harness.errors import EXIT_TOO_MANY_FAILED, CampaignError, HarnessError
from harness.processes import CONSTRUCTOR, Apart, ForkServer, WorkerDeath, first_to_answer, tell

GROUP = "harness.controllers"
_Answer = TypeVar("_Answer")


class AvEndedProcessError(HarnessError):
    """The AV's controller ended the process that it ran in."""

    exit_code = EXIT_TOO_MANY_FAILED


def controller_class(name: str) -> Callable[..., Any]:
    """The class that ``package.module:Class``, or an entry point of group ``harness.controllers``, names.

    The folder that the harness was started in is importable, as it is for a script. Where there is no such module,
    class or entry point, a `CampaignError` says so.
    """
    if ":" not in name:
        return _from_entry_point(name)
    module_name, _, class_name = name.partition(":")
    if (here := str(Path.cwd())) not in sys.path:
        sys.path.insert(0, here)
    try:
        module = importlib.import_module(module_name)
    except (Exception, SystemExit) as error:
        cause = f"{name}, whose module cannot be imported ({cause_of(error)})"
        mend = "Start the harness in the folder that holds it, or install it beside the harness."
        raise CampaignError("av.controller", cause, "a Python module that can be imported", mend) from error
    found = getattr(module, class_name, None)
    if not callable(found):
        what = f"no class {class_name} in {getattr(module, '__file__', module_name)}"
        mend = f"It has: {', '.join(name for name, value in vars(module).items() if isinstance(value, type))}."
        raise CampaignError("av.controller", what, "a controller class (see docs/controllers.md)", mend)
    return found  # type: ignore[no-any-return]


def _from_entry_point(name: str) -> Callable[..., Any]:
    points = entry_points(group=GROUP)
    if name not in points.names:
        expected = f"an entry point of group {GROUP}: {', '.join(sorted(points.names)) or 'none is installed'}"
        mend = "Install the package that brings it, or write 'package.module:Class'."
        raise CampaignError("av.controller", name, expected, mend)
    return points[name].load()  # type: ignore[no-any-return]


def build_host(
    av: AutomatedVehicle,
    *,
    n_cells: int,
    seed: int,
    black_box: Path | None = None,
    fatal_episodes: Mapping[int, Death] | None = None,
) -> ControllerHost | None:
    """Host of the AV's controller, or None for an AV that needs none (built in, or driven by SUMO).

    Raises `CampaignError`: the controller cannot be found or made, or is of neither kind.
    """
    if av.source not in ("controller", "fmu"):
        return None
    guard = Guard(av.limits, black_box)
    make: Callable[[], Any]
    if av.fmu is None:
        make = _maker(av)
        first = _made(make, str(av.controller), guard)
        if isinstance(first, BatchController):
            return BatchHost(first, av, seed, guard)
    else:
        from harness.controllers.fmu import fmu_maker  # noqa: PLC0415 - an extra

        make = fmu_maker(av.fmu)
    return VehicleHost(make, n_cells, av, seed, guard, fatal_episodes)


def _maker(av: AutomatedVehicle) -> Callable[[], Any]:
    """Makes controllers, each with parameters of its own: what one does to a list among them is nobody else's."""
    make = controller_class(str(av.controller))
    _require_controller(_what_it_makes(make), str(av.controller))
    parameters = av.parameters if isinstance(av.parameters, dict) else {}
    try:
        signature(make).bind(**parameters)
    except TypeError as error:
        found = f"{', '.join(parameters) or 'none'}, which {av.controller} does not take ({error})"
        mend = "Correct av.parameters, or the constructor."
        expected = "keyword arguments of the controller's constructor"
        raise CampaignError("av.parameters", found, expected, mend) from error
    except ValueError:
        pass  # a class in C may have no signature
    return lambda: make(**deepcopy(parameters))


def _what_it_makes(make: Callable[..., Any]) -> Any:
    """The class itself, or the one that a function says it returns: nothing else that a campaign names is called."""
    if isinstance(make, type):
        return make
    try:
        return get_type_hints(make).get("return")
    except Exception:  # noqa: BLE001 - hints are the user's code, too
        return None


def _require_controller(made: Any, name: str) -> None:
    missing = [method for method in ("start", "step", "close") if not callable(getattr(made, method, None))]
    if missing and not isinstance(made, BatchController):
        expected = "start, step and close (per vehicle), or start_batch, step_batch and close (arrays)"
        mend = (
            "See docs/controllers.md for both, in ten lines each. A function says what it makes: `def make() -> MyAv:`."
        )
        raise CampaignError("av.controller", f"{name} without {', '.join(missing)}", expected, mend)


def _made(make: Callable[[], Any], name: str, guard: Guard) -> Any:
    """Make one controller, so that what its constructor refuses is an error of the campaign, not of every episode."""
    with guard:
        controller, wrong = guard.call(CONSTRUCTOR, make, makes=True)
    if wrong is not None:
        mend = "Mend its constructor, or what it needs (av.parameters; av.limits.construction_time_s, if that is time)."
        raise CampaignError("av.controller", f"{name}, whose constructor failed: {wrong}", "a controller", mend)
    _require_controller(controller, name)
    return controller


def has_foreign_code(campaign: Campaign) -> bool:
    """Whether the AV is code of the user's that runs inside of the harness's own processes."""
    return campaign.av.source in ("controller", "fmu")


def run_apart(av: AutomatedVehicle, work: Callable[..., _Answer], *arguments: Any) -> _Answer:
    """``work(*arguments, black_box=…)``, which runs an AV, in a process of its own.

    Raises whatever that raises, or an `AvEndedProcessError` if the controller ended the process, naming the call.
    """
    with closing(ForkServer()) as server:
        child = Apart(server, _work_and_tell, work, arguments)
        try:
            answer = first_to_answer([child]).answer()
        finally:
            child.kill()
    if isinstance(answer, WorkerDeath):
        cause, call = death_cause(answer.exit_code, av.limits, answer.call), answer.call
        found = f"{cause}, {'while it was found' if call is None else f'in {call}'}"
        mend = "Look for os._exit, a crash of compiled code, or a shortage of memory; then check again."
        raise AvEndedProcessError(f"av.{av.source}", found, "a controller that returns or raises", mend)
    return answer  # type: ignore[no-any-return]


def _work_and_tell(
    connection: Connection, work: Callable[..., Any], arguments: tuple[Any, ...], black_box: Path
) -> None:
    tell(connection, partial(work, *arguments, black_box=black_box))


def require_controller(campaign: Campaign) -> str | None:
    """Find and make the AV's controller once, before anything is written, in a process of its own.

    Returns the SHA-256 of the source file of its class; None for an AV without one, or without a source. Raises a
    `CampaignError` if it cannot be found or made, or is of neither kind.
    """
    if not has_foreign_code(campaign):
        return None
    try:
        return run_apart(campaign.av, _source_of_made, campaign)
    except AvEndedProcessError as error:
        raise CampaignError(error.where, error.found, "a controller that can be made", error.mend) from error


def _source_of_made(campaign: Campaign, *, black_box: Path | None = None) -> str | None:
    av = campaign.av
    host = build_host(av, n_cells=1, seed=0, black_box=black_box)
    if host is not None:
        host.close()
    if av.controller is None:
        return None
    module = sys.modules.get(getattr(controller_class(av.controller), "__module__", ""))
    file = Path(getattr(module, "__file__", None) or "")
    return hashlib.sha256(file.read_bytes()).hexdigest() if file.is_file() else None
