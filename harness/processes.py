"""Work beside the main thread: worker processes, other programs, threads, and how all of them end.

A worker leads a session of its own, so that a terminal's signals do not reach it and everything that it starts ends
with it. It ends when its parent does, however that ends. What it has started in further sessions falls to the process
that has started the worker, a `ForkServer`, which ends it with itself.

Ctrl-C, SIGTERM and SIGHUP end a command in the same way: what is finished is kept. What the shell has set to be ignored
stays ignored: SIGHUP under ``nohup``, SIGINT in the background of a script.
"""

from __future__ import annotations

import ctypes
import gc
import math
import mmap
import os
import pickle
import signal
import socket
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
from importlib import import_module
from io import TextIOWrapper
from multiprocessing import Pipe
from multiprocessing.connection import Connection, wait
from multiprocessing.reduction import recv_handle, sendfds
from pathlib import Path
from tempfile import TemporaryFile
from types import FrameType
from typing import TYPE_CHECKING, Any, NamedTuple, TypeVar
from weakref import finalize

from harness.cache import SAID
from harness.errors import HarnessError, writing
from harness.progress import Progress

if TYPE_CHECKING:
    from threadpoolctl import ThreadpoolController

FROM_USER = (signal.SIGINT, signal.SIGTERM, signal.SIGHUP)
LOOK_S = 0.5
"""Time between two looks at a process whose pipe is silent: a copy that a controller made of it keeps the pipe open."""
CLOSED_PIPE_EXIT_CODE = 76
"""Exit code of a process whose controller has closed its pipe."""
PRINTED_BYTES = 65_536
"""Of what a process prints first, and of what it prints last, that is passed on."""
_POLL_S, _FORK_ATTEMPTS = 0.005, 3
_DYING_S, _ENDING_S = 1.0, 5.0
"""How long a process may take to end once its pipe has, and a server to end all that it is left with."""
_PR_SET_CHILD_SUBREAPER = 36
_LEFT_TO_US = (signal.SIG_DFL, signal.default_int_handler)

_Item = TypeVar("_Item")
_Result = TypeVar("_Result")


# -- signals to a command --


class Interruption:
    """Which signal has asked for the end, if one has: as Ctrl-C does, so that every ``finally`` does its work."""

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
        Progress.cancelled = True  # a library may lose what is raised here: then the next report raises it again
        raise KeyboardInterrupt(self.signal.name)


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


def open_streams() -> None:
    """Open what the shell has closed of the three standard streams: else a file or a pipe would take its number."""
    while (descriptor := os.open(os.devnull, os.O_RDWR)) <= 2:
        pass
    os.close(descriptor)
    for name in ("stdin", "stdout", "stderr"):
        if getattr(sys, name) is None:
            setattr(sys, name, open(os.devnull, "r" if name == "stdin" else "w", encoding="utf-8"))  # noqa: SIM115, PTH123


@contextmanager
def interruptible() -> Iterator[Interruption]:
    """Let signals interrupt what is inside."""
    interruption = Interruption()
    with handlers_restored() as before:
        for number, handler in before.items():
            if handler in _LEFT_TO_US:
                signal.signal(number, interruption.arrive)
        try:
            yield interruption
        finally:
            Progress.cancelled = False


def leave_signals_to_parent() -> None:
    """Let this worker ignore what a terminal sends to all processes at once: its parent alone answers, and ends it."""
    for number in (signal.SIGINT, signal.SIGHUP):
        signal.signal(number, signal.SIG_IGN)


# -- processes --


class SharedFile:
    """A file without a name, which ends with this object or process, however that ends; children open its ``path``."""

    def __init__(self, content: bytes = b"") -> None:
        self._file = TemporaryFile()  # noqa: SIM115
        self._file.write(content)
        self._file.flush()
        finalize(self, self._file.close)
        self.path = Path(f"/proc/{os.getpid()}/fd/{self._file.fileno()}")


