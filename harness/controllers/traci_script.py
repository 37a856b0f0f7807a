"""A TraCI script as it is: each test is one run of it, in a greenlet, with the facade in the place of ``traci``.

Where the script calls ``simulationStep`` it hands over to the harness, and goes on a step later. That takes a greenlet
half a microsecond, a thread 29; and it is the main thread, in which a script that never steps can be interrupted.
"""

from __future__ import annotations

import builtins
import importlib
import random
import sys
from collections.abc import Callable, Sequence
from contextlib import suppress
from functools import partial, reduce
from importlib.machinery import ModuleSpec, PathFinder, SourceFileLoader
from itertools import pairwise
from pathlib import Path
from types import CodeType, ModuleType
from typing import Any
from xml.etree import ElementTree

from greenlet import GreenletExit, getcurrent, greenlet

from harness.campaign.python_files import TRACI_MODULES, FromSource, file_and_function
from harness.controllers.protocol import EpisodeStart, Observation
from harness.controllers.traci_refused import Domain, FatalTraCIError, RefusedError
from harness.controllers.traci_style import SimulationDomain, Traci
from harness.controllers.traci_vehicle import DECEL, LOOSE, VehicleDomain, known_variables
from harness.files import real_path
from harness.vehicles.kinematics import STEP_S

_ROUNDING = 1e-9
_PATIENCE = 100
"""Steps that a script may ask for when its simulation has ended; a loop that no error ends is left where it is."""
_LEFT = list[greenlet]()
_OF_LIBSUMO = "FatalTraCIError", "StepListener", "TraCIException", "setLegacyGetLeader"
_VERSION = 22, "SUMO 1.28.0"
_OF_SIMULATION = {
    0x66: "getTime", 0x71: "getLoadedNumber", 0x72: "getLoadedIDList", 0x73: "getDepartedNumber",
    0x74: "getDepartedIDList", 0x79: "getArrivedNumber", 0x7A: "getArrivedIDList", 0x7B: "getDeltaT",
    0x7D: "getMinExpectedNumber", 0x80: "getCollidingVehiclesNumber", 0x81: "getCollidingVehiclesIDList",
}  # fmt: skip
"""What can be subscribed to, by numbers of ``traci.constants``."""


class ScriptError(Exception):
    """A script that ends before its test does, or never."""


class _Simulation(SimulationDomain):
    """Vehicles depart in the first step, and have arrived when the test has ended."""

    over = False
    n_steps = 0
    step_s = STEP_S

    def __init__(self, vehicles: VehicleDomain) -> None:
        self._vehicles = vehicles
        self.arrived: tuple[str, ...] = ()
        self._subscribed: tuple[int, ...] = ()

    def subscribe(self, varIDs: Sequence[int] = (0x74,), *_when: Any, **_how: Any) -> None:
        """Ask for variables, for the whole test; by default who departs."""
        self._subscribed += known_variables(varIDs, _OF_SIMULATION, "the simulation")

    def getSubscriptionResults(self) -> dict[int, Any]:
        return {number: getattr(self, _OF_SIMULATION[number])() for number in self._subscribed}

    def getDepartedIDList(self) -> tuple[str, ...]:
        return self._vehicles.getIDList() if self.n_steps == 1 else ()

    def getArrivedIDList(self) -> tuple[str, ...]:  # type: ignore[override]
        return self.arrived

    def getDeltaT(self) -> float:
        return self.step_s

    def getMinExpectedNumber(self) -> int:
        return self._vehicles.getIDCount()

    def getDepartedNumber(self) -> int:
        return len(self.getDepartedIDList())

    def getArrivedNumber(self) -> int:
        return len(self.arrived)

    getLoadedIDList, getLoadedNumber = getDepartedIDList, getDepartedNumber


class _Lanes(Domain):
    """``traci.lane``: each has the speed at which the AV cruises for its limit."""

    _path = "traci.lane"

    def __init__(self, vehicles: VehicleDomain) -> None:
        self.getMaxSpeed = lambda _laneID: vehicles.set_speed_mps


