"""Work beside the main thread: worker processes, threads, and how all of them end.

Workers are copies that `multiprocessing`'s fork server makes of itself, after it has imported all slow modules. Each
leads a session of its own: a terminal's signals do not reach it, and everything that it starts ends with it. It ends
when its parent does, however that ends.
"""

from __future__ import annotations

import atexit
import math
import os
import pickle
import signal
import subprocess
import sys
import tempfile
import threading
import time
import traceback
from collections import deque
from collections.abc import Callable, Iterable, Iterator, Sequence
from concurrent.futures import Future, ThreadPoolExecutor
from contextlib import contextmanager, suppress
from functools import cache
from io import TextIOWrapper
from multiprocessing import Pipe, forkserver, parent_process
from multiprocessing.connection import Connection, wait
from multiprocessing.context import ForkServerProcess
from pathlib import Path
from tempfile import TemporaryFile
from types import ModuleType
from typing import TYPE_CHECKING, Any, NamedTuple, TypeVar
from weakref import finalize

from harness.cache import SAID, temporary_folder
from harness.errors import HarnessError
from harness.printed import Printed

if TYPE_CHECKING:
    from threadpoolctl import ThreadpoolController

CLOSED_PIPE_EXIT_CODE = 76
"""Exit code of a process whose controller has closed its pipe."""
_ATTEMPTS = 3
_LOOK_S, _DYING_S, _STOPPED_S = 0.5, 1.0, 5.0
"""Time between two looks, how long a process may take to end after its pipe has been closed, and how long it may be
stopped."""
_PRELOADED = "harness.runner.preloaded"
SAFE_PATH = "PYTHONSAFEPATH"

_Item = TypeVar("_Item")
_Result = TypeVar("_Result")


# -- processes --


def leave_signals_to_parent() -> None:
    """Let this worker ignore what a terminal sends to all processes at once: its parent alone answers, and ends it."""
    for number in (signal.SIGINT, signal.SIGHUP):
        signal.signal(number, signal.SIG_IGN)


class SharedFile:
    """A file without a name, which ends with this object or process, however that ends; children open its ``path``."""

    def __init__(self, content: bytes = b"") -> None:
        self._file = TemporaryFile()  # noqa: SIM115
        self._file.write(content)
        self._file.flush()
        finalize(self, self._file.close)
        self.path = Path(f"/proc/{os.getpid()}/fd/{self._file.fileno()}")


class Began(NamedTuple):
    """A message that a process may send before its answer: the test that it has begun."""

    episode: int


class WorkerDeath(NamedTuple):
    """How a process died, and the test that it had begun, if any; no ``exit_code`` if its machine was lost."""

    exit_code: int | None
    episode: int | None


class Child:
    """A process that calls ``target(connection, *arguments)``, at the other end of a pipe, where it may `tell`.

    It finds modules where this one does, and does not run the main script again. What it prints does not go to stdout,
    which is for results (see `Printed`).
    """

    def __init__(self, target: Callable[..., None], *arguments: Any) -> None:
        self.connection, theirs = Pipe()
        self._printed, self._episode, self._answer = Printed(), None, None  # type: Printed, int | None, Any
        work = theirs, self._printed.pipe, dict(os.environ), target, arguments
        with theirs, self._printed.pipe, _server():  # or its death would not end the pipes
            self._process = _started(work)
        atexit.register(self.kill)

    def give(self, *work: Any) -> bool:
        """Send it work; False if it is dead."""
        try:
            self.connection.send(work)
        except OSError:
            return False
        return True

    def dismiss(self) -> None:
        """Tell it that no more work comes, so that it can end in its own way."""
        self.connection.close()

    @property
    def handles(self) -> tuple[Connection, int]:
        """What to wait for: the process sends something, or dies."""
        return self.connection, self._process.sentinel

    def hears(self) -> bool:
        """Receive one message, and say whether it was the `answer`."""
        try:
            word = self.connection.recv() if self.connection.poll() else WorkerDeath(self._died(), self._episode)
        except (EOFError, OSError, pickle.UnpicklingError):  # a vehicle may have spoilt what its process sends
            word = WorkerDeath(self._died(), self._episode)
        self._answer, self._episode = (self._answer, word.episode) if isinstance(word, Began) else (word, None)
        return not isinstance(word, Began)

    def answer(self) -> Any:
        """What it has told, raised if that is an error, or its `WorkerDeath`: no more care is needed then."""
        if isinstance(self._answer, BaseException):
            raise self._answer
        return self._answer

    def go_on(self) -> None:
        """Let it go on if it was stopped."""
        if self._process.pid is not None:
            with suppress(ProcessLookupError):
                os.kill(self._process.pid, signal.SIGCONT)

    def kill(self) -> int | None:
        """End it at once, with everything that it has started; returns its exit code."""
        atexit.unregister(self.kill)
        _end_started_by(self._process.pid)
        self._process.kill()
        self._process.join()
        self._printed.finish()
        self.connection.close()
        return self._process.exitcode

    def wait(self, seconds: float) -> None:
        """Give it some ``seconds`` to end by itself; then end it."""
        self._process.join(seconds)
        self.kill()

    def _died(self) -> int | None:
        """Exit code of a process that has closed its pipe; ends it if it lives on."""
        self._process.join(_DYING_S)
        lives, exit_code = self._process.is_alive(), self.kill()
        return CLOSED_PIPE_EXIT_CODE if lives else exit_code


