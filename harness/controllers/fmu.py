"""FMI 2.0 co-simulation FMUs as controllers, by fmpy (extra ``harness[fmi]``).

An FMU is unpacked once, into the cache, and instantiated once per cell. An episode begins with a reset, or with a new
instance where the FMU refuses to be reset. Its clock is that of the episode: the experiment starts at the time of the
controller's first step, and each step is ``doStep`` over 0.1 s between setting the inputs and reading the output.
"""

from __future__ import annotations

import errno
import re
import shutil
import uuid
import zipfile
from collections.abc import Callable, Sequence
from contextlib import suppress
from functools import partial
from operator import attrgetter
from pathlib import Path
from typing import Any, NamedTuple

from harness import cache
from harness.campaign.vehicle import FmuController
from harness.controllers.protocol import BatchObservation, EpisodeStart, Observation, VehicleController
from harness.errors import OF_THE_DISK, CampaignError, HarnessError, writing
from harness.files import checksum, content_hash
from harness.problems import did_you_mean
from harness.vehicles.kinematics import STEP_S

OBSERVATIONS: dict[str, Callable[[Observation], float]] = {
    name: attrgetter(re.sub("^(bv|lv)_(position|speed|lane)", r"\1.\2", name)) for name in BatchObservation._fields[2:]
}
"""What an FMU's inputs can be connected to, named as in `BatchObservation`: ``bv_lane`` is ``bv.lane``."""
_NOT_THE_FMUS = (*OF_THE_DISK, errno.EACCES, errno.EPERM, errno.EROFS)
"""Errors that unpacking a sound FMU meets as well."""


class Wiring(NamedTuple):
    """A campaign checked against a description: value references (FMI 2.0 section 2.2.7) in a fixed order."""

    inputs: list[int]
    readings: list[Callable[[Observation], float]]
    output: int
    start_references: list[int]
    start_values: list[float]


def fmu_maker(fmu: FmuController) -> Callable[[], VehicleController]:
    """What makes a controller for a cell.

    Raises `CampaignError`: no fmpy, no FMI 2.0 co-simulation FMU, or an ``av.fmu`` that does not fit its variables.
    """
    fmpy = _fmpy()
    try:
        folder = _unpacked(Path(fmu.file))
        description = fmpy.read_model_description(str(folder))
    except Exception as error:
        if isinstance(error, HarnessError) or (isinstance(error, OSError) and error.errno in _NOT_THE_FMUS):
            raise  # it names the file or the cache: nothing is wrong with the FMU
        found = f"{fmu.file}, which cannot be read ({' '.join(str(error).split())[:300]})"
        mend = "Export it again, and try 'fmpy validate' on it."
        raise CampaignError("av.fmu.file", found, "an FMI 2.0 co-simulation FMU", mend) from error
    if not str(description.fmiVersion).startswith("2.") or description.coSimulation is None:
        kind = "model exchange" if description.coSimulation is None else "co-simulation"
        found = f"{fmu.file}, for FMI {description.fmiVersion} {kind}"
        mend = "Export the model as a co-simulation FMU of that version."
        raise CampaignError("av.fmu.file", found, "FMI 2.0 co-simulation", mend)
    wiring = wire(fmu, description)
    made: list[FmuVehicleController] = []

    def make() -> VehicleController:
        if description.coSimulation.canBeInstantiatedOnlyOncePerProcess and made:
            raise RuntimeError("the FMU can be instantiated only once per process: set world.cells to 1")
        made[:] = [FmuVehicleController(wiring, description, folder)]
        return made[0]

    return make


def _fmpy() -> Any:
    try:
        import fmpy  # noqa: PLC0415 - an extra
        import fmpy.fmi2  # noqa: PLC0415 - an extra
    except ImportError as error:
        mend = "Install it, in the harness's folder: pip install -c requirements.lock -e '.[fmi]'."
        raise CampaignError("av.fmu", "no package fmpy", "the extra for FMUs", mend) from error
    return fmpy


def _unpacked(file: Path) -> Path:
    """Folder with the FMU's content, in the cache, by its hash: workers share it."""
    name = f"fmu/{content_hash(file.read_bytes())}"
    with zipfile.ZipFile(file) as archive:
        sound = (folder for folder in cache.places(name) if _is_whole(folder, archive))
        return next(sound, None) or cache.put(name, partial(_unpack, archive))


def _is_whole(folder: Path, archive: zipfile.ZipFile) -> bool:
    files = ((folder / entry.filename, entry.CRC) for entry in archive.infolist() if not entry.is_dir())
    with suppress(OSError):
        return all(file.is_file() and checksum(file) == crc for file, crc in files)
    return False


def _unpack(archive: zipfile.ZipFile, folder: Path) -> None:
    fresh = folder.with_name(f"{folder.name}-{uuid.uuid4().hex}")
    try:
        with writing(folder):
            fresh.mkdir(parents=True)
            archive.extractall(fresh)
            shutil.rmtree(folder, ignore_errors=True)  # what is there is damaged
            try:
                fresh.rename(folder)
            except OSError:
                if not _is_whole(folder, archive):  # else another worker was faster
                    raise
    finally:
        shutil.rmtree(fresh, ignore_errors=True)


