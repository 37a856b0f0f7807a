"""Imports all that takes long in the process that workers are forked from, in one thread, as forking needs it."""

import gc
import os
import signal
from contextlib import suppress
from importlib import import_module

before = signal.signal(signal.SIGINT, signal.SIG_IGN)  # Ctrl-C is handled by the command, this one's parent
signal.pthread_sigmask(signal.SIG_UNBLOCK, {signal.SIGINT})  # it began with it blocked (`harness.processes`)
os.environ.pop("PYTHONSAFEPATH", None)  # set for its own imports: programs that vehicles start need it not
os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")
for name in ("harness.runner.workers", "pandas", "libsumo"):  # pandas is loaded by pyarrow
    with suppress(Exception):  # an error is raised where the module is needed
        import_module(name)
signal.signal(signal.SIGINT, before)
gc.freeze()  # objects that are not traversed are not written to, and so stay shared with the copies
