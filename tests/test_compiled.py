"""The hash that names the kernel cache covers every file that machine code can come from; tuples as one pointer."""

import ast
import os
import pickle
import shutil
import subprocess
import sys
from pathlib import Path
from types import SimpleNamespace
from typing import Any, NamedTuple

import numba
import numpy as np
import pytest

import harness
from harness import cache
from harness.compiled import KERNEL_SOURCES, KERNELS, compiled, source_files, source_hash, unboxed
from harness.processes import WorkerDeath
from harness.runner.setup import compile_kernels

ROOT = Path(harness.__file__).parent
SMOKE = ROOT.parent / "scenarios" / "smoke.yaml"
DECORATORS = {"compiled", "compiled_inline", "compiled_threads"}


def module_path(name: str) -> str | None:
    """File of a module of the harness, relative to the package."""
    parts = name.split(".")[1:]
    for path in (Path(*parts).with_suffix(".py") if parts else Path("__init__.py"), Path(*parts, "__init__.py")):
        if (ROOT / path).is_file():
            return path.as_posix()
    return None


def names_in(nodes) -> set[str]:
    return {name.id for node in nodes for name in ast.walk(node) if isinstance(name, ast.Name)}


def files_behind(name: str, *, constants_alone: bool = False) -> set[str]:
    """Files whose content ends in the machine code of this one: its own, and those of the names its kernels read.

    And of the names that its own constants are made from, which alone count where it holds no kernels.
    """
    tree = ast.parse((ROOT / name).read_text(encoding="utf-8"))
    origin = {
        alias.asname or alias.name: module_path(f"{node.module}.{alias.name}") or module_path(node.module)
        for node in ast.walk(tree)
        if isinstance(node, ast.ImportFrom) and (node.module or "").startswith("harness")
        for alias in node.names
    }
    functions = [node for node in ast.walk(tree) if isinstance(node, ast.FunctionDef)]
    kernels = [each for each in functions if names_in(each.decorator_list) & DECORATORS]
    if not kernels and not constants_alone:
        return set()
    read = [node for kernel in kernels for node in (*kernel.body, *kernel.decorator_list)]
    read += [node.value for node in tree.body if isinstance(node, ast.Assign | ast.AnnAssign) and node.value]
    return {name} | {origin[each] for each in names_in(read) if origin.get(each)}


def covered(patterns) -> set[str]:
    return {path.relative_to(ROOT).as_posix() for path in source_files(tuple(patterns))}


def test_every_file_that_kernels_come_from_is_hashed():
    modules = [path.relative_to(ROOT).as_posix() for path in ROOT.rglob("*.py")]
    needed = set().union(*map(files_behind, modules))
    while more := set().union(*(files_behind(each, constants_alone=True) for each in needed)) - needed:
        needed |= more
    assert len(needed) >= 18  # the search itself must not silently find nothing
    assert needed <= covered(KERNEL_SOURCES)
    assert not needed <= covered([pattern for pattern in KERNEL_SOURCES if pattern != "vocabulary.py"])
    assert all(covered([pattern]) for pattern in KERNEL_SOURCES)
    assert source_hash() in KERNELS
    changes_no_test = {name for name in covered(["families/**/*.py"]) if "words" in name or "fitting" in name}
    assert not changes_no_test  # so that pools stay when only words or fits change
    assert KERNELS.endswith(f"-numba-{numba.__version__}")


def of_another_process(lines: str, **environment: str) -> subprocess.CompletedProcess:
    command, variables = [sys.executable, "-c", lines], {**os.environ, **environment}
    return subprocess.run(command, env=variables, capture_output=True, text=True, check=False)


@pytest.mark.slow
def test_numba_with_a_vector_library_is_refused():
    refused = of_another_process("import numba; numba.config.USING_SVML = True; import harness.compiled")
    assert refused.returncode != 0
    assert "Import harness before numba" in refused.stderr


def test_a_numba_that_compiles_nothing_is_refused(tmp_path):
    arguments = ["run", str(SMOKE), "--out", str(tmp_path)]
    refused = of_another_process(
        f"import sys; from harness.cli import main; sys.exit(main({arguments}))", NUMBA_DISABLE_JIT="1"
    )
    assert refused.returncode == 2
    assert refused.stderr.startswith("error: NUMBA_DISABLE_JIT\n")


@pytest.mark.slow
def test_a_numba_that_cannot_be_imported_is_named(tmp_path, monkeypatch):
    (tmp_path / ".numba_config.yaml").write_text("- 3")
    monkeypatch.chdir(tmp_path)
    monkeypatch.setenv("PYTHONPATH", str(SMOKE.parents[1]))
    refused = of_another_process("import sys; from harness.cli import main; sys.exit(main(['check', 'idm']))")
    assert refused.returncode == 2
    assert refused.stderr.startswith("error: numba\n")
    assert ".numba_config.yaml" in refused.stderr


