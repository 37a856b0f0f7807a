"""The intelligent driver model gives the same motion in whatever form it is plugged in."""

from pathlib import Path

import numpy as np
import pytest

from harness.campaign.files import load_campaign
from harness.resolved import resolve
from harness.runner.prepare import prepare
from harness.worlds.twin import TwinWorld

ROOT = Path(__file__).parents[2]
EPISODES = 150
FORMS = {
    "per vehicle": "{controller: 'examples.idm:IDM'}",
    "batch": "{controller: 'examples.idm_batch:IDM'}",
    "TraCI-style": "{controller: 'examples.idm_traci_style:IDM'}",
    "step listener": "{controller: 'harness.controllers.traci_style:StepListenerController', "
    "parameters: {listener: 'examples.idm_traci_style:Listener'}}",
}


@pytest.fixture(autouse=True)
def _in_the_checkout(monkeypatch):
    monkeypatch.chdir(ROOT)


def fmu_av(file, more=""):
    inputs = "{speed_mps: v, lead_speed_mps: v_lead, gap_m: gap}"
    return f"{{fmu: {{file: '{file}', inputs: {inputs}, output: a}}{more}}}"


def run(av, *more, cells=32, first=0, n=EPISODES):
    overrides = [f"av={av}", "testing={method: forced}", "world.engine=twin", "stop.rhw=null", *more]
    prepared = prepare(resolve(load_campaign(ROOT / "scenarios/overtaking_mixture.yaml", overrides)))
    loop = prepared.loop(TwinWorld(cells), traces="all")
    try:
        return loop.run(first, prepared.states(first, n))
    finally:
        loop.close()


@pytest.fixture(scope="module")
def built_in():
    return run("{model: idm}")


@pytest.mark.parametrize("form", FORMS)
@pytest.mark.parametrize("cells", [32, 7])
def test_every_form_gives_the_bits_of_the_built_in_model_in_any_number_of_cells(form, cells, built_in):
    other = run(FORMS[form], cells=cells)
    assert other.failures == {}
    assert other.results.episode.tobytes() == built_in.results.episode.tobytes()
    assert all(other.traces[i].tobytes() == built_in.traces[i].tobytes() for i in range(EPISODES))


def test_over_arrays_it_knows_too_what_to_do_while_nobody_is_ahead():
    """Where cut-ins take time, controllers act from the onset on: then the gap is infinite and the speed ahead NaN."""
    lateral = "environment.parameters=ndd-overtaking-1-lateral"
    one, batch = (run(FORMS[form], lateral, n=30) for form in ("per vehicle", "batch"))
    assert one.failures == batch.failures == {}
    assert all(batch.traces[i].tobytes() == one.traces[i].tobytes() for i in range(30))


def test_an_fmu_gives_the_same_motion_and_gets_its_start_values_in_every_episode(fmu, built_in):
    other = run(fmu_av(fmu))
    assert other.failures == {}
    for i in range(EPISODES):
        np.testing.assert_allclose(other.traces[i], built_in.traces[i], rtol=0, atol=1e-9)
    weaker = run(fmu_av(fmu).replace("output: a", "output: a, start_values: {a_min: -1.5}"))
    braking = [min(run.traces[i][:-1, 2, 2].min() for i in range(EPISODES)) for run in (weaker, built_in)]
    assert braking[0] == -1.5 > braking[1]
