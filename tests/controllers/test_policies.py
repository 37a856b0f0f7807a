"""Every recipe of docs/policies.md runs as it stands on the page, with its package; .ci/full has them all."""

from __future__ import annotations

import importlib
import json
import pickle
import re
import sys

import numpy as np
import pytest

from harness.cli import main
from tests.stored_runs import ROOT
from tests.worlds.running import drive, motion

PAGE = (ROOT / "docs/policies.md").read_text("utf-8")
BLOCKS = dict(re.findall(r"^```py\n# (\w+\.py)\n(.*?)^```$", PAGE, re.MULTILINE | re.DOTALL))
RECIPES = {"my_sb3": "stable_baselines3", "my_agent": "", "my_torch": "torch", "my_onnx": "onnxruntime"}


class Agent:
    """Brakes fully while less than 4 s remain to a collision; vectors and actions are those of gymnasium."""

    def predict(self, vector):
        assert vector.shape == (3,)
        assert vector.dtype == np.float32
        speed, lead_speed, gap = vector
        return np.array([-1.0 if 4.0 * (speed - lead_speed) > gap else 0.0], dtype=np.float32)


class Pair(Agent):
    """Answers as stable-baselines3 does."""

    def predict(self, vector):
        return super().predict(vector), None


def make(package, file, agent):
    """Write the agent as a file of the package's own: of a policy that has to be trained, an untrained one."""
    if package == "torch":
        torch, network = importlib.import_module("torch"), importlib.import_module("network").Network()
        state = {name: torch.zeros_like(value) for name, value in network.state_dict().items()}
        state["0.weight"][0] = 1e6 * torch.tensor([4.0, -4.0, -1.0])  # the first unit is −1 or 1
        state["2.weight"][0, 0] = state["2.bias"][0] = -0.5
        torch.save(state, file)
    elif package == "onnxruntime":
        onnx = importlib.import_module("onnx")
        make_node, info = onnx.helper.make_node, onnx.helper.make_tensor_value_info
        weights = [("by", [[4.0], [-4.0], [-1.0]]), ("zero", 0.0), ("full", -1.0)]
        constants = [onnx.numpy_helper.from_array(np.array(value, np.float32), name) for name, value in weights]
        nodes = [
            make_node("MatMul", ["obs", "by"], ["closing"]),
            make_node("Greater", ["closing", "zero"], ["brakes"]),
            make_node("Where", ["brakes", "full", "zero"], ["action"]),
        ]
        ends = [info("obs", 1, [None, 3])], [info("action", 1, [None, 1])]
        graph = onnx.helper.make_graph(nodes, "agent", *ends, constants)
        model = onnx.helper.make_model(graph, opset_imports=[onnx.helper.make_opsetid("", 17)], ir_version=8)
        onnx.save(model, str(file))
    elif package == "stable_baselines3":
        gymnasium, sb3 = map(importlib.import_module, ("gymnasium", package))

        class Road(gymnasium.Env):
            observation_space = gymnasium.spaces.Box(0.0, 200.0, (3,), np.float32)
            action_space = gymnasium.spaces.Box(-1.0, 1.0, (1,), np.float32)

        sb3.PPO("MlpPolicy", Road(), seed=1, device="cpu").save(file)
    else:
        file.write_bytes(pickle.dumps(agent()))


@pytest.mark.parametrize(("name", "agent"), [*((name, Agent) for name in RECIPES), ("my_agent", Pair)])
def test_a_recipe_is_the_same_vehicle_in_whatever_package(name, agent, tmp_path, monkeypatch, capsys):
    package, file = RECIPES[name], tmp_path / "policy.zip"
    for each, text in BLOCKS.items():
        (tmp_path / each).write_text(text, "utf-8")
    monkeypatch.syspath_prepend(tmp_path)
    for stale in ("observation", "network", name):
        monkeypatch.delitem(sys.modules, stale, raising=False)
    if package:
        pytest.importorskip(package)
    make(package, file, agent)
    av = f"av={{controller: '{name}:Policy', parameters: {{file: '{file}'}}}}"
    if package == "stable_baselines3":  # untrained: it does something, the same in any cell
        assert drive(av, n=40).failures == {}
        assert motion(av, n=40, cells=32) == motion(av, n=40, cells=7)
    else:
        assert motion(av, n=40) == motion("av={controller: 'tests.controllers.test_traci_script:Brakes'}", n=40)
    if package:
        monkeypatch.chdir(tmp_path)
        assert main(["av-check", f"{name}.py:Policy", f"--set=av.parameters.file={file}", "--json"]) == 0
        assert json.loads(capsys.readouterr().out)["deterministic"]
