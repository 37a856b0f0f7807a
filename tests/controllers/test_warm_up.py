"""A controller that holds its speed until the cut-in is shown the seconds before: its state is filled when it acts."""

from __future__ import annotations

import importlib
import math
from collections import deque
from contextlib import closing

import numpy as np
import pytest

from examples.idm import IDM, idm_acceleration
from harness.campaign.files import load_campaign
from harness.cli import main
from harness.controllers.traci_style import TraciStyleController
from harness.errors import EXIT_BAD_INPUT, EXIT_DONE
from harness.worlds.sumo import SumoWorld
from tests.controllers.driving import LATERAL, ROOT, drive, fmu_av
from tests.worlds.running import MISBEHAVING, program
from tests.worlds.running import run as run_in_sumo

HERE = "tests.controllers.test_warm_up"
DELAY_STEPS, SHOWN = 5, 300
NOBODY = (0.0, 0.0, math.inf)


class Line:
    """An IDM that acts on what was measured half a second ago, or now where the line is not full."""

    def __init__(self, filled: bool = False) -> None:
        self._measured = deque([NOBODY] * (DELAY_STEPS + 1) * filled, DELAY_STEPS + 1)

    def acceleration(self, speed: float, lead_speed: float, gap: float) -> float:
        self._measured.append((speed, lead_speed, gap))
        speed, lead_speed, gap = self._measured[0 if len(self._measured) > DELAY_STEPS else -1]
        return 0.0 if math.isinf(gap) else idm_acceleration(speed, lead_speed, gap)


class Delayed:
    """Per vehicle."""

    def __init__(self, filled: bool = False) -> None:
        self._filled = filled

    def start(self, episode):
        self._line = Line(self._filled)

    def step(self, seen):
        return self._line.acceleration(seen.speed_mps, seen.lead_speed_mps, seen.gap_m)

    def close(self): ...


class DelayedBatch(Delayed):
    """Over arrays."""

    def start_batch(self, cells, episodes, random):
        self._lines = {**getattr(self, "_lines", {}), **{int(cell): Line(self._filled) for cell in cells}}

    def step_batch(self, seen):
        rows = zip(seen.cell, seen.speed_mps, seen.lead_speed_mps, seen.gap_m, strict=True)
        return [self._lines[int(cell)].acceleration(*map(float, row)) for cell, *row in rows]


class DelayedScript(TraciStyleController):
    """A TraCI-style script."""

    def __init__(self, filled: bool = False) -> None:
        self._filled = filled

    def on_start(self, random):
        self._line = Line(self._filled)

    def on_step(self, traci, veh_id, time):
        name, gap = traci.vehicle.getLeader(veh_id) or (None, math.inf)
        lead_speed = traci.vehicle.getSpeed(name) if name else math.nan
        a = self._line.acceleration(traci.vehicle.getSpeed(veh_id), lead_speed, gap)
        traci.vehicle.setAcceleration(veh_id, a, 0.1)


class Notes(IDM):
    """Writes down what it is shown of the last episode that begins; what it answers meanwhile is nonsense."""

    seen = []

    def start(self, episode):
        self.seen.clear()

    def step(self, seen):
        self.seen.append(seen)
        return "?" if len(self.seen) <= SHOWN else super().step(seen)