class Printed:
    """What a process prints: its first 64 kB pass on to stderr at once, its last 64 kB in the end, no more of it.

    The process writes to ``descriptor``, which is to be closed here once it has it.
    """

    def __init__(self) -> None:
        self._read, self.descriptor = os.pipe()
        self._is_over = threading.Event()
        self._thread = threading.Thread(target=self._pass_on, name="printed", daemon=True)

    def begin(self) -> None:
        """Listen to the process, which has started."""
        os.close(self.descriptor)
        self._thread.start()

    def finish(self) -> None:
        """Pass on the rest: the process has ended, if perhaps not all that it has started."""
        self._is_over.set()
        self._thread.join()

    def _pass_on(self) -> None:
        left, last, n_lost = PRINTED_BYTES, bytearray(), 0
        while chunk := self._next():
            first, rest = chunk[:left], chunk[left:]
            left -= len(first)
            last += rest
            n_lost += max(0, len(last) - PRINTED_BYTES)
            del last[:-PRINTED_BYTES]
            _to_stderr(first)
        os.close(self._read)
        _to_stderr(f"\n[{n_lost:,} bytes more that a worker has printed]\n".encode() * bool(n_lost) + last)

    def _next(self) -> bytes:
        """What it has printed since; nothing once all is told."""
        while not wait([self._read], LOOK_S):
            if self._is_over.is_set():
                return b""
        return os.read(self._read, PRINTED_BYTES)


def _to_stderr(text: bytes) -> None:
    with suppress(OSError), open(2, "wb", closefd=False) as stderr:
        stderr.write(text)


class Child:
    """A process that calls ``target(connection, *arguments)``, at the other end of a pipe.

    It is a fresh Python, which finds modules where this one does and runs no script again, or a copy that a
    ``server`` makes of itself. It prints to stderr (see `Printed`): stdout is for the harness's results.
    """

    def __init__(self, target: Callable[..., None], *arguments: Any, server: ForkServer | None = None) -> None:
        work = pickle.dumps((target, arguments))
        self.connection, theirs = Pipe()
        self._printed, start = Printed(), _fresh_python if server is None else server.fork
        with theirs:  # or its death would not end the pipe
            self._process = start((theirs.fileno(), self._printed.descriptor))
        self._printed.begin()
        with suppress(OSError):  # it has died already
            self.connection.send_bytes(work)

    def is_alive(self) -> bool:
        """Whether it runs."""
        return self._process.poll() is None

    def kill(self) -> int:
        """End it at once, with everything that it has started; returns its exit code."""
        exit_code = end(self._process)
        self._printed.finish()
        self.connection.close()
        return exit_code

    def wait(self, seconds: float) -> None:
        """Give it a little time to end by itself; then end it."""
        with suppress(subprocess.TimeoutExpired):
            self._process.wait(seconds)
        self.kill()


class WorkerDeath(NamedTuple):
    """How a worker died: in which ``call`` of a controller, if in one; no ``exit_code`` if it went with its machine."""

    exit_code: int | None
    call: Call | None


class Apart(Child):
    """A child in which a user's code may run: it `tell`s what its work comes to, or leaves the call that it died in."""

    def __init__(self, server: ForkServer, target: Callable[..., None], *arguments: Any) -> None:
        self._black_box = SharedFile()
        super().__init__(target, *arguments, self._black_box.path, server=server)

    def answer(self) -> Any:
        """What it has told, raised if that is an error, or its `WorkerDeath`: no more care is needed then."""
        answer: Any = self  # as long as nothing has been told
        with suppress(EOFError, OSError):
            if self.connection.poll():
                answer = self.connection.recv()
        if answer is self:
            return WorkerDeath(self._died(), last_call(self._black_box.path))
        if isinstance(answer, BaseException):
            raise answer
        return answer

    def _died(self) -> int:
        """Exit code of one that has ended its pipe; if it lives on without it, it is ended."""
        with suppress(subprocess.TimeoutExpired):
            self._process.wait(_DYING_S)
            return self.kill()
        self.kill()
        return CLOSED_PIPE_EXIT_CODE


