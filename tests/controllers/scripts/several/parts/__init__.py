import traci

from .state import STATE


def simulate(step):
    traci.start(["sumo"])
    while traci.simulation.getMinExpectedNumber() > 0:
        traci.simulationStep()
        STATE.append(traci.simulation.getTime())
        assert len(STATE) == round(10 * traci.simulation.getTime())
        step("ego")