_Child = TypeVar("_Child", bound=Child)


def first_to_answer(children: Sequence[_Child]) -> _Child:
    """Wait for one that has an answer, or has died; one that a vehicle has stopped (SIGSTOP) is made to go on."""
    while True:
        ready = wait([handle for child in children for handle in child.handles], _STOPPED_S)
        for child in children:
            if not ready:
                child.go_on()
            if not set(child.handles).isdisjoint(ready) and child.hears():
                return child


def tell(connection: Connection, work: Callable[[], Any]) -> None:
    """Send the result of some work, or its error; ends the process if nobody receives it."""
    try:
        answer = work()
    except Exception as error:  # noqa: BLE001 - whatever goes wrong here is the parent's to judge
        answer = fit_to_travel(error)
    try:
        connection.send(answer)
    except OSError:
        raise SystemExit(CLOSED_PIPE_EXIT_CODE) from None


def fit_to_travel(error: Exception) -> Exception:
    """The error with its traceback as a note; in words where it cannot be pickled."""
    text = "".join(traceback.format_exception(error))
    error.add_note(f"In a worker process:\n{text}")
    try:
        pickle.loads(pickle.dumps(error))  # noqa: S301 - our own bytes
    except Exception:  # noqa: BLE001 - exceptions fail to be pickled in many ways
        return MemoryError(text) if isinstance(error, MemoryError) else RuntimeError(text)  # none may be left to pickle
    return error


def start_server() -> None:
    """Start the fork server, which imports what workers need while this process goes on."""
    with _server():
        forkserver.ensure_running()


@contextmanager
def _server() -> Iterator[None]:
    """Set up this process for starting the fork server or a worker: neither is to run the main script again."""
    try:
        os.chdir(os.getcwd())  # noqa: PTH109 - as workers will
    except OSError:  # a folder that is gone, maybe a vehicle's doing, or one that this user may not go to
        os.chdir(os.sep)
    forkserver.set_forkserver_preload([_PRELOADED])
    short = _in_short(temporary_folder())
    main, sys.modules["__main__"] = sys.modules["__main__"], ModuleType("__main__")
    before, tempfile.tempdir = tempfile.tempdir, short
    # SIGINT would end it with a traceback; without others, which this process may have been started without, it waits.
    masked = signal.pthread_sigmask(signal.SIG_SETMASK, {signal.SIGINT})
    removed = {name: os.environ.pop(name) for name in (SAFE_PATH, "PYTHONHASHSEED") if name in os.environ}
    os.environ[SAFE_PATH] = "1"  # a json.py of the current folder is not what the server imports
    try:
        yield
    finally:
        sys.modules["__main__"], tempfile.tempdir = main, before
        os.environ.pop(SAFE_PATH)
        os.environ |= removed
        signal.pthread_sigmask(signal.SIG_SETMASK, masked)


@cache
def _in_short(folder: str) -> str:
    """A folder by a short path while this process lives: the server's socket there may have one of 107 bytes."""
    return f"/proc/{os.getpid()}/fd/{os.open(folder, os.O_DIRECTORY)}"


def _started(work: tuple[Any, ...]) -> ForkServerProcess:
    for _ in range(_ATTEMPTS):
        process = ForkServerProcess(target=_begin, args=work)
        try:
            process.start()
        except (EOFError, OSError) as error:  # the server was killed: the next attempt starts another
            why = str(error)
            time.sleep(_LOOK_S)  # until it is gone
        else:
            return process
    mend = "Raise the limits of open files, processes and memory (ulimit -n, -u, -v), then give the same command again."
    raise HarnessError("workers", f"no process that can be started ({why})", "one for each of --workers", mend)