def tell(connection: Connection, work: Callable[[], Any]) -> bool:
    """Send what some work comes to, or its error; False if the parent was killed: nobody is left to tell."""
    try:
        answer = work()
    except Exception as error:  # noqa: BLE001 - whatever goes wrong here is the parent's to judge
        answer = fit_to_travel(error)
    try:
        connection.send(answer)
    except OSError:
        return False
    return True


_Apart = TypeVar("_Apart", bound=Apart)


def first_to_answer(children: Sequence[_Apart]) -> _Apart:
    """Wait for one that has sent something, or has died."""
    while True:
        dead = [child for child in children if not child.is_alive()]
        ready = wait([child.connection for child in children], 0.0 if dead else LOOK_S)
        if found := [child for child in children if child.connection in ready] or dead:
            return found[0]


def _fresh_python(descriptors: tuple[int, int]) -> subprocess.Popen[bytes]:
    code = f"import sys; sys.path[:] = {sys.path!r}; from harness.processes import _begin; "
    return subprocess.Popen(  # noqa: S603 - our own words
        [sys.executable, "-c", f"{code}_begin({descriptors}, {os.getpid()})"],
        stdin=subprocess.DEVNULL,
        env={"OPENBLAS_NUM_THREADS": "1", **os.environ, SAID: "1"},
        pass_fds=descriptors,
        start_new_session=True,
    )


class ForkServer:
    """A process that imports modules once and then copies itself: a child begins at once, and shares their memory.

    It has one thread and runs nobody's code, so that a copy lacks nothing. Its children end with it, as it does with
    its parent, and so does what they have started in sessions of their own (but for systems other than Linux). It
    starts when it is first needed, and again if it was killed.
    """

    def __init__(self, *modules: str) -> None:
        self._modules, self._child = modules, None  # type: tuple[str, ...], Child | None

    def start(self) -> Child:
        """Let it import what it needs, beside the caller."""
        if self._child is None or not self._child.is_alive():
            self._child = Child(_serve_forks, self._modules)
        return self._child

    def fork(self, descriptors: tuple[int, int]) -> Forked:
        """A copy that does the work which it receives, and prints, there; an `OSError` where there can be none."""
        for _ in range(_FORK_ATTEMPTS):
            child = self.start()
            with suppress(EOFError, OSError):  # it has been killed
                child.connection.send(None)
                with socket.fromfd(child.connection.fileno(), socket.AF_UNIX, socket.SOCK_STREAM) as sender:
                    sender.setblocking(True)  # whatever a user's code makes the default
                    for descriptor in descriptors:
                        sendfds(sender, [descriptor])
                answer = child.connection.recv()
                break
        else:
            answer = ChildProcessError("the process that starts workers was killed again and again")
        if isinstance(answer, OSError):
            raise answer
        return Forked(child, answer)

    def close(self) -> None:
        """Let it end all that its children have left, and itself."""
        if self._child is not None:
            self._child.connection.close()
            self._child.wait(2.0 * _ENDING_S)
            self._child = None


class Forked:
    """A copy of a `ForkServer`, with as much of `subprocess.Popen` as is needed."""

    def __init__(self, server: Child, pid: int) -> None:
        self._server, self.pid = server, pid
        self._exit_code: int | None = None
        self._is_orphan = False

    def poll(self) -> int | None:
        """Its exit code; None while it runs."""
        if self._exit_code is None:
            try:
                self._server.connection.send(self.pid)
                self._exit_code = self._server.connection.recv()
            except (EOFError, OSError):
                self._exit_code, self._is_orphan = -signal.SIGKILL, True  # its server was killed, and it ends with that
        return self._exit_code

    def let_end(self) -> None:
        """Give an orphan the time to end what it has started in further sessions: nobody else could."""
        self.poll()
        until = time.monotonic() + LOOK_S + _ENDING_S
        with suppress(ProcessLookupError):
            while self._is_orphan and time.monotonic() < until:
                os.kill(self.pid, 0)
                time.sleep(_POLL_S)

    def wait(self, timeout: float = math.inf) -> int:
        """Its exit code, once it has ended; `subprocess.TimeoutExpired` if it does not."""
        until = time.monotonic() + timeout
        while (code := self.poll()) is None:
            if time.monotonic() > until:
                raise subprocess.TimeoutExpired("a worker", timeout)
            time.sleep(_POLL_S)
        return code


