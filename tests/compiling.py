"""Run what needs all kernels of tests between them: ``python -m tests.compiling 0`` and ``1``, beside each other.

Before workers of xdist start, because each of them would compile all. Pools and tables that tests share are made, too.
"""

import sys
import tempfile
from pathlib import Path

import harness
from tests.families.test_same_bits import CARELESS, resolved_of
from tests.golden.record import record
from tests.in_process import run_here

GOLDEN = (
    ("nde-sumo", "step-recursive-twin", "mixture-twin", "forced-lateral-sumo", "shells-lateral-sumo"),
    ("shells-sumo", "shells-acting-twin"),
)


def follow(scenario: str) -> None:
    """A run of a scenario in which the AV follows, and a replay."""
    campaign = resolved_of(scenario, CARELESS[scenario], "stop.episodes=40", "world.engine=twin").campaign
    with tempfile.TemporaryDirectory() as folder:
        harness.replay(run_here(campaign, Path(folder) / "run").folder, 0)


if __name__ == "__main__":
    half = int(sys.argv[1])
    record(GOLDEN[half])
    if half:
        follow("lead_brakes")
        follow("cut_out")
