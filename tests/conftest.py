"""What all tests share: settings, kernels that are compiled once, and runs that are made once.

Property tests depend neither on the clock nor on chance, nor leave a database behind. With ``HARNESS_TEST_SEED`` set,
Hypothesis looks elsewhere on every run, as the statistical tests do with that seed.
"""

import fcntl
import os
import re
import shutil
from collections.abc import Callable, Iterator
from contextlib import ExitStack, closing
from pathlib import Path

import pytest
from hypothesis import HealthCheck, settings

settings.register_profile(
    "harness",
    deadline=None,
    derandomize="HARNESS_TEST_SEED" not in os.environ,
    database=None,
    suppress_health_check=[HealthCheck.too_slow],  # the first example may compile kernels
)
settings.load_profile("harness")


@pytest.hookimpl(tryfirst=True)
def pytest_sessionstart(session: pytest.Session) -> None:
    """Compile kernels, as ``harness setup`` does, before workers of xdist wait for each other's."""
    if getattr(session.config.option, "numprocesses", None):
        from harness.runner.setup import compile_kernels

        compile_kernels()


def pytest_ignore_collect(collection_path: Path, config: pytest.Config) -> bool | None:
    """Files of slow tests alone need not be imported to be left out: it takes each worker seconds."""
    text = collection_path.read_text("utf-8") if collection_path.suffix == ".py" else ""
    slow = re.search(r"^pytestmark = \[?\s*pytest\.mark\.slow", text, re.MULTILINE)
    return True if slow and config.option.markexpr == "not slow" else None


def pytest_collection_modifyitems(items: list[pytest.Item]) -> None:
    """Files that take long come first, so that workers end together: they are handed out whole."""
    long = ("golden", "controllers", "runner", "worlds", "chains", "fitting", "families", "report")
    items.sort(key=lambda item: long.index(of) if (of := item.path.parent.name) in long else len(long))


@pytest.fixture(scope="session")
def made_once(tmp_path_factory: pytest.TempPathFactory) -> Callable[[str, Callable[[Path], object]], Path]:
    """A folder of some name, made when it is first asked for, once for all workers. Damage a copy only."""
    folder = tmp_path_factory.getbasetemp()
    folder = (folder.parent if "PYTEST_XDIST_WORKER" in os.environ else folder) / "stored"
    folder.mkdir(exist_ok=True)

    def of(name: str, make: Callable[[Path], object]) -> Path:
        out, done = folder / name, folder / f"{name}.done"
        with (folder / f"{name}.lock").open("w") as lock:
            fcntl.flock(lock, fcntl.LOCK_EX)
            if not done.exists():
                shutil.rmtree(out, ignore_errors=True)
                make(out)
                done.touch()
        return out

    return of


@pytest.fixture(scope="session")
def stored_run(made_once) -> Callable[[str], Path]:
    """The folder of a golden campaign, see `made_once`."""
    from tests.in_process import run_here
    from tests.stored_runs import golden

    return lambda name: made_once(name, lambda out: run_here(golden(name), out))


@pytest.fixture
def open_world() -> Iterator[Callable]:
    """Make SUMO worlds, of which a process may have one, that are closed after the test whatever happens in it."""
    from harness.worlds.sumo import SumoWorld

    with ExitStack() as worlds:
        yield lambda *arguments, of=SumoWorld, **options: worlds.enter_context(closing(of(*arguments, **options)))


@pytest.fixture(scope="session")
def fmu(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The IDM of the examples as an FMU."""
    builder = pytest.importorskip("pythonfmu.builder", reason="pythonfmu builds the FMU")
    examples = Path(__file__).parents[1] / "examples"
    folder = tmp_path_factory.mktemp("fmu")
    return builder.FmuBuilder.build_FMU(examples / "idm_fmu.py", dest=folder, project_files=[examples / "idm.py"])