def _serve_forks(connection: Connection, modules: Sequence[str]) -> None:
    """Tell the exit code of a child, or make one: the copy leaves this function to do its own work."""
    for name in modules:
        with suppress(ImportError, HarnessError):  # who needs it will say so
            import_module(name)
    gc.freeze()  # what is never looked through is never copied
    server, parent = os.getpid(), os.getppid()
    ended: dict[int, int] = {}
    while True:
        try:
            while not connection.poll(LOOK_S) and os.getppid() == parent:
                _reap(ended)
            pid = connection.recv()
            if pid is not None:
                _reap(ended)
                connection.send(ended.pop(pid, None))
                continue
            descriptors = recv_handle(connection), recv_handle(connection)
        except (EOFError, OSError):  # the parent is gone
            _end_children()
            return
        answer: int | OSError
        try:
            answer = _copied()
        except OSError as error:
            answer = error
        if answer == 0:
            connection.close()
            _begin(descriptors, server)
            return
        for descriptor in descriptors:
            os.close(descriptor)
        if isinstance(answer, int):
            ended.pop(answer, None)  # of one that had this number before
        connection.send(answer)


def _reap(ended: dict[int, int]) -> None:
    """Note the exit codes of children that have ended."""
    with suppress(ChildProcessError):  # there is none
        while (found := os.waitpid(-1, os.WNOHANG))[0]:
            ended[found[0]] = os.waitstatus_to_exitcode(found[1])


def _end_children() -> None:
    """End all children; what these leave to this process ends in the next turn."""
    until = time.monotonic() + _ENDING_S
    with suppress(ChildProcessError):
        while time.monotonic() < until:
            for task in Path("/proc/self/task").glob("*/children"):
                for pid in task.read_text(encoding="ascii").split():
                    with suppress(OSError):
                        os.kill(int(pid), signal.SIGKILL)
            while os.waitpid(-1, os.WNOHANG)[0]:
                pass
            time.sleep(_POLL_S)


def _copied() -> int:
    """Fork: 0 in the copy; here its number, once it is dead or leads a session, and can be ended with all it starts."""
    leads, ready = os.pipe()
    with os.fdopen(leads, "rb", 0) as until_it_leads:
        with os.fdopen(ready, "wb", 0):
            if (pid := os.fork()) == 0:
                os.setsid()
                return 0
        until_it_leads.read()
    return pid


_ahead: list[ForkServer] = []


@contextmanager
def imports_ahead(*modules: str) -> Iterator[None]:
    """Let the next `fork_server` import its modules already, beside this process."""
    _ahead.append(ForkServer(*modules))
    try:
        _ahead[-1].start()
        yield
    finally:
        for server in _ahead:  # nobody has asked for it
            server.close()
        _ahead.clear()


def fork_server(*modules: str) -> ForkServer:
    """One for these modules: that of `imports_ahead`, or one that starts when it is needed."""
    return _ahead.pop() if _ahead else ForkServer(*modules)


def worker_modules(engine: str) -> tuple[str, ...]:
    """What takes long to import, of all that runs shards in a world; pandas is loaded by pyarrow."""
    return "harness.runner.workers", "pandas", *(("libsumo",) if engine == "sumo" else ())


def end(process: subprocess.Popen[bytes] | Forked) -> int:
    """End a process that leads a session, with everything that it has started; returns its exit code."""
    if isinstance(process, Forked):
        process.let_end()
    with suppress(ProcessLookupError, PermissionError):  # there is nobody left
        os.killpg(process.pid, signal.SIGKILL)
    return process.wait()


