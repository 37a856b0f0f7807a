"""Work beside the main thread: worker processes, other programs, threads, and how all of them end.

A worker leads a session of its own, so that a terminal's signals do not reach it and everything that it starts ends
with it. It ends when its parent does, however that ends.

Ctrl-C, SIGTERM and SIGHUP end a command in the same way: what is finished is kept. What the shell has set to be ignored
stays ignored: SIGHUP under ``nohup``, SIGINT in the background of a script.
"""

from __future__ import annotations

import mmap
import os
import pickle
import signal
import struct
import subprocess
import sys
import threading
import time
import traceback
from collections import deque
from collections.abc import Callable, Iterable, Iterator, Sequence
from concurrent.futures import Future, ThreadPoolExecutor
from contextlib import contextmanager, suppress
from functools import cache
from multiprocessing import Pipe
from multiprocessing.connection import Connection, wait
from pathlib import Path
from types import FrameType
from typing import TYPE_CHECKING, Any, NamedTuple, TypeVar

from harness.errors import writing

if TYPE_CHECKING:
    from threadpoolctl import ThreadpoolController

FROM_USER = (signal.SIGINT, signal.SIGTERM, signal.SIGHUP)
LOOK_S = 0.5
"""Time between two looks at a process whose pipe is silent: a copy that a controller made of it keeps the pipe open."""
_LEFT_TO_US = (signal.SIG_DFL, signal.default_int_handler)

_Item = TypeVar("_Item")
_Result = TypeVar("_Result")


# -- signals to a command --


class Interrupted(KeyboardInterrupt):
    """A signal asks for the end: raised in the main thread, so that every ``finally`` on the way does its work."""


class Interruption:
    """Which signal has asked for the end, if one has."""

    def __init__(self) -> None:
        self.signal: signal.Signals | None = None

    @property
    def exit_code(self) -> int:
        """128 and the number of the signal, as shells have it: 130, 143 or 129."""
        return 128 + (self.signal or signal.SIGINT)

    def arrive(self, number: int, _frame: FrameType | None) -> None:
        """Handle the signal: only Ctrl-C may ask again, for somebody who cannot wait until all is tidied up."""
        for other in (signal.SIGTERM, signal.SIGHUP):
            signal.signal(other, signal.SIG_IGN)
        signal.signal(signal.SIGINT, signal.default_int_handler)
        self.signal = signal.Signals(number)
        raise Interrupted(self.signal.name)


@contextmanager
def handlers_restored() -> Iterator[dict[signal.Signals, Any]]:
    """Put back, afterwards, the handlers of `FROM_USER` that are there before: none where no thread may set them."""
    before = {}
    if threading.current_thread() is threading.main_thread():
        before = {number: signal.getsignal(number) for number in FROM_USER}
    try:
        yield before
    finally:
        for number, handler in before.items():
            signal.signal(number, handler)


@contextmanager
def interruptible() -> Iterator[Interruption]:
    """Let signals interrupt what is inside."""
    interruption = Interruption()
    with handlers_restored() as before:
        for number, handler in before.items():
            if handler in _LEFT_TO_US:
                signal.signal(number, interruption.arrive)
        yield interruption


def leave_signals_to_parent() -> None:
    """Let this worker ignore what a terminal sends to all processes at once: its parent alone answers, and ends it."""
    for number in (signal.SIGINT, signal.SIGHUP):
        signal.signal(number, signal.SIG_IGN)


# -- processes --


class Child:
    """A process that calls ``target(connection, *arguments)``, at the other end of a pipe.

    It is a fresh Python, which finds modules where this one does and runs no script again. It prints to stderr:
    stdout is for the harness's results.
    """

    def __init__(self, target: Callable[..., None], *arguments: Any) -> None:
        work = pickle.dumps((target, arguments))
        self.connection, theirs = Pipe()
        code = f"import sys; sys.path[:] = {sys.path!r}; from harness.processes import _begin; "
        with theirs:  # or its death would not end the pipe
            self._process = subprocess.Popen(  # noqa: S603 - our own words
                [sys.executable, "-c", f"{code}_begin({theirs.fileno()}, {os.getpid()})"],
                stdin=subprocess.DEVNULL,
                env={"OPENBLAS_NUM_THREADS": "1", **os.environ},
                pass_fds=[theirs.fileno()],
                start_new_session=True,
            )
        with suppress(OSError):  # it has died already
            self.connection.send_bytes(work)

    def is_alive(self) -> bool:
        """Whether it runs."""
        return self._process.poll() is None

    def send(self, message: Any) -> bool:
        """Send it something; False if it is dead."""
        try:
            self.connection.send(message)
        except OSError:
            return False
        return True

    def receive(self) -> Any:
        """What it has sent; None where there is nothing, because it has died."""
        try:
            return self.connection.recv() if self.connection.poll() else None
        except (EOFError, OSError):
            return None

    def kill(self) -> int:
        """End it at once, with everything that it has started; returns its exit code."""
        exit_code = end(self._process)
        self.connection.close()
        return exit_code

    def wait(self, seconds: float) -> None:
        """Give it a little time to end by itself; then end it."""
        with suppress(subprocess.TimeoutExpired):
            self._process.wait(seconds)
        self.kill()


_Child = TypeVar("_Child", bound=Child)


def first_to_answer(children: Sequence[_Child]) -> _Child:
    """Wait for one that has sent something, or has died."""
    while True:
        dead = [child for child in children if not child.is_alive()]
        ready = wait([child.connection for child in children], 0.0 if dead else LOOK_S)
        if found := [child for child in children if child.connection in ready] or dead:
            return found[0]


