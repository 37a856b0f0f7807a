"""The example job scripts: what each task of an array calls, and that these calls make one run."""

from __future__ import annotations

import os
import re
import subprocess
from pathlib import Path

import pytest
import yaml

from harness.cli import main
from tests.runner.conftest import one_process
from tests.runner.stored_runs import manifest

EXAMPLES = Path(__file__).parents[1] / "examples/cluster"
SLURM, KUBERNETES = EXAMPLES / "slurm_parts.sh", EXAMPLES / "kubernetes_parts.yaml"
KUBERNETES_PLAN = EXAMPLES / "kubernetes_plan.yaml"
N = 64
CAMPAIGN = "name: array\nworld: {engine: twin}\ntesting: {method: forced}\nrecords: {moments: none}\n" + (
    "stop: {episodes: 192, rhw: 0.2}\nrun: {shard_size: 3}\n"
)
"""Asks for a precision, as campaigns do: the scripts take it back."""
SHELLS = "name: array\nworld: {engine: twin}\ntesting: {method: shells}\nrecords: {moments: none}\n" + (
    "pool: {relative_error: 0.03, cut_ins_per_shell: 1500}\nstop: {rhw: 2.0}\n"
)


@pytest.fixture
def called(tmp_path, monkeypatch):
    """Give the words of ``harness`` that a script calls, with the variables of its task."""
    stub = tmp_path / "bin" / "harness"
    stub.parent.mkdir()
    stub.write_text('#!/bin/sh\nprintf "%s\\n" "$@"\n')
    stub.chmod(0o755)
    monkeypatch.chdir(tmp_path)
    environment = {"PATH": f"{stub.parent}:{os.environ['PATH']}"}

    def words(command: list[str], **variables: str) -> list[str]:
        done = subprocess.run(
            command, env={**environment, **variables}, capture_output=True, text=True, check=False, cwd=tmp_path
        )
        assert (done.returncode, done.stderr) == (0, "")
        return done.stdout.splitlines()

    return words


def jobs(file: Path = KUBERNETES) -> list[dict]:
    return list(yaml.safe_load_all(file.read_text(encoding="utf-8")))


def kubernetes_command(job: dict, root: Path) -> list[str]:
    container = job["spec"]["template"]["spec"]["containers"][0]
    return [*container["command"], *(text.replace("/runs/", f"{root}/") for text in container["args"])]


def slurm_calls(called, campaign: str = "campaign.yaml", *more: str) -> list[list[str]]:
    command = ["bash", str(SLURM), campaign, "campaign", *more]
    tasks = ({"SLURM_ARRAY_TASK_ID": str(task), "SLURM_CPUS_PER_TASK": "4"} for task in range(1, N + 1))
    return [called(command, **task) for task in tasks]


def kubernetes_calls(called, *_) -> list[list[str]]:
    command = kubernetes_command(jobs()[0], Path.cwd())
    return [called(command, JOB_COMPLETION_INDEX=str(index)) for index in range(N)]


@pytest.mark.parametrize("calls_of", [slurm_calls, kubernetes_calls])
def test_the_calls_of_all_tasks_make_one_run(calls_of, called, tmp_path, monkeypatch, capsys):
    calls = calls_of(called, "campaign.yaml", "--set", "world.cells=8")
    assert [words[words.index("--part") + 1] for words in calls] == [f"{k}/{N}" for k in range(1, N + 1)]
    assert len({words[words.index("--out") + 1] for words in calls}) == N
    assert all("--resume" in words and words[words.index("--workers") + 1] == "4" for words in calls)
    (tmp_path / "campaign.yaml").write_text(CAMPAIGN)
    with one_process():
        for words in calls[-2:]:
            assert main(words) == 0
    last = next((tmp_path / "campaign.parts").glob("64"))
    assert manifest(last)["part"] == {"number": N, "of": N, "first_episode": 189, "n_episodes": 3}
    capsys.readouterr()
    merge = called(kubernetes_command(jobs()[1], Path.cwd()))
    assert merge[-2:] == ["--out", str(tmp_path / "campaign")]
    assert main(merge) == 2
    assert "missing: part 1-62 of 64" in capsys.readouterr().err


