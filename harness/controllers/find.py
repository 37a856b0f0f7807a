"""Find the controller that a campaign names, and put the right host around it; run it in a process of its own."""

from __future__ import annotations

import importlib
import math
import os
import re
import sys
import traceback
from collections.abc import Callable, Iterable
from contextlib import suppress
from copy import deepcopy
from functools import cache, partial
from hashlib import sha256
from importlib.util import module_from_spec, spec_from_file_location
from inspect import Parameter, Signature, isfunction, signature
from operator import methodcaller
from pathlib import Path
from threading import RLock
from types import ModuleType, SimpleNamespace
from typing import Any, TypeVar

from harness.campaign.python_files import (
    FromSource,
    file_and_function,
    files_imported,
    import_from,
    in_python_file,
    is_script,
    is_users,
)
from harness.campaign.vehicle import AutomatedVehicle
from harness.controllers.hosts import (
    BatchHost,
    BeforeTest,
    ControllerHost,
    Guard,
    VehicleHost,
    cause_of,
    death_cause,
    require_ours,
)
from harness.controllers.traci_style import WAITS, StepListenerController, TriedScript
from harness.errors import EXIT_TOO_MANY_FAILED, CampaignError, HarnessError
from harness.files import real_path
from harness.problems import did_you_mean, nearest
from harness.processes import Child, WorkerDeath, first_to_answer, tell

_Answer = TypeVar("_Answer")
_RUNNING = RLock()  # a file: surrogates' tables are made side by side, and none may see half of it
_tell_once = cache(lambda note: sys.stderr.write(f"note: {note}.\n"))


class AvEndedProcessError(HarnessError):
    """The AV's controller ended the process that it ran in."""

    exit_code = EXIT_TOO_MANY_FAILED


def own_code(
    name: str, where: str = "av.controller", what: str = "a class with step(self, seen), or a function step(seen)"
) -> Callable[..., Any]:
    """The class, or function, that a name stands for: ``my_av.py:Class`` or ``package.module:Class``.

    Importable are this folder, as for a script, and that of a file. Raises `CampaignError`, of the key ``where``: there
    is no such module, or nothing in it that is ``what`` it has to be.
    """
    module_name, _, class_name = name.rpartition(":")
    is_file = module_name.endswith(".py")
    import_from(real_path(Path(module_name).parent) if is_file else Path.cwd())
    try:
        module = _of_file(Path(module_name)) if is_file else importlib.import_module(module_name)
    except KeyboardInterrupt:
        raise
    except BaseException as error:  # of asyncio and pytest, too
        cause = f"{name}, whose module cannot be imported ({cause_of(error)})"
        suggestion = did_you_mean(module_name, [file.stem for file in Path.cwd().glob("*.py")])
        of_file = f"Fix {module_name}." if Path(module_name).exists() else "Put it back, or name another."
        mend = of_file if is_file else "Name its file, my_av.py:Class, or install it beside the harness."
        raise CampaignError(where, cause, "a Python module that can be imported", suggestion or mend) from error
    member = getattr(module, class_name, None)
    if not callable(member):
        own = [k for k, v in vars(module).items() if callable(v) and getattr(v, "__module__", "") == module.__name__]
        lacks = f"no class or function {class_name} in {getattr(module, '__file__', module_name)}"
        mend = did_you_mean(class_name, own) or f"It has: {', '.join(own) or 'none'}."
        raise CampaignError(where, lacks, what, mend)
    return member  # type: ignore[no-any-return]


def source_of_own(name: str, where: str) -> str:
    """What ``my.py:function`` is, wherever it lies: its name and a hash of its file and what this imports beside it.

    None of it is run. Raises `CampaignError`, of the key ``where``: there is no such file.
    """
    file, _, function = name.rpartition(":")
    if not Path(file).is_file():
        raise CampaignError(where, f"no file {file}", "a Python file", "Correct the path, or put the file there again.")
    path = real_path(Path(file))
    return f"{function} {_hash_of_all(map(str, files_imported(path, path.parent)))}"


def _of_file(file: Path) -> ModuleType:
    """The module that a file makes; its name is not that of another file, or of an installed module, of this name."""
    name = f"{file.stem}_{sha256(bytes(real_path(file))).hexdigest()[:8]}"
    with _RUNNING:
        if name not in sys.modules:
            loader = FromSource(name, str(file))
            spec = spec_from_file_location(name, file, loader=loader)
            assert spec is not None
            sys.modules[name] = module_from_spec(spec)
            try:
                loader.exec_module(sys.modules[name])
            except BaseException:
                del sys.modules[name]
                raise
    return sys.modules[name]


