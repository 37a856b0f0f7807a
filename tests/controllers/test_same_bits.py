"""The intelligent driver model gives the same motion in whatever form it is plugged in."""

import numpy as np
import pytest

from tests.controllers.driving import LATERAL, drive, fmu_av, motion

FORMS = {
    "per vehicle": "av={controller: 'examples.idm:IDM'}",
    "batch": "av={controller: 'examples.idm_batch:IDM'}",
    "TraCI-style": "av={controller: 'examples.idm_traci_style:IDM'}",
    "step listener": "av={controller: 'harness.controllers.traci_style:StepListenerController', "
    "parameters: {listener: 'examples.idm_traci_style:Listener'}}",
}


@pytest.mark.parametrize("form", FORMS)
@pytest.mark.parametrize("cells", [32, 7])
def test_every_form_gives_the_bits_of_the_built_in_model_in_any_number_of_cells(form, cells):
    assert motion(FORMS[form], cells=cells) == motion("av={model: idm}")


def test_over_arrays_it_knows_too_what_to_do_while_nobody_is_ahead():
    """Where cut-ins take time, controllers act from the onset on: then the gap is infinite and the speed ahead NaN."""
    assert motion(FORMS["batch"], LATERAL, n=30) == motion(FORMS["per vehicle"], LATERAL, n=30)


def test_an_fmu_gives_the_same_motion_and_gets_its_start_values_in_every_episode(fmu):
    built_in = drive("av={model: idm}")
    other = drive(f"av={fmu_av(fmu)}")
    assert other.failures == {}
    for i in built_in.traces:
        np.testing.assert_allclose(other.traces[i], built_in.traces[i], rtol=0, atol=1e-9)
    weaker = drive(f"av={fmu_av(fmu)}", "av.fmu.start_values={a_min: -1.5}")
    braking = [min(run.traces[i][:-1, 2, 2].min() for i in built_in.traces) for run in (weaker, built_in)]
    assert braking[0] == -1.5 > braking[1]