@pytest.mark.slow
def test_a_copy_of_the_package_finds_what_another_has_compiled_unless_it_is_damaged(tmp_path):
    (tmp_path / "of_a_user.py").write_text("import numba\n@numba.njit(cache=True)\ndef twice(x):\n    return 2 * x\n")
    say_hits = (
        "from harness import compiled, random_stream; cached = compiled.is_cached(random_stream._fill_uniforms);"
        "random_stream.uniforms(1, 0, 1, 0, 1); "
        "from of_a_user import twice; twice(2);"
        "print(*(sum(kernel.stats.cache_hits.values()) for kernel in (random_stream._fill_uniforms, twice)), cached)"
    )
    hits = []
    for copy in ("one", "another", "after damage", "after that"):
        shutil.copytree(ROOT, tmp_path / copy / "harness", ignore=shutil.ignore_patterns("__pycache__"))
        if copy == "after damage":
            (kernel,) = tmp_path.glob(f"{KERNELS}/*_fill_uniforms-*")
            content = kernel.read_bytes()
            kernel.write_bytes(content[:900] + bytes([content[900] ^ 4]) + content[901:])
        path = f"{tmp_path / copy}:{tmp_path}"
        said = of_another_process(say_hits, HARNESS_CACHE_DIR=str(tmp_path), PYTHONPATH=path)
        hits.append(said.stdout.split())
    assert hits == [["0", "0", "False"], ["1", "1", "True"], ["0", "1", "True"], ["1", "1", "True"]]


@pytest.mark.slow
def test_processes_side_by_side_compile_a_kernel_once(tmp_path):
    script = (
        "from harness import random_stream; random_stream.uniforms(1, 0, 1, 0, 1);"
        "print(sum(random_stream._fill_uniforms.stats.cache_hits.values()))"
    )
    variables = {**os.environ, cache.FOLDER: str(tmp_path)}
    both = [subprocess.Popen([sys.executable, "-c", script], env=variables, stdout=subprocess.PIPE) for _ in range(2)]
    assert sorted(process.communicate()[0] for process in both) == [b"0\n", b"1\n"]


# -- named tuples that kernels are given as one pointer: what compiled code reads is the tuple's own --


class Bundle(NamedTuple):
    factor: float
    steps: int
    doubled: bool
    fixed: np.ndarray
    numbers: Any


def bundle():
    fixed = np.arange(12.0).reshape(3, 4)
    fixed.flags.writeable = False
    numbers = np.array([(2.5, 7)], [("weight", float), ("count", int)])[0]
    return Bundle(0.5, 3, True, fixed, numbers)


@compiled
def add_up(b):
    total = b.numbers.count * b.numbers.weight
    for i in range(b.steps):
        total += b.factor * b.fixed[i, 1] * (2.0 if b.doubled else 1.0)
    return total


def test_kernels_read_every_kind_of_field_also_of_a_record_that_owns_its_memory():
    """As one does that another process has sent: what numpy says of its address is that of a copy, gone at once."""
    sent = pickle.loads(pickle.dumps(bundle()))
    assert sent.numbers.flags.owndata
    for_kernels = unboxed(sent)
    others = [np.full(2, -1) for _ in range(1000)]  # would take over memory that had been given back
    assert add_up(for_kernels) == add_up(unboxed(bundle())) == 32.5
    assert len(others) == 1000


def test_every_field_has_8_bytes_and_what_does_not_fit_is_refused():
    class Two(NamedTuple):
        one: Any
        other: Any

    @compiled
    def difference(two):
        return two.one - two.other

    assert difference(unboxed(Two(np.int32(-7), True))) == -8
    with pytest.raises(TypeError, match="float32"):
        unboxed(Two(np.float32(0.5), 1.0))


# -- harness setup compiles what a first run needs --


AV = "class MyAV:\n    def step(self, seen):\n        return -0.5\n"


@pytest.mark.slow
def test_a_first_run_compiles_nothing(tmp_path):
    """Neither of a built-in vehicle nor of a controller, in SUMO."""
    variables = {**os.environ, cache.FOLDER: str(tmp_path / "cache")}
    (tmp_path / "my_av.py").write_text(AV)

    def harness(*arguments):
        subprocess.run([sys.executable, "-m", "harness", *arguments], env=variables, cwd=tmp_path, check=True)

    def kernels():
        return {path.name for path in (tmp_path / "cache" / KERNELS).iterdir()}

    harness("setup")
    before = kernels()
    assert len(before) > 5
    nade = "testing.method=step_mixture", "environment.parameters=ndd-overtaking-1"
    for i, (av, *sets) in enumerate(
        [("idm",), ("my_av.py:MyAV",), ("idm", *nade), ("my_av.py:MyAV", "scenario=cut_out")]
    ):
        sets += ["stop.episodes=300", "stop.rhw=null"]
        harness("run", av, *(word for each in sets for word in ("--set", each)), "--out", str(i))
    assert kernels() == before


def test_what_was_compiled_is_not_compiled_again(tmp_path, monkeypatch):
    monkeypatch.setenv(cache.FOLDER, str(tmp_path))
    monkeypatch.setattr("harness.runner.setup.run_campaign", lambda *_, **__: None)
    monkeypatch.setattr("harness.runner.setup._OTHERS", [])
    died = SimpleNamespace(answer=lambda: WorkerDeath(-9, None))
    with monkeypatch.context() as patch:
        patch.setattr("harness.runner.setup.first_to_answer", lambda _: died)
        assert [compile_kernels(), compile_kernels()] == [True, True]
    assert [compile_kernels(), compile_kernels()] == [True, False]