def build_host(
    av: AutomatedVehicle,
    *,
    n_cells: int,
    seed: int,
    before_test: BeforeTest = lambda _: None,
    names: tuple[str, str] = ("LV", "BV"),
) -> ControllerHost | None:
    """Host of the AV's controller, which sees vehicles of these ``names`` as LV and BV; None for an AV that needs none.

    Raises `CampaignError`: the controller cannot be found or made, or is of neither kind.
    """
    if not has_foreign_code(av):
        return None
    options = av, seed, (guard := Guard(av.limits)), before_test
    if av.fmu is not None:
        from harness.controllers.fmu import fmu_maker  # noqa: PLC0415 - an extra

        return VehicleHost(*options, fmu_maker(av.fmu), n_cells, names=names)
    try:
        with guard:
            guard.limit(makes=True)
            make = _script(av, guard) or _maker(av)
        guard.modes.restored()  # imported libraries that were compiled for speed change how this thread computes
        first = _made(make, str(av.controller), guard)
        is_batch = _is_batch(first)
    except (HarnessError, KeyboardInterrupt):
        raise
    except BaseException as error:  # who looks for an attribute runs the user's code, too
        raise _not_made(str(av.controller), cause_of(error)) from error
    finally:
        guard.require_untouched()
    if is_batch:
        return BatchHost(*options, first, names=names)
    told_at = methodcaller("told_at") if is_script(str(av.controller)) else lambda _: ""
    return VehicleHost(*options, make, n_cells, first, told_at, names=names)


def _script(av: AutomatedVehicle, guard: Guard) -> Callable[[], Any] | None:
    if (name := str(av.controller)).endswith(".py") and not is_script(name):
        found, mend = f"{name}, which does not import traci", in_python_file(name) or "Name its class: my_av.py:Class."
        raise CampaignError("av.controller", found, "a TraCI script, or a class or function of a file", mend)
    if not is_script(name):
        file, function = file_and_function(name)
        if is_script(file) and function not in re.findall(r"\w+", Path(file).read_text("utf-8", "replace")):
            expected = "a function without arguments, or a class"  # importing it would start SUMO
            mend = in_python_file(file) or f"Name the script itself: {file}."
            raise CampaignError("av.controller", f"no {function} in {file}", expected, mend)
        return None
    from harness.controllers.traci_ego import script_maker  # noqa: PLC0415 - few campaigns have one

    return script_maker(av, guard)


def _maker(av: AutomatedVehicle) -> Callable[[], Any]:
    """What makes controllers, each with a copy of the parameters: one may change a list among them for itself alone."""
    name = str(av.controller)
    target = own_code(name)
    parameters = av.parameters if isinstance(av.parameters, dict) else {}
    make, handed = _as_class(target, name)
    try:
        if "loaded" in handed:
            make, parameters = _loaded_once(target, make, parameters)
        _signature(target).bind(**handed, **parameters)
    except TypeError as error:
        loads = _signature(getattr(target, "load")).parameters if "loaded" in handed else {}  # noqa: B009 - has one
        takes = [key for key in {**loads, **_signature(target).parameters} if key not in handed]
        wrong = next((key for key in parameters if key not in takes), "")
        what = f"{', '.join(parameters) or 'none'}, with which {name} cannot be made ({error})"
        missing = re.findall(r"argument: '(\w+)'", str(error)) or ["NAME"]
        mend = f"Give what it needs: --set av.parameters.{missing[0]}=…; or correct its code."
        mend = f"Leave out av.parameters.{wrong}." if "unexpected" in str(error) else mend
        mend = "Write @staticmethod above load." if missing[0] == "self" else mend
        expected = f"keyword arguments of the controller: {', '.join(takes) or 'it has none'}"
        raise CampaignError("av.parameters", what, expected, did_you_mean(wrong, takes) or mend) from error
    return lambda: make(**deepcopy(parameters))


def _loaded_once(
    target: Any, make: Callable[..., Any], parameters: dict[str, Any]
) -> tuple[Callable[..., Any], dict[str, Any]]:
    """What makes controllers, all handed the one object that ``load`` returns; and the parameters left for them."""
    own, of_load = _signature(target).parameters, _signature(target.load).parameters
    loading = deepcopy({key: value for key, value in parameters.items() if key in of_load})
    _signature(target.load).bind(**loading)
    load = cache(partial(target.load, **loading))
    others = {key: value for key, value in parameters.items() if key in own or key not in of_load}
    if isinstance(make, partial):  # a listener, which is made anew in every test
        return lambda **keywords: StepListenerController(partial(target, loaded=load()), **keywords), others
    return lambda **keywords: make(loaded=load(), **keywords), others


