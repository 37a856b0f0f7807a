"""Start worker processes that say nothing when they are interrupted, or their parent dies, before they have begun."""

from __future__ import annotations

import signal
from multiprocessing import popen_spawn_posix, resource_tracker, spawn
from multiprocessing.context import SpawnContext, SpawnProcess
from typing import Any

from harness.interruption import FROM_TERMINAL

_ORIGINAL = spawn.get_command_line


class _QuietPopen(popen_spawn_posix.Popen):
    """Starts a process with the terminal's signals held back until `leave_signals_to_parent`."""

    def _launch(self, process_obj: Any) -> None:
        resource_tracker.ensure_running()  # here, because it lets the signals through again
        before = signal.pthread_sigmask(signal.SIG_BLOCK, FROM_TERMINAL)
        setattr(spawn, "get_command_line", _quiet_command_line)  # noqa: B010 - the library has no other place for it
        try:
            super()._launch(process_obj)  # type: ignore[misc]
        finally:
            setattr(spawn, "get_command_line", _ORIGINAL)  # noqa: B010
            signal.pthread_sigmask(signal.SIG_SETMASK, before)


def _quiet_command_line(**handles: Any) -> list[str]:
    """The library's own, but a parent that died before it could send the work ends the process without a traceback."""
    command = _ORIGINAL(**handles)
    program = command.index("-c") + 1
    # Only what is read from the parent can end in EOFError here: errors of the work itself are caught below it.
    command[program] = f"try:\n {command[program]}\nexcept (EOFError, BrokenPipeError):\n raise SystemExit(1)"
    return command


class _QuietProcess(SpawnProcess):
    @staticmethod
    def _Popen(process_obj: Any) -> _QuietPopen:  # noqa: N802 - the library's name
        return _QuietPopen(process_obj)


class _QuietContext(SpawnContext):
    Process = _QuietProcess


def spawn_context() -> SpawnContext:
    """Context whose processes have to call `harness.interruption.leave_signals_to_parent` first of all."""
    return _QuietContext()
