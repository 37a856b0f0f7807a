"""How a driver would have accelerated in the situations that another vehicle met: what fitting a driver compares."""

from __future__ import annotations

from harness.arrays import FloatArray, IntArray, RecordArray
from harness.compiled import compiled_threads
from harness.vehicles.reaction import reacting_acceleration


@compiled_threads
def expected_accelerations(
    driver: RecordArray, begin: IntArray, speed: FloatArray, lead_speed: FloatArray, gap: FloatArray, out: FloatArray
) -> None:
    """Accelerations of a driver that sees what was seen, but remembers its own acceleration.

    Starting from the observed acceleration of the step before, a driver that hardly changes it would seem to explain
    any vehicle.

    Parameters
    ----------
    driver : structured ndarray, shape (1,)
        Without inattention.
    begin : ndarray, shape (m + 1,)
        Where each cut-in's steps begin, the cut-in step first; and the end.
    speed, lead_speed : ndarray, shape (n,)
        Of the vehicle, and of the one that cut in (m/s).
    gap : ndarray, shape (n,)
        Bumper to bumper (m).
    out : ndarray, shape (n,)
        Receives accelerations (m/s²).
    """
    for e in range(begin.size - 1):
        a = 0.0
        for i in range(begin[e], begin[e + 1]):
            if i - begin[e] > driver[0].delay_steps:
                a = reacting_acceleration(driver[0], a, speed[i], lead_speed[i], gap[i])
            out[i] = a