def _as_class(target: Callable[..., Any], name: str) -> tuple[Callable[..., Any], dict[str, Any]]:
    """What makes a controller when called with the parameters; and what else ``target`` is handed, by name.

    A class needs a step; a function is itself the vehicle, and its first argument is what the vehicle sees.
    """
    takes = _signature(target).parameters
    first = next(iter(takes.values()), None)
    if isfunction(target) and first is not None and first.default is Parameter.empty:
        return lambda **parameters: SimpleNamespace(step=partial(target, **parameters)), {first.name: None}
    _require_controller(target if isinstance(target, type) else None, name)
    handed = {"loaded": None} if "loaded" in takes and callable(getattr(target, "load", None)) else {}
    if "traci" in takes and not _is_batch(target):
        return partial(StepListenerController, target), {"traci": None, **handed}
    return target, handed


def _signature(target: Callable[..., Any]) -> Signature:
    try:
        return signature(target)
    except ValueError:  # a class in C may have none
        return signature(lambda **parameters: parameters)


def _is_batch(made: Any) -> bool:
    return callable(getattr(made, "step_batch", None))


def _require_controller(made: Any, name: str) -> None:
    if not (callable(getattr(made, "step", None)) or _is_batch(made)):
        expected = "a function step(seen), or a class with step (per vehicle) or step_batch (arrays)"
        mend = "Write def step(self, seen): return 0.0, say: m/s², every 0.1 s (docs/controllers.md)."
        wraps = "It has predict: wrap it as docs/policies.md shows (Any agent with `predict`)."
        mend = wraps if hasattr(made, "predict") else mend
        if meant := nearest("step", [each for each in dir(made) if each[0] != "_" and each != "step"]):
            mend = f"Rename {meant} to step."
        raise CampaignError("av.controller", f"{name} without step", expected, mend)


def _made(make: Callable[[], Any], name: str, guard: Guard) -> Any:
    """Make one controller, so that what its constructor refuses is an error of the campaign, not of every episode."""
    with guard:
        controller, wrong = guard.call(make, makes=True)
    if wrong is not None:
        raise _not_made(name, wrong)
    _require_controller(controller, name)
    batch = {"step_batch": "seen", "start_batch": "cells, episodes, random"}
    for method, arguments in (batch if _is_batch(controller) else {"step": "seen", "start": "episode"}).items():
        if not callable(made := getattr(controller, method, None)):
            continue  # step is there, others need not be
        with suppress(ValueError):  # one in C may have no signature
            takes = signature(made)
            try:
                takes.bind(*arguments.split(","))
            except TypeError as error:
                found, expected = f"{name}, whose {method} takes {takes} ({error})", f"{method}(self, {arguments})"
                raise CampaignError("av.controller", found, expected, f"Write def {expected}: in it.") from error
    return controller


def _not_made(name: str, why: str) -> CampaignError:
    mend = "Fix it, or work where the files are that it reads; a new run may name others: --set av.parameters.NAME=…"
    return CampaignError("av.controller", f"{name}, which cannot be made: {why}", "a controller", mend)


def has_foreign_code(av: AutomatedVehicle) -> bool:
    """Whether the AV is code of the user's that runs inside of the harness's own processes."""
    return av.source in ("controller", "fmu")


def in_words(av: AutomatedVehicle, work: Callable[[], _Answer]) -> _Answer:
    """Do some work in the process of an AV; what foreign code there breaks of the harness is a `CampaignError`."""
    try:
        return work()
    except (HarnessError, MemoryError):
        raise
    except Exception as error:
        if not has_foreign_code(av):
            raise
        require_ours(error)
        if isinstance(error, OSError):  # a full disk, say
            raise
        found = f"a vehicle after whose code the harness fails in its process: {type(error).__name__}: {error}"
        sys.stderr.write(f"{found}\n{''.join(traceback.format_exception(error))}")  # a run keeps what is printed
        mend = "Leave all but your own objects as they are. If --av idm fails, too, report it, with what was printed."
        raise CampaignError(f"av.{av.source}", found, "code that changes its own objects alone", mend) from error