def slurm_plan_and_merge(called) -> list[list[str]]:
    """What the head of the script has Slurm run before the array of parts of a plan, and after it."""
    wrapped = re.findall(r"--wrap '(exec harness [^']*campaign\.plan[^']*)'", SLURM.read_text(encoding="utf-8"))
    return [called(["sh", "-c", command.replace("runs/", "")]) for command in wrapped]


def kubernetes_plan_and_merge(called) -> list[list[str]]:
    return [called(kubernetes_command(job, Path.cwd())) for job in (*jobs(KUBERNETES_PLAN), jobs()[1])]


@pytest.mark.parametrize(
    ("calls_of", "plan_and_merge"),
    [(slurm_calls, slurm_plan_and_merge), (kubernetes_calls, kubernetes_plan_and_merge)],
)
def test_a_plan_takes_the_campaigns_place(calls_of, plan_and_merge, called, tmp_path, capsys):
    (tmp_path / "campaign.yaml").write_text(SHELLS)
    plan, _ = plan_and_merge(called)
    workers = plan.index("--workers") + 1
    assert (plan[0], "--resume" in plan, int(plan[workers]) > 4) == ("plan", True, True)
    with one_process():
        assert main([*plan[:workers], "1", "--quiet"]) == 0
        calls = calls_of(called, "campaign.plan")
        assert all("--set" not in words and words[1].endswith("campaign.plan") for words in calls)
        assert main([*calls[1], "--quiet"]) == 0
    assert manifest(tmp_path / "campaign.parts/2")["part"]["of"] == N
    capsys.readouterr()
    _, merge = plan_and_merge(called)
    assert main(merge) == 2
    assert "missing: part 1,3-64 of 64" in capsys.readouterr().err


def test_numbers_of_tasks_agree():
    script = SLURM.read_text(encoding="utf-8")
    assert f"#SBATCH --array=1-{N}\n" in script
    parts, merging = jobs()
    assert parts["spec"]["completions"] == N
    assert parts["spec"]["completionMode"] == "Indexed"
    assert merging["spec"]["suspend"] is True


def test_slurm_says_what_is_missing(tmp_path):
    done = subprocess.run(["bash", str(SLURM)], capture_output=True, text=True, check=False, cwd=tmp_path)
    assert done.returncode != 0
    assert "campaign file" in done.stderr


def test_ray_on_slurm_starts_the_head_and_the_others_and_then_the_campaign(tmp_path):
    for name in ("ray", "srun", "harness"):
        stub = tmp_path / name
        stub.write_text(f'#!/bin/sh\nsleep 0.2\necho {name} "$@" "${{RAY_AUTH_TOKEN:+secret}}" >> {tmp_path}/calls\n')
        stub.chmod(0o755)
    variables = {"SLURM_JOB_ID": "123456", "SLURM_JOB_NUM_NODES": "4", "SLURM_CPUS_PER_TASK": "16"}
    done = subprocess.run(
        ["bash", str(EXAMPLES / "slurm_ray.sh"), "c.yaml", "out", "--set", "stop.rhw=0.2"],
        env={"PATH": f"{tmp_path}:{os.environ['PATH']}", "SLURMD_NODENAME": "n1", **variables},
        capture_output=True,
        text=True,
        check=False,
        timeout=60,
    )
    assert (done.returncode, done.stderr) == (0, "")
    head, *others = (tmp_path / "calls").read_text().splitlines()
    assert head == "ray start --head --port=23456 --num-cpus=16 --disable-usage-stats secret"
    (joining,) = (words for words in others if words.startswith("srun"))
    assert "--nodes=3 --ntasks=3 --exclude=n1 ray start --address=" in joining
    assert ":23456 --num-cpus=16 --block secret" in joining
    (run,) = (words for words in others if words.startswith("harness"))
    assert run == "harness run c.yaml --set stop.rhw=0.2 --out out --executor ray --resume --workers 64 secret"