def _begin(descriptors: tuple[int, int], parent: int) -> None:
    """Do what this process has been started for: it hears that by one descriptor, and prints to the other."""
    descriptor, printed = descriptors
    leave_signals_to_parent()
    signal.signal(signal.SIGCHLD, signal.SIG_DFL)  # where a parent ignores it, children leave no exit code
    if sys.platform == "linux":  # what children leave behind becomes a child of this process
        ctypes.CDLL(None).prctl(_PR_SET_CHILD_SUBREAPER, 1)
    for standard in (1, 2):
        os.dup2(printed, standard)
    os.close(printed)
    if isinstance(sys.stdout, TextIOWrapper):  # as on a terminal: nothing is lost if the process dies
        sys.stdout.reconfigure(line_buffering=True)
    connection = Connection(descriptor)
    _pipe[:] = [descriptor]
    try:
        work = connection.recv_bytes()
    except (EOFError, OSError):  # the parent has been killed before it could say what to do
        raise SystemExit(1) from None
    target, arguments = pickle.loads(work)  # noqa: S301 - our own bytes
    if target is not _serve_forks:  # which has no threads, and waits for its parent all the time
        threading.Thread(target=_end_with, args=(parent,), daemon=True).start()
    target(connection, *arguments)


def _end_with(parent: int) -> None:
    """End this process and all that it has started once its parent has been killed: a shard may take hours more."""
    while os.getppid() == parent:
        time.sleep(LOOK_S)
    _end_children()
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


START, MAKING = -1, -2
"""Stand for the call of ``start``, which comes before step 0, and of the constructor, before that."""
CONSTRUCTOR, OF_EPISODE, START_BATCH, STEP_BATCH, CLOSE = range(1, 6)
_FORMAT = struct.Struct("=qqq")
_WORDS = {CONSTRUCTOR: "its constructor", START_BATCH: "start_batch", STEP_BATCH: "step_batch", CLOSE: "close"}
_pipe: list[int] = []
"""Descriptor by which this process is connected with its parent, if it is."""
_forks: list[None] = []
"""One entry for each `os.fork` of this process; what starts programs (subprocess) does not pass here."""
os.register_at_fork(after_in_parent=lambda: _forks.append(None))


class Call(NamedTuple):
    """A call of a controller: its kind, and where it belongs to one episode, that and the step, `START` or `MAKING`."""

    kind: int
    episode: int
    step: int

    def __str__(self) -> str:
        if self.kind != OF_EPISODE:
            return _WORDS[self.kind]
        where = {START: "start", MAKING: "the constructor"}.get(self.step, f"the call of step {self.step}")
        return f"{where} of episode {self.episode}"

    @property
    def makes(self) -> bool:
        """Whether it is the constructor's."""
        return self.kind == CONSTRUCTOR or self.step == MAKING


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
        """The call has come back; a process that dies does not come here.

        One that was copied must not go on, and one whose pipe was closed cannot.
        """
        if os.getpid() != self._pid:
            os._exit(0)
        try:
            for descriptor in _pipe:
                os.get_inheritable(descriptor)
        except OSError:
            os._exit(CLOSED_PIPE_EXIT_CODE)
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


_CONTROL_GROUPS, _OWN_GROUPS = Path("/sys/fs/cgroup"), Path("/proc/self/cgroup")


@cache
def usable_cpus() -> int:
    """CPUs that this process may use: its affinity allows so many, and the quota of its control groups, rounded up."""
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
def _shared_threads() -> tuple[ThreadPoolExecutor, ThreadpoolController]:
    from threadpoolctl import ThreadpoolController  # noqa: PLC0415 - keeps --help fast

    return ThreadPoolExecutor(usable_cpus(), thread_name_prefix="estimators"), ThreadpoolController()


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

    ``n_threads`` (as many as there are CPUs by default) of them at a time: one where ``make`` is not to be called by
    two threads at once.
    """
    n_threads = n_threads or usable_cpus()
    with ThreadPoolExecutor(n_threads, thread_name_prefix="made-ahead") as threads:
        coming: deque[Future[_Result]] = deque()
        for item in items:
            coming.append(threads.submit(make, item))
            if len(coming) > n_threads:
                yield coming.popleft().result()
        while coming:
            yield coming.popleft().result()