class _Routes(Domain):
    """``traci.route``: of the one that its vehicle is added on."""

    _path = "traci.route"
    add = staticmethod(lambda *_arguments: None)


class _Gui(Domain):
    """``traci.gui``: nobody looks."""

    _path = "traci.gui"

    def __getattr__(self, name: str) -> Any:
        return lambda *_arguments, **_named: None


class ScriptTraci(Traci):
    """What stands for ``traci`` and ``libsumo`` in one run of a script; its time begins with the run."""

    simulation: _Simulation

    def __init__(self, vehicle: VehicleDomain) -> None:
        super().__init__()
        self.vehicle, self.simulation = vehicle, _Simulation(vehicle)
        self.gui, self.route, self.lane = _Gui(), _Routes(), _Lanes(vehicle)
        self._listeners: dict[int, Any] = {}
        self._n_listeners = self._n_after = 0
        self.importing = False
        self.every = 0
        """Steps of the harness in one of the script's; 0 where it asks for none, and they are the same."""

    @property
    def StepListener(self) -> type:
        return importlib.import_module("traci").StepListener  # type: ignore[no-any-return]

    @property
    def __all__(self) -> list[str]:
        return [name for name in dir(self) if name in {*importlib.import_module("traci").__all__, *_OF_LIBSUMO}]

    def end(self) -> None:
        """Nobody is left."""
        self.simulation.over, self.simulation.arrived = True, self.vehicle.getIDList()
        self.vehicle.leave()

    def start(self, cmd: Any = (), *_arguments: Any, **_named: Any) -> tuple[int, str]:
        """Begin the run: the harness has begun the test. Of SUMO's options the step length counts."""
        if self.simulation.over:
            raise GreenletExit  # the next of a script that runs several: a test is one
        if self.simulation.n_steps:
            raise RefusedError("traci.start is refused after a step: each test is one run of the script.")
        if isinstance(cmd, list | tuple) and (step_length := _step_length([*map(str, cmd)])) is not None:
            (value, where), self.every = step_length, 0
            with suppress(ValueError, OverflowError):  # hours and minutes, nan, infinity
                self.every = round(float(value) / STEP_S)
            if self.every < 1 or abs(self.every * STEP_S - float(value)) > _ROUNDING:
                raise RefusedError(f"{where} {value} is refused: steps here are 0.1 s; ask for a multiple of it.")
            self.vehicle.step_s = self.simulation.step_s = self.every * STEP_S
        return _VERSION

    init = load = start
    getVersion = staticmethod(lambda: _VERSION)
    getLabel = staticmethod(lambda: "default")
    hasGUI = isLibsumo = isLibtraci = staticmethod(lambda: False)
    switch = setOrder = setTraceFile = staticmethod(lambda *_: None)

    def connect(self, *_arguments: Any, **_named: Any) -> ScriptTraci:
        self.start()
        return self

    def getConnection(self, label: str = "default") -> ScriptTraci:  # noqa: ARG002 - there is one
        return self

    def isLoaded(self) -> bool:
        return not self.simulation.over

    def close(self, wait: bool = True) -> None:  # noqa: ARG002 - TraCI's signature
        """End the run, when the test has ended; or because an error ends it."""
        if not self.simulation.over and sys.exc_info()[1] is None:
            raise RefusedError(f"traci.close is refused {self._early()}")

    def _early(self) -> str:
        time_s = self.simulation.time_s
        return f"after {time_s:g} s, before the test has ended: let the loop go on while getMinExpectedNumber() > 0."

    def require_unfinished(self, *, dead: bool) -> None:
        """Refuse a script that has returned (`ScriptError`)."""
        if dead:
            why = self._early() if self.simulation.n_steps else "without a step: it never calls simulationStep"
            raise ScriptError(f"the script returns {why}")

    def simulationStep(self, step: float = 0.0) -> list[Any]:
        """Hand over for a step, or until a time (s)."""
        if self.simulation.over:
            self._n_after += 1
            while self._n_after > _PATIENCE:
                _hand_over()
            raise FatalTraCIError("Connection closed by SUMO.")
        if not step:
            self._advance()
        while step - self.simulation.time_s > _ROUNDING and not self.simulation.over:
            self._advance()
        for number, listener in [*self._listeners.items()]:
            if not listener.step(step):
                self.removeStepListener(number)
        return []

    step = simulationStep

    def _advance(self) -> None:
        simulation = self.simulation
        if self.importing:
            raise RefusedError(
                "traci.simulationStep is refused while a module is imported: put the loop in a function."
            )
        if simulation.n_steps:  # what comes after the first is seen already
            _hand_over()
        simulation.n_steps += 1
        simulation.time_s = round(simulation.step_s * simulation.n_steps, 6)

    def addStepListener(self, listener: Any) -> int:
        self._n_listeners += 1
        self._listeners[self._n_listeners] = listener
        listener.setID(self._n_listeners)
        return self._n_listeners

    def removeStepListener(self, listenerID: int) -> bool:
        listener = self._listeners.pop(listenerID, None)
        getattr(listener, "cleanUp", lambda: None)()
        return listener is not None


