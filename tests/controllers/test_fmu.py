"""``av.fmu`` is checked against the FMU before anything runs; an instance per cell, a reset per episode."""

import re
import sys
import zipfile
from contextlib import closing
from types import SimpleNamespace

import pytest

from harness.campaign.files import load_campaign
from harness.campaign.vehicle import FmuController
from harness.controllers import EpisodeStart, Neighbour, Observation
from harness.controllers.find import build_host, require_controller
from harness.controllers.fmu import OBSERVATIONS, fmu_maker, wire
from harness.errors import CampaignError
from harness.resolved import resolve

WIRED = "inputs: {speed_mps: x}, output: a"
COUNTER = """
from pythonfmu import Fmi2Causality, Fmi2Slave, Real


class Counter(Fmi2Slave):
    def __init__(self, **kwargs):
        super().__init__(**kwargs)
        self.x = self.a = 0.0
        self.register_variable(Real("x", causality=Fmi2Causality.input))
        self.register_variable(Real("a", causality=Fmi2Causality.output))

    def do_step(self, current_time, step_size):
        self.a += self.x / 100.0
        return True
"""


@pytest.fixture(scope="module")
def fmu(tmp_path_factory):
    """Output: the sum of its inputs so far, in hundredths."""
    builder = pytest.importorskip("pythonfmu.builder", reason="pythonfmu builds the FMU")
    script = tmp_path_factory.mktemp("fmu") / "counter.py"
    script.write_text(COUNTER)
    return builder.FmuBuilder.build_FMU(script, dest=script.parent)


def load(folder, text):
    (folder / "c.yaml").write_text(f"name: fmu\nav: {{fmu: {text}}}\n")
    return load_campaign(folder / "c.yaml")


def check(fmu, tmp_path, text):
    require_controller(load(tmp_path, f"{{file: '{fmu}', {text}}}").av)


@pytest.mark.parametrize(
    ("text", "where", "found"),
    [
        ("inputs: {speed_mps: y}, output: a", "inputs.speed_mps", "y, no variable of the FMU"),
        ("inputs: {speed: x}, output: a", "inputs.speed", "no such observation"),
        ("inputs: {speed_mps: x}, output: a, start_values: {k: 1.0}", "start_values", "k, no variable"),
    ],
)
def test_a_wrong_wiring_is_named_with_the_variables(fmu, tmp_path, text, where, found):
    with pytest.raises(CampaignError) as error:
        check(fmu, tmp_path, text)
    assert error.value.where == f"av.fmu.{where}"
    assert found in error.value.found
    assert "x (Real input), a (Real output)" in error.value.mend or "observation" in found


def variables(**causalities):
    """A description with these Real variables."""
    listed = enumerate(causalities.items())
    made = [SimpleNamespace(name=name, type="Real", causality=kind, valueReference=i) for i, (name, kind) in listed]
    return SimpleNamespace(modelVariables=made)


def test_inputs_that_are_named_as_observations_and_an_only_output_need_no_wiring():
    own = FmuController(file="my.fmu")
    found = wire(own, variables(gap_m="input", k="parameter", bv_speed_mps="input", a="output"))
    assert (found.inputs, found.output) == ([0, 2], 3)
    seen = Observation(
        0.0, 1.0, 2.0, 3.0, 4.0, 5.0, Neighbour(6.0, 7.0, 1), Neighbour(8.0, 9.0, 1), 10.0, 11.0, True, 12.0
    )
    assert [read(seen) for read in found.readings] == [4.0, 7.0]
    assert [read(seen) for read in OBSERVATIONS.values()] == [0, 1, 2, 3, 4, 5, 6, 7, 1, 8, 9, 1, 10, 11, 1, 12, 0, 0]
    with pytest.raises(CampaignError, match=r"inputs gap_m, v;.*--set 'av.fmu.inputs="):
        wire(own, variables(gap_m="input", v="input", a="output"))
    with pytest.raises(CampaignError, match=r"av.fmu.output: found a, b;.*--set av.fmu.output=NAME"):
        wire(own, variables(gap_m="input", a="output", b="output"))


@pytest.mark.parametrize(
    ("old", "new", "found"),
    [
        (rb"<CoSimulation[^>]*>", b'<ModelExchange modelIdentifier="Counter"/>', "for FMI 2.0 model exchange"),
        (rb'fmiVersion="2.0"', b'fmiVersion="7.0"', "7.0"),
        (None, b"nothing", "cannot be read"),
        (None, None, "found no file"),
    ],
)
def test_another_kind_or_version_or_no_fmu_at_all_is_refused(fmu, tmp_path, old, new, found):
    file = tmp_path / "other.fmu"
    if old is not None:
        with zipfile.ZipFile(fmu) as source, zipfile.ZipFile(file, "w") as target:
            for name in source.namelist():
                content = source.read(name)
                target.writestr(name, re.sub(old, new, content) if name.endswith(".xml") else content)
    elif new is not None:
        file.write_bytes(new)
    with pytest.raises(CampaignError, match=found) as error:
        check(file, tmp_path, WIRED)
    assert error.value.where.startswith("av.fmu.file")


def test_without_the_extra_its_name_is_said(fmu, tmp_path, monkeypatch):
    monkeypatch.setitem(sys.modules, "fmpy", None)
    with pytest.raises(CampaignError, match=r"pip install -c requirements.lock -e '\.\[fmi\]'"):
        build_host(load(tmp_path, f"{{file: '{fmu}', {WIRED}}}").av, n_cells=1, seed=0)


def test_the_path_is_relative_to_the_campaign_and_the_content_counts(fmu, tmp_path):
    text = f"{{file: here.fmu, {WIRED}}}"
    hashes = []
    for name, more in (("a", b""), ("b", b""), ("c", b"more")):
        (tmp_path / name).mkdir()
        (tmp_path / name / "here.fmu").write_bytes(fmu.read_bytes() + more)
        campaign = load(tmp_path / name, text)
        assert campaign.av.fmu.file == str(tmp_path / name / "here.fmu")
        hashes.append(resolve(campaign).content_hash)
    assert hashes[0] == hashes[1] != hashes[2]


def test_instances_are_apart_and_an_episode_forgets_the_last(fmu, tmp_path):
    make = fmu_maker(load(tmp_path, f"{{file: '{fmu}', {WIRED}}}").av.fmu)
    first, second = make(), make()

    def step(controller, time_s):
        seen = Observation(time_s, 0.0, 20.0, 0.0, 5.0, 20.0, Neighbour(10.0, 20.0, 0), Neighbour(90.0, 20.0, 1))
        return controller.step(seen)

    with closing(first), closing(second):
        for controller in (first, second):
            controller.start(EpisodeStart(0, 0.1, None))
        assert [step(first, 0.0), step(first, 0.1), step(second, 3.0)] == pytest.approx([0.2, 0.4, 0.2])
        first.start(EpisodeStart(1, 0.1, None))
        assert [step(first, 5.0), step(second, 3.1)] == pytest.approx([0.2, 0.4])
