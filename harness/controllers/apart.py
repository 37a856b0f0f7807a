"""Processes in which a user's code may do what it likes: print, hang, copy itself, end."""

from __future__ import annotations

import os
import pickle
import signal
import threading
import time
import traceback
from collections.abc import Callable
from contextlib import suppress
from multiprocessing.connection import Connection, wait
from multiprocessing.process import BaseProcess
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any, TypeVar

from harness.campaign.campaign import Campaign
from harness.campaign.vehicle import AutomatedVehicle
from harness.controllers.black_box import last_call
from harness.controllers.guard import death_cause
from harness.errors import EXIT_TOO_MANY_FAILED, HarnessError
from harness.interruption import leave_signals_to_parent
from harness.spawning import spawn_context

LOOK_S = 0.5
"""Time between two looks at a process whose pipe is silent: a copy that a controller made of it keeps the pipe open."""
_Answer = TypeVar("_Answer")


class AvEndedProcessError(HarnessError):
    """The AV's controller ended the process that it ran in."""

    exit_code = EXIT_TOO_MANY_FAILED


def start_process(target: Callable[..., None], *arguments: Any) -> BaseProcess:
    """Start a process that leaves stdout to the harness's results, and answers for all that it starts itself."""
    child = spawn_context().Process(target=_begin, args=(os.getpid(), target, *arguments), daemon=True)
    child.start()
    return child


def _begin(parent: int, target: Callable[..., None], *arguments: Any) -> None:
    leave_signals_to_parent()
    os.setsid()
    threading.Thread(target=_end_with, args=(parent,), daemon=True).start()
    with suppress(OSError):  # stderr may be closed
        os.dup2(2, 1)
    target(*arguments)


def _end_with(parent: int) -> None:
    """End this process and all that it has started once its parent has been killed: a shard may take hours more."""
    while os.getppid() == parent:
        time.sleep(LOOK_S)
    os.killpg(0, signal.SIGKILL)


def end_process(child: BaseProcess) -> int | None:
    """End a process at once, with everything that it has started; returns its exit code."""
    if child.is_alive():
        child.kill()
    child.join()
    with suppress(ProcessLookupError, PermissionError):  # there is nobody left, which is the usual case
        os.killpg(child.pid or 0, signal.SIGKILL)
    return child.exitcode


def has_foreign_code(campaign: Campaign) -> bool:
    """Whether the AV is code of the user's that runs inside of the harness's own processes."""
    return campaign.av.source in ("controller", "fmu")


def run_apart(av: AutomatedVehicle, work: Callable[..., _Answer], *arguments: Any) -> _Answer:
    """``work(*arguments, black_box=…)``, which runs an AV, in a process of its own.

    Raises
    ------
    HarnessError
        Whatever it raises.
    AvEndedProcessError
        The controller ended the process; the call it was in is named.
    """
    ours, theirs = spawn_context().Pipe()
    with TemporaryDirectory(prefix="harness-apart-") as folder:
        black_box = Path(folder) / "black-box"
        child = start_process(_work_and_tell, theirs, work, arguments, black_box)
        theirs.close()  # or the child's death would not end the pipe
        try:
            while not wait([ours], LOOK_S) and child.is_alive():
                pass
            answer = ours.recv() if ours.poll() else None
        except EOFError:
            answer = None
        finally:
            exit_code = end_process(child)
            ours.close()
        if answer is None:
            cause, call = death_cause(exit_code, av.limits.step_time_s), last_call(black_box)
            raise AvEndedProcessError(
                f"av.{av.source}",
                found=f"{cause}, " + ("while it was found" if call is None else f"in {call}"),
                expected="a controller that returns or raises",
                mend="Look for os._exit, a crash of compiled code, or a shortage of memory; then check again.",
            )
    (result,) = answer
    if isinstance(result, Exception):
        raise result
    return result  # type: ignore[no-any-return]


def _work_and_tell(
    connection: Connection, work: Callable[..., Any], arguments: tuple[Any, ...], black_box: Path
) -> None:
    try:
        answer = work(*arguments, black_box=black_box)
    except Exception as error:  # noqa: BLE001 - whatever goes wrong here is the parent's to judge
        answer = fit_to_travel(error)
    with suppress(OSError):  # the parent was killed: nobody is left to tell
        connection.send((answer,))


def fit_to_travel(error: Exception) -> Exception:
    """The error with its traceback as a note; in words where it cannot be pickled."""
    text = "".join(traceback.format_exception(error))
    error.add_note(f"In a worker process:\n{text}")
    try:
        pickle.loads(pickle.dumps(error))  # noqa: S301 - our own bytes
    except Exception:  # noqa: BLE001 - exceptions fail to be pickled in many ways
        return RuntimeError(text)
    return error