def wire(fmu: FmuController, description: Any) -> Wiring:
    """Check ``av.fmu`` against the FMU's variables: a `CampaignError` names the key, and what there is."""
    connected = fmu.inputs or _by_name(fmu, description)
    for name in sorted(connected.keys() - OBSERVATIONS.keys()):
        expected = f"one of {', '.join(OBSERVATIONS)}"
        mend = did_you_mean(name, list(OBSERVATIONS)) or "The values are the FMU's input variables."
        raise CampaignError(f"av.fmu.inputs.{name}", "no such observation", expected, mend)
    inputs = [_reference(f"av.fmu.inputs.{key}", name, description, ("input",)) for key, name in connected.items()]
    starts = [_reference("av.fmu.start_values", name, description, ("parameter", "input", "local", "output"))
              for name in fmu.start_values]  # fmt: skip
    outputs = [fmu.output] if fmu.output else _reals(description, "output")
    if len(outputs) != 1:
        found, mend = f"{', '.join(outputs) or 'none'}", "Say which: --set av.fmu.output=NAME."
        raise CampaignError("av.fmu.output", found, "one Real output, the acceleration in m/s2", mend)
    output = _reference("av.fmu.output", outputs[0], description, ("output",))
    return Wiring(inputs, [OBSERVATIONS[key] for key in connected], output, starts, [*fmu.start_values.values()])


def _reals(description: Any, causality: str) -> list[str]:
    return [each.name for each in description.modelVariables if (each.type, each.causality) == ("Real", causality)]


def _by_name(fmu: FmuController, description: Any) -> dict[str, str]:
    names = _reals(description, "input")
    if not names or not set(names) <= set(OBSERVATIONS):
        expected = f"inputs that are named as observations ({', '.join(OBSERVATIONS)}), or connected to them"
        example = f"{{speed_mps: {names[0]}}}" if names else "{speed_mps: NAME}"
        mend = f"Say which is what, as in --set 'av.fmu.inputs={example}'."
        raise CampaignError("av.fmu.inputs", f"{fmu.file} with inputs {', '.join(names) or 'none'}", expected, mend)
    return dict(zip(names, names, strict=True))


def _reference(where: str, name: str, description: Any, causalities: Sequence[str]) -> int:
    variables = {each.name: each for each in description.modelVariables}
    variable = variables.get(name)
    if variable is not None and variable.type == "Real" and variable.causality in causalities:
        return int(variable.valueReference)
    listed = ", ".join(f"{each.name} ({each.type} {each.causality})" for each in variables.values())
    kind = "no variable of the FMU" if variable is None else f"a {variable.type} {variable.causality}"
    raise CampaignError(where, f"{name}, {kind}", f"a Real {' or '.join(causalities)}", f"The FMU has: {listed}.")


class FmuVehicleController:
    """One instance of an FMU, which is unpacked in ``folder``."""

    def __init__(self, wiring: Wiring, description: Any, folder: Path) -> None:
        self._wiring = wiring
        identity = {"guid": description.guid, "modelIdentifier": description.coSimulation.modelIdentifier}
        self._instance = {**identity, "unzipDirectory": str(folder)}
        self._fmu: Any = None
        self._begun = False

    def start(self, episode: EpisodeStart) -> None:  # noqa: ARG002 - FMI has no random stream to hand over
        """Forget the last episode; the instance is set up with the first observation."""
        from fmpy.fmi1 import FMICallException  # noqa: PLC0415 - an extra

        if self._begun:
            try:
                self._fmu.terminate()
                self._fmu.reset()
            except FMICallException:
                self.close()
        self._begun = False

    def _begin(self, time_s: float) -> None:
        from fmpy.fmi2 import FMU2Slave  # noqa: PLC0415 - an extra

        if self._fmu is None:
            self._fmu = FMU2Slave(**self._instance)
            self._fmu.instantiate()
        self._fmu.setupExperiment(startTime=time_s)
        if self._wiring.start_references:
            self._fmu.setReal(self._wiring.start_references, self._wiring.start_values)
        self._fmu.enterInitializationMode()
        self._fmu.exitInitializationMode()
        self._begun = True

    def step(self, observation: Observation) -> float:
        """Inputs, ``doStep`` over 0.1 s, output (m/s²)."""
        values = [reading(observation) for reading in self._wiring.readings]
        if not self._begun:
            self._begin(observation.time_s)
        fmu = self._fmu
        fmu.setReal(self._wiring.inputs, values)
        fmu.doStep(currentCommunicationPoint=observation.time_s, communicationStepSize=STEP_S)
        return float(fmu.getReal((self._wiring.output,))[0])

    def close(self) -> None:
        """Free the instance; the shared library stays loaded for the other cells'."""
        fmu, self._fmu, self._begun = self._fmu, None, False
        if fmu is not None:
            fmu.fmi2FreeInstance(fmu.component)