def _step_length(options: Sequence[str]) -> tuple[str, str] | None:
    """The step length (s) in SUMO's options, or in the configuration file that they name; and where that is said."""
    named = {**dict(pairwise(options)), **dict(option.split("=", 1) for option in options if "=" in option)}
    if "--step-length" in named:
        return named["--step-length"], "--step-length"
    for name in (option.rpartition("=")[2] for option in options):
        if name.endswith("cfg") and Path(name).is_file():
            with suppress(ElementTree.ParseError):
                element = ElementTree.parse(name).find(".//step-length")  # noqa: S314 - the user's own
                return None if element is None else (element.get("value", ""), f"the step-length of {name},")
    return None


def _hand_over() -> None:
    harness = getcurrent().parent
    if harness is None:
        raise RefusedError("traci.simulationStep is refused in a thread: call it where the script begins.")
    harness.switch()


class _Beside(FromSource):
    """Loads a module that lies beside the script, for one run."""

    imports: _Imports

    def get_code(self, fullname: str) -> CodeType:
        if fullname not in self.imports.codes:
            self.imports.codes[fullname] = super().get_code(fullname)
        return self.imports.codes[fullname]

    def exec_module(self, module: ModuleType) -> None:
        vars(module)["__builtins__"] = self.imports.builtins
        super().exec_module(module)


class _Imports:
    """What one run imports: the facade, random numbers of its own, and copies of its own of modules beside it."""

    def __init__(self, folder: str, codes: dict[str, CodeType], traci: ScriptTraci, seed: Callable[[], int]) -> None:
        self._folder, self.codes, self._traci, self._seed = folder, codes, traci, seed
        self._random: Any = None
        self._own: dict[str, ModuleType] = {}
        self._names = set[str]()
        self.builtins = {**vars(builtins), "__import__": self._import}

    def _import(self, name: str, namespace: Any = None, local: Any = None, fromlist: Any = (), level: int = 0) -> Any:
        top, *rest = name.split(".")
        if level == 0 and top in TRACI_MODULES:
            return reduce(getattr, rest if fromlist else (), self._traci)
        if level == 0 and name == "random":
            if self._random is None:
                self._random = random.Random(self._seed())  # noqa: S311 - for simulation
                vars(self._random).update(Random=random.Random, SystemRandom=random.SystemRandom)
            return self._random
        if self._traci.importing:
            return builtins.__import__(name, namespace, local, fromlist, level)
        self._traci.importing = True
        sys.modules.update(self._own)
        sys.meta_path.insert(0, self)
        try:
            return builtins.__import__(name, namespace, local, fromlist, level)
        finally:
            self._traci.importing = False
            sys.meta_path.remove(self)
            self._own |= {module: sys.modules.pop(module) for module in self._names if module in sys.modules}

    def find_spec(self, name: str, path: Any = None, target: Any = None) -> ModuleSpec | None:  # noqa: ARG002
        """As a finder of ``sys.meta_path``."""
        if (top := name.partition(".")[0]) in sys.modules and top not in self._names:
            return None
        spec = PathFinder.find_spec(name, [self._folder] if path is None else path)
        if spec is None or not isinstance(spec.loader, SourceFileLoader):
            return None
        self._names.add(name)
        spec.loader = loader = _Beside(name, spec.loader.path)
        loader.imports = self
        return spec


