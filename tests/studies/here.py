"""What several tests of studies need: work in this process, and pools that are wrong."""

from concurrent.futures import Executor
from dataclasses import replace

import numpy as np

from studies.replication.shells import Draw, DrawnPool


class Here(Executor):
    """Works in the main thread, which alone can limit a controller's time, and where tests can look on."""

    map = staticmethod(map)


def wrong_shell(draw: Draw, shell: int, factor: float) -> Draw:
    """Pools that believe one shell this many times as probable as it is."""

    def drawn(rng: np.random.Generator) -> list[DrawnPool]:
        pools = draw(rng)
        wrong = np.where(np.array(pools[0].design.cell_stratum) == shell, factor, 1.0)
        return [replace(one, design=replace(one.design, cell_p=one.design.cell_p * wrong)) for one in pools]

    return drawn