class NeedsLeader(IDM):
    def step(self, seen):
        return -float(int(seen.gap_m > 0.0) and round(seen.gap_m) // 1000)


DELAYED_FMU = """
from pythonfmu import Fmi2Causality, Fmi2Slave, Real

from line import Line


class DelayedFmu(Fmi2Slave):
    def __init__(self, **kwargs):
        super().__init__(**kwargs)
        self.v = self.v_lead = self.gap = self.a = self.filled = 0.0
        self.line = None
        for name in ("v", "v_lead", "gap"):
            self.register_variable(Real(name, causality=Fmi2Causality.input))
        self.register_variable(Real("a", causality=Fmi2Causality.output))
        self.register_variable(Real("filled", causality=Fmi2Causality.parameter, variability="tunable"))

    def setup_experiment(self, start_time, *_):
        self.line = None

    def do_step(self, current_time, step_size):
        self.line = self.line or Line(bool(self.filled))
        self.a = self.line.acceleration(self.v, self.v_lead, self.gap)
        return True
"""


@pytest.fixture(autouse=True)
def _in_the_checkout(monkeypatch):
    monkeypatch.chdir(ROOT)
    monkeypatch.setenv("PYTHONPATH", str(ROOT))


def av(form: str, filled: bool = False, warm_up_s: float = 2.0) -> str:
    parameters = f"parameters: {{filled: {str(filled).lower()}}}"
    return f"av={{controller: '{HERE}:{form}', {parameters}, warm_up_s: {warm_up_s}}}"


def motion(*overrides, **options):
    shard = drive(*overrides, **options)
    assert shard.failures == {}
    return shard.results.episode.tobytes(), [shard.traces[row].tobytes() for row in sorted(shard.traces)]


@pytest.fixture(scope="module")
def filled():
    with pytest.MonkeyPatch.context() as patch:
        patch.chdir(ROOT)
        return motion(av("Delayed", filled=True, warm_up_s=0.0))


@pytest.mark.parametrize("form", ["Delayed", "DelayedBatch", "DelayedScript"])
def test_a_state_that_starts_empty_is_filled_when_the_controller_acts(form, filled):
    assert motion(av(form), cells=7) == filled
    assert motion(av(form, warm_up_s=0.4)) != filled  # not enough
    assert motion(av(form, warm_up_s=0.0)) != filled


def test_so_is_that_of_an_fmu(filled, tmp_path, monkeypatch):
    builder = pytest.importorskip("pythonfmu.builder", reason="pythonfmu builds the FMU")
    source = (ROOT / "tests/controllers/test_warm_up.py").read_text()
    line = source[source.index("class Line") : source.index("class Delayed:")]
    head = "import math\nfrom collections import deque\nfrom idm import idm_acceleration\nDELAY_STEPS = 5\n"
    (tmp_path / "line.py").write_text(f"{head}NOBODY = (0.0, 0.0, math.inf)\n{line}")
    (tmp_path / "delayed.py").write_text(DELAYED_FMU)
    monkeypatch.syspath_prepend(ROOT / "examples")  # as where it is unpacked
    project = [tmp_path / "line.py", ROOT / "examples/idm.py"]
    fmu = builder.FmuBuilder.build_FMU(tmp_path / "delayed.py", dest=tmp_path, project_files=project)
    assert motion(f"av={fmu_av(fmu)}") == filled
    assert motion(f"av={fmu_av(fmu, ', warm_up_s: 0')}") != filled


@pytest.mark.parametrize("shim", [True, False])
@pytest.mark.parametrize("traffic", [[], [LATERAL]], ids=["one step", "lateral"])
def test_both_worlds_show_the_same(traffic, shim):
    with closing(SumoWorld(5, shim=shim)) as world:
        assert motion(av("Delayed"), *traffic, n=40, world=world) == motion(av("Delayed"), *traffic, n=40)


def test_a_program_has_seen_them_in_sumo(filled):
    """It is there from the start of an episode; what it commands until the cut-in is overruled."""
    shard = run_in_sumo(program(MISBEHAVING, "delays"), 0, 30)
    twin = drive(av("Delayed"), "testing.method=forced", n=30)
    rows = np.flatnonzero(shard.results.episode["cut_in_step"] > DELAY_STEPS)
    assert rows.size > 10
    for row in rows:
        assert shard.traces[row][..., :2].tobytes() == twin.traces[row][..., :2].tobytes()


@pytest.mark.parametrize(("episode", "traffic"), [(0, LATERAL), (1, "environment.cut_in_lead_s=0")])
def test_what_is_shown_is_what_was_and_before_the_test_nobody_changed_speed(episode, traffic):
    shard = drive(f"av={{controller: '{HERE}:Notes', warm_up_s: 30}}", traffic, first=episode, n=1, cells=1)
    seen, trace = importlib.import_module(HERE).Notes.seen, shard.traces[0]
    assert shard.failures == {}
    onset = int(shard.results.episode["onset_step"][0])
    assert [round(10.0 * each.time_s) for each in seen[:SHOWN]] == list(range(onset - SHOWN + 1, onset + 1))
    for each in seen[: SHOWN + 2]:
        step = round(10.0 * each.time_s)
        there, ago_s = trace[max(step, 0)], max(-step, 0) * 0.1
        vehicles = (each.lv.position_m, each.bv.position_m, each.position_m)
        np.testing.assert_allclose(vehicles, there[:, 0] - ago_s * there[:, 1], rtol=1e-12)
        assert (each.lv.speed_mps, each.bv.speed_mps, each.speed_mps) == tuple(there[:, 1])
    for each in seen[:SHOWN]:
        assert (each.gap_m, each.bv.lane, each.lv.lane, each.acceleration_mps2) == (math.inf, 1, 1, 0.0)
        assert (each.bv_lateral_m, each.bv_lateral_speed_mps, each.bv_overlaps) == (0.0, 0.0, False)
        assert math.isnan(each.lead_speed_mps)


def test_who_cannot_be_without_a_leader_is_told_when_that_was():
    shard = drive(f"av={{controller: '{HERE}:NeedsLeader'}}", n=8)
    cause = "step, warming up: OverflowError: cannot convert float infinity to integer"
    assert shard.failures == dict.fromkeys(range(8), cause)


def test_a_run_is_replayed_with_it_and_not_continued_with_another(tmp_path, capsys):
    (tmp_path / "c.yaml").write_text("{name: w, testing: {method: forced}, world: {engine: twin}, stop: {episodes: 9}}")
    run = ["run", str(tmp_path / "c.yaml"), "--out", str(tmp_path / "run"), "--workers", "1", "--quiet", "--set"]
    assert main([*run, av("Delayed")]) == EXIT_DONE
    assert main(["replay", str(tmp_path / "run"), "3"]) == EXIT_DONE
    assert main([*run, av("Delayed", warm_up_s=1.0), "--resume"]) == EXIT_BAD_INPUT
    assert "another campaign" in capsys.readouterr().err


def test_it_counts_where_it_is_shown():
    def hashes(source):
        changes = [[f"av={{{source}}}", f"av.warm_up_s={s}"] for s in (0, 1, 2)]
        return len({load_campaign(ROOT / "scenarios/smoke.yaml", each).content_hash("p") for each in changes})

    assert [hashes(f"controller: 'a:B', before_cut_in: {when}") for when in ("hold_speed", "controller")] == [3, 1]
    assert [hashes(source) for source in ("model: idm", "sumo: {tau: 1}", "traci: {command: x}")] == [1, 1, 1]