def end(process: subprocess.Popen[bytes]) -> int:
    """End a process that leads a session, with everything that it has started; returns its exit code."""
    with suppress(ProcessLookupError, PermissionError):  # there is nobody left
        os.killpg(process.pid, signal.SIGKILL)
    return process.wait()


def _begin(descriptor: int, parent: int) -> None:
    """Do what this process has been started for."""
    leave_signals_to_parent()
    threading.Thread(target=_end_with, args=(parent,), daemon=True).start()
    with suppress(OSError):  # stderr may be closed
        os.dup2(2, 1)
    connection = Connection(descriptor)
    try:
        work = connection.recv_bytes()
    except (EOFError, OSError):  # the parent has been killed before it could say what to do
        raise SystemExit(1) from None
    target, arguments = pickle.loads(work)  # noqa: S301 - our own bytes
    target(connection, *arguments)


def _end_with(parent: int) -> None:
    """End this process and all that it has started once its parent has been killed: a shard may take hours more."""
    while os.getppid() == parent:
        time.sleep(LOOK_S)
    os.killpg(0, signal.SIGKILL)


def fit_to_travel(error: Exception) -> Exception:
    """The error with its traceback as a note; in words where it cannot be pickled."""
    text = "".join(traceback.format_exception(error))
    error.add_note(f"In a worker process:\n{text}")
    try:
        pickle.loads(pickle.dumps(error))  # noqa: S301 - our own bytes
    except Exception:  # noqa: BLE001 - exceptions fail to be pickled in many ways
        return RuntimeError(text)
    return error


# -- which call of a user's code a process was in when it died --


START = -1
"""Stands for the call of ``start``, which comes before step 0."""
CONSTRUCTOR, OF_EPISODE, START_BATCH, STEP_BATCH, CLOSE = range(1, 6)
_FORMAT = struct.Struct("=qqq")
_WORDS = {CONSTRUCTOR: "its constructor", START_BATCH: "start_batch", STEP_BATCH: "step_batch", CLOSE: "close"}
_forks: list[None] = []
"""One entry for each `os.fork` of this process; what starts programs (subprocess) does not pass here."""
os.register_at_fork(after_in_parent=lambda: _forks.append(None))


class Call(NamedTuple):
    """A call of a controller: its kind, and where it belongs to one episode, that and the step, or `START`."""

    kind: int
    episode: int
    step: int

    def __str__(self) -> str:
        if self.kind != OF_EPISODE:
            return _WORDS[self.kind]
        where = "start" if self.step == START else f"the call of step {self.step}"
        return f"{where} of episode {self.episode}"


class BlackBox:
    """Notes the call that is under way in a file, if any, and lets no copy of the process come back from one."""

    def __init__(self, path: Path | None) -> None:
        note: bytearray | mmap.mmap = bytearray(_FORMAT.size)
        if path is not None:
            with writing(path):
                path.write_bytes(note)
                with path.open("r+b") as file:
                    note = mmap.mmap(file.fileno(), _FORMAT.size)
        self._note = memoryview(note).cast("q")
        self._forks = len(_forks)
        self._pid = os.getpid()

    def enter(self, kind: int, episode: int = 0, step: int = START) -> None:
        """Note a call before it is made."""
        self._note[1] = episode
        self._note[2] = step
        self._note[0] = kind
        self._forks = len(_forks)

    def leave(self) -> None:
        """The call has come back; a process that dies does not come here, and one that was copied must not go on."""
        if os.getpid() != self._pid:
            os._exit(0)
        self._note[0] = 0

    def misdeed(self) -> str | None:
        """What a controller did in the last call that no controller may do, or None."""
        return None if len(_forks) == self._forks else "copied the process (os.fork); start programs with subprocess"


def last_call(path: Path) -> Call | None:
    """The call that a dead process was in, or None if it was not in a controller."""
    try:
        call = Call._make(_FORMAT.unpack(path.read_bytes()))
    except (OSError, struct.error):
        return None
    return call if call.kind else None


# -- threads: what is done, and in which order, is the same as without them, so every bit is --


@cache
def _shared_threads() -> tuple[ThreadPoolExecutor, ThreadpoolController]:
    from threadpoolctl import ThreadpoolController  # noqa: PLC0415 - keeps --help fast

    return ThreadPoolExecutor(os.cpu_count(), thread_name_prefix="estimators"), ThreadpoolController()


def side_by_side(
    function: Callable[[_Item], _Result], items: Sequence[_Item], *, worthwhile: bool = True
) -> list[_Result]:
    """Results, in order, of a function that lets go of the interpreter lock, for items independent of each other.

    Without threads where that is not ``worthwhile``: handing over a trifle costs more than doing it.
    """
    threads, libraries = _shared_threads()
    with libraries.limit(limits=1, user_api="blas"):  # BLAS's own threads would wait for each other in busy loops
        return list(threads.map(function, items)) if worthwhile else [function(item) for item in items]


def made_ahead(
    make: Callable[[_Item], _Result], items: Iterable[_Item], n_threads: int | None = None
) -> Iterator[_Result]:
    """What is made of each item, in order; the next ones are being made in threads while the present one is in use.

    ``n_threads`` (as many as there are cores by default) of them at a time: one where ``make`` is not to be called by
    two threads at once.
    """
    n_threads = n_threads or os.cpu_count() or 1
    with ThreadPoolExecutor(n_threads, thread_name_prefix="made-ahead") as threads:
        coming: deque[Future[_Result]] = deque()
        for item in items:
            coming.append(threads.submit(make, item))
            if len(coming) > n_threads:
                yield coming.popleft().result()
        while coming:
            yield coming.popleft().result()
