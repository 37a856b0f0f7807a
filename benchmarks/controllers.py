"""What each form of controller costs per episode, as a ratio to the built-in IDM.

    python -m benchmarks.controllers

Every form drives the intelligent driver model through the same episodes in one process and one SUMO world, so that
ratios of CPU time compare controllers and nothing else. Rounds are interleaved and the fastest counts.
"""

from __future__ import annotations

import argparse
import os
import sys
import tempfile
import time
from pathlib import Path

os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")

from harness.campaign.files import load_campaign
from harness.resolved import resolve
from harness.sampling import prepare
from harness.worlds import build_world
from harness.worlds.sumo import SumoWorld

ROOT = Path(__file__).parents[1]
CELLS = 64
FULL_LENGTH_STEPS = 200
FORMS = {
    "built in": ("{model: idm}", 1.0),
    "batch": ("{controller: 'examples.idm_batch:IDM'}", 1.2),
    "per vehicle": ("{controller: 'examples.idm:IDM'}", 4.0),
    "TraCI-style": ("{controller: 'examples.idm_traci_style:IDM'}", 6.0),
    "TraCI script": (f"{{controller: '{ROOT}/examples/idm_traci_script.py'}}", 6.0),
    "step listener": ("{controller: 'examples.idm_traci_style:Listener'}", 6.0),
}


def fmu_form(folder: Path) -> tuple[str, float]:
    """The FMU that the tests build, by pythonfmu."""
    from pythonfmu.builder import FmuBuilder  # noqa: PLC0415 - of the test extra

    file = FmuBuilder.build_FMU(ROOT / "examples/idm_fmu.py", dest=folder, project_files=[ROOT / "examples/idm.py"])
    inputs = "{speed_mps: v, lead_speed_mps: v_lead, gap_m: gap, set_speed_mps: v_set}"
    return f"{{fmu: {{file: '{file}', inputs: {inputs}, output: a}}}}", 6.0


def external_process(n_episodes: int) -> float:
    """Full-length (20 s) episodes per second of the example client on one SUMO server with the harness."""
    client = f"{sys.executable} {ROOT}/examples/traci_client/idm_client.py --port {{port}} --cells {{cells}}"
    changes = [f"av={{traci: {{command: '{client}'}}}}", f"world.cells={CELLS}"]
    campaign = load_campaign(ROOT / "scenarios/overtaking_forced.yaml", changes)
    prepared, world = prepare(resolve(campaign)), build_world(campaign)
    loop = prepared.loop(world, traces="none")
    try:
        loop.run(0, prepared.tests(0, CELLS))
        began = time.perf_counter()
        shard = loop.run(0, prepared.tests(0, n_episodes))
        elapsed_s = time.perf_counter() - began
    finally:
        loop.close()
        world.close()
    return float(shard.episode["n_steps"].sum()) / FULL_LENGTH_STEPS / elapsed_s


def main() -> None:
    """Print a table."""
    arguments = argparse.ArgumentParser(description=__doc__)
    arguments.add_argument("--episodes", type=int, default=1000)
    arguments.add_argument("--rounds", type=int, default=3)
    given = arguments.parse_args()
    os.chdir(ROOT)
    with tempfile.TemporaryDirectory() as folder:
        forms = FORMS | {"FMU (pythonfmu)": fmu_form(Path(folder))}
        world = SumoWorld(96)
        loops, best = {}, dict.fromkeys(forms, float("inf"))
        for name, (av, _) in forms.items():
            prepared = prepare(
                resolve(load_campaign(ROOT / "scenarios/overtaking_mixture.yaml", [f"av={av}", "av.warm_up_s=0"]))
            )
            loops[name] = prepared.loop(world, traces="none")
            loops[name].run(0, prepared.tests(0, 96))
        tests = prepared.tests(0, given.episodes)
        for _ in range(given.rounds):
            for name, loop in loops.items():
                began = time.process_time()
                shard = loop.run(0, tests)
                best[name] = min(best[name], time.process_time() - began)
                assert not shard.failures
        world.close()
    print(f"\nExternal TraCI process, {CELLS} cells: {external_process(given.episodes):.0f} full-length episodes/s\n")
    print("| controller | CPU per episode, ms | ratio | at most |\n| --- | --- | --- | --- |")
    for name, (_, most) in forms.items():
        ratio = best[name] / best["built in"]
        print(f"| {name} | {1e3 * best[name] / given.episodes:.2f} | {ratio:.2f} | {most:g} |")


if __name__ == "__main__":
    main()