def run_apart(av: AutomatedVehicle, work: Callable[..., _Answer], *arguments: Any) -> _Answer:
    """Call ``work(*arguments)``, which runs an AV, in a process of its own where that `has_foreign_code`.

    Raises whatever that raises, or an `AvEndedProcessError` if the controller ended the process.
    """
    if not has_foreign_code(av):
        return work(*arguments)
    child = Child(tell, partial(in_words, av, partial(work, *arguments)))
    try:
        answer = first_to_answer([child]).answer()
    finally:
        child.kill()
    if isinstance(answer, WorkerDeath):
        found = death_cause(answer.exit_code, av.limits)
        mend = "Look for os._exit, a crash of compiled code, or a shortage of memory; then check again."
        raise AvEndedProcessError(f"av.{av.source}", found, "a controller that returns or raises", mend)
    return answer  # type: ignore[no-any-return]


def require_controller(av: AutomatedVehicle) -> str | None:
    """Find and make an AV's controller once, before anything is written, in a process of its own.

    Returns a SHA-256 of what it is made of: its file, modules of the user's that this imports, and files that
    ``av.parameters`` names; None for an AV without a source. Raises `CampaignError` as `build_host`.
    """
    if not has_foreign_code(av):
        return None
    try:
        return run_apart(av, _sources_of_made, av)
    except AvEndedProcessError as error:
        raise CampaignError(error.where, error.found, "a controller that can be made", error.mend) from error


MOST_IDLE_S = 10.0
"""Time after which a script is refused that has not looked at a vehicle: most events are over [assumed]."""


def tried_script(av: AutomatedVehicle) -> TriedScript | None:
    """What a TraCI script does; None of any other controller. What its type bounds is said once, on stderr."""
    if not is_script(name := str(av.controller)):
        return None
    from harness.controllers.traci_ego import asked_for  # noqa: PLC0415 - few campaigns have one

    (tried, hardest, every), bound = run_apart(av, asked_for, av), av.traci_style.decel_mps2
    file = real_path(file_and_function(name)[0]).name
    if not every:
        note = "names no --step-length, nor does its .sumocfg: it is asked every 0.1 s, where SUMO would ask every 1 s"
        _tell_once(f"{file} {note}")
    if math.isinf(hardest):
        note = "sets a speed mode in which no decel bounds its braking, and a test fails where it is beyond av.limits"
        _tell_once(f"{file} {note}; for a bound use mode 30, and --set av.traci_style.decel_mps2=8, say")
    elif hardest > bound and "decel_mps2" not in av.traci_style.model_fields_set:
        note = f"asks for harder braking than {bound:g} m/s², the decel of SUMO's default type, and gets that"
        _tell_once(f"{file} {note}; of another type: --set av.traci_style.decel_mps2=8, say")
    if tried.idle_s > MOST_IDLE_S:
        found = f"{name}, which looks at no vehicle for {tried.idle_s:.0f} s"
        raise CampaignError("av.controller", found, "a script that drives from its start", WAITS)
    return tried


def _sources_of_made(av: AutomatedVehicle) -> str | None:
    parameters = av.parameters.values() if isinstance(av.parameters, dict) else ()
    # A file that it writes when it is made is not what it is made of.
    hashes = {value: _hash_of(value) for value in parameters if isinstance(value, str)}
    build_host(av, n_cells=1, seed=0)  # what it holds ends with the process
    if av.controller is None:
        return None
    if is_script(av.controller):
        file, above = file_and_function(av.controller)[0], 0
    else:
        name = getattr(own_code(av.controller), "__module__", "")
        file = getattr(sys.modules.get(name), "__file__", None) or ""
        above = name.count(".")
        above += file.endswith("__init__.py")  # which stands within the package that it is
    files = {str(real_path(file)), *(name for name, digest in hashes.items() if digest == _hash_of(name))}
    if is_users(root := str(real_path(file).parents[above])):
        files |= {str(module) for module in files_imported(real_path(file), Path(root))}
    return _hash_of_all(files)


def _hash_of_all(files: Iterable[str]) -> str | None:
    contents = sorted(filter(None, map(_hash_of, files)))
    return sha256("".join(contents).encode()).hexdigest() if contents else None


def _hash_of(file: str) -> str | None:
    """SHA-256 of a file; None if there is none: a parameter may be no path, or one too long, or with a zero in it."""
    is_file = os.path.isfile(file)  # noqa: PTH113 - to pathlib a name too long is an error
    return sha256(Path(file).read_bytes()).hexdigest() if is_file else None
