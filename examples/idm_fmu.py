"""The intelligent driver model as FMU: `pythonfmu build -f examples/idm_fmu.py examples/idm.py` writes it.

pythonfmu puts the files beside each other into the FMU, hence the import by two ways.
"""

import math

from pythonfmu import Fmi2Causality, Fmi2Slave, Fmi2Variability, Real

try:
    from examples.idm import cruise, idm_acceleration
except ImportError:
    from idm import cruise, idm_acceleration


class IDMController(Fmi2Slave):
    """Inputs v, v_lead, gap, v_set; parameter a_min; output a."""

    def __init__(self, **kwargs) -> None:
        super().__init__(**kwargs)
        self.v = self.v_lead = self.gap = self.v_set = self.a = 0.0
        self.a_min = -4.0
        for name in ("v", "v_lead", "gap", "v_set"):
            self.register_variable(Real(name, causality=Fmi2Causality.input))
        self.register_variable(Real("a_min", causality=Fmi2Causality.parameter, variability=Fmi2Variability.tunable))
        self.register_variable(Real("a", causality=Fmi2Causality.output))

    def do_step(self, current_time, step_size) -> bool:
        """Output from the inputs."""
        if math.isinf(self.gap):
            self.a = cruise(self.v, self.v_set)
        else:
            self.a = idm_acceleration(self.v, self.v_lead, self.gap, self.a_min)
        return True