class TraciScript:
    """A script: its file, ``file.py``, or a function of it, ``file.py:main``; compiled once.

    Parameters become keyword arguments of the function; without one, options of the command line.
    """

    def __init__(self, name: str, parameters: dict[str, Any]) -> None:
        file, self._function = file_and_function(name)
        self._file = real_path(file)
        self._parameters = parameters
        options = [f"--{key}" if value is True else f"--{key}={value}" for key, value in parameters.items()]
        self.argv = [str(self._file), *([] if self._function else options)]
        self._codes: dict[str, CodeType] = {}
        """Of the modules beside it, by name."""
        self._code: CodeType = compile(self._file.read_bytes(), self._file, "exec")

    def run(self, traci: ScriptTraci, seed: Callable[[], int]) -> None:
        """Once, from the beginning, with globals of its own."""
        module = ModuleType(f"{self._file.stem}_script" if self._function else "__main__")
        if self._function:  # dataclasses look their module up
            sys.modules[module.__name__] = module
        imports = _Imports(str(self._file.parent), self._codes, traci, seed)
        vars(module).update(__file__=str(self._file), __builtins__=imports.builtins)
        exec(self._code, vars(module))  # noqa: S102 - the user's own
        if self._function:
            vars(module)[self._function](**self._parameters)


class ScriptController:
    """Runs a script once a test; see `harness.controllers.VehicleController`."""

    traci: ScriptTraci

    def __init__(self, script: TraciScript, vehicle: Callable[[float, str, str], VehicleDomain]) -> None:
        self._script, self._vehicle = script, vehicle
        self._run: greenlet | None = None
        self._held, self._left = 0.0, 0
        """Acceleration of the script's step under way (m/s²), and how many of the harness's are left of it."""

    def start(self, episode: EpisodeStart) -> None:
        with suppress(ScriptError):  # the last test's
            self.close()
        self.traci = ScriptTraci(self._vehicle(episode.set_speed_mps, episode.lv_name, episode.bv_name))
        self._path = [*sys.path]  # which scripts append to, each run again
        self._left, seed = 0, partial(episode.random.integers, 2**63)
        self._run = greenlet(partial(self._script.run, self.traci, lambda: int(seed())))

    def step(self, observation: Observation) -> float:
        if not self._left:
            self.traci.vehicle.see(observation)
            self._turn()
            self._held, self._left = self.traci.vehicle.next_acceleration(), self.traci.every or 1
        self._left -= 1
        return self._held

    def told_at(self) -> str:
        """`` (my_script.py:12)``: where the script gave its last command; and if ``decel`` did not bound it, why."""
        file, line, mode = self.traci.vehicle.told_at
        return f" ({Path(file).name}:{line}){'' if mode & DECEL else LOOSE.format(mode)}"

    def _turn(self) -> None:
        assert self._run is not None
        (argv, sys.argv), (path, sys.path) = (sys.argv, self._script.argv), (sys.path, self._path)
        try:
            self._run.switch()
        finally:
            sys.argv, sys.path = argv, path
        if RefusedError.last is not None:
            raise RefusedError.last
        self.traci.require_unfinished(dead=self._run.dead)

    def close(self) -> None:
        """Let the last run meet the end of its simulation; what it raises then is nobody's concern."""
        run, self._run = self._run, None
        if not run or run.dead:  # a greenlet is true while it runs
            return
        self.traci.end()
        with suppress(Exception, SystemExit):
            run.switch()
        if not run.dead:
            _LEFT.append(run)
            raise ScriptError("the script goes on when its simulation has ended: no FatalTraCIError ends its loop")
