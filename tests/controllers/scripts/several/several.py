"""A package beside it imports traci, too."""

from parts import control, simulate

simulate(control.step)

import traci  # for `harness run` to see what it is

traci.close()