def _begin(
    connection: Connection,
    printed: Connection,
    environment: dict[str, str],
    target: Callable[..., None],
    arguments: tuple[Any, ...],
) -> None:
    os.setsid()
    leave_signals_to_parent()
    signal.signal(signal.SIGCHLD, signal.SIG_DFL)  # where a parent ignores it, children leave no exit code
    os.environ.update({**environment, SAID: "1"})
    for standard in (1, 2):
        os.dup2(printed.fileno(), standard)
    printed.close()
    if isinstance(sys.stdout, TextIOWrapper):  # as on a terminal: nothing is lost if the process dies
        sys.stdout.reconfigure(line_buffering=True)
    threading.Thread(target=_end_with_parent, daemon=True).start()
    try:
        target(connection, *arguments)
    finally:
        _end_started_by(os.getpid())


def _end_with_parent() -> None:
    """End this process and all that it has started once its parent has been killed: a shard may take hours more."""
    if (parent := parent_process()) is not None:
        parent.join()
        _end_started_by(os.getpid())
        os.kill(os.getpid(), signal.SIGKILL)


def _end_started_by(leader: int | None) -> None:
    """End the processes of a session and their children, except its ``leader``; on Linux alone."""
    ended = {leader}
    for pid in sorted(int(folder.name) for folder in Path("/proc").glob("[0-9]*")):  # parents first
        with suppress(OSError):
            stat = Path(f"/proc/{pid}/stat").read_text(encoding="utf-8")
            _state, parent, _group, session, *_ = stat.rpartition(")")[2].split()
            if ended & {int(parent), int(session)} and pid != leader:
                ended.add(pid)
                os.kill(pid, signal.SIGKILL)


def end(process: subprocess.Popen[bytes]) -> int:
    """End a process and the group that it leads; returns its exit code."""
    with suppress(ProcessLookupError, PermissionError):  # there is nobody left
        os.killpg(process.pid, signal.SIGKILL)
    return process.wait()


# -- threads: the same work in the same order as without them, so that all bits are equal --


_CONTROL_GROUPS, _OWN_GROUPS = Path("/sys/fs/cgroup"), Path("/proc/self/cgroup")


@cache
def usable_cpus() -> int:
    """CPUs that this process may use, by its affinity and by the quotas of its control groups, rounded up."""
    return max(1, math.ceil(min([len(os.sched_getaffinity(0)), *_quotas()])))


def _quotas() -> Iterator[float]:
    """CPUs that a control group (version 1 or 2) allows, of each that this process is in and that has a quota."""
    with suppress(OSError):
        for line in _OWN_GROUPS.read_text(encoding="utf-8").splitlines():
            _, controllers, inner = line.split(":", 2)
            if controllers and "cpu" not in controllers.split(","):
                continue
            group = _CONTROL_GROUPS / ("cpu" if controllers else "") / inner.strip("/")
            # Within a container groups are named as outside, and are not there, but for the one at the top.
            for folder in (group, *group.parents):
                files = ("cpu.cfs_quota_us", "cpu.cfs_period_us") if controllers else ("cpu.max",)
                with suppress(OSError, ValueError):  # no such file, or no limit, which is "max"
                    quota, period = " ".join((folder / name).read_text(encoding="utf-8") for name in files).split()
                    if int(quota) > 0:
                        yield int(quota) / int(period)


@cache
def _libraries() -> ThreadpoolController:
    from threadpoolctl import ThreadpoolController  # noqa: PLC0415 - keeps --help fast

    return ThreadpoolController()


def side_by_side(
    function: Callable[[_Item], _Result], items: Sequence[_Item], *, worthwhile: bool = True
) -> list[_Result]:
    """Results, in order, of a function that lets go of the interpreter lock, for items independent of each other.

    Without threads where that is not ``worthwhile``: handing over a trifle costs more than doing it.
    """
    with _libraries().limit(limits=1, user_api="blas"):  # BLAS's own threads would wait for each other in busy loops
        return list(made_ahead(function, items)) if worthwhile else [function(item) for item in items]


def made_ahead(
    make: Callable[[_Item], _Result], items: Iterable[_Item], n_threads: int | None = None
) -> Iterator[_Result]:
    """Results of ``make`` in order; ``n_threads`` (one per CPU) make the next ones while one is in use."""
    n_threads = n_threads or usable_cpus()
    with ThreadPoolExecutor(n_threads, thread_name_prefix="made-ahead") as threads:
        coming: deque[Future[_Result]] = deque()
        for item in items:
            coming.append(threads.submit(make, item))
            if len(coming) > n_threads:
                yield coming.popleft().result()
        while coming:
            yield coming.popleft().result()
