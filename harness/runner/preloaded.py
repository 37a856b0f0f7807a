"""What the process imports that workers are copies of: all that takes long. It has one thread, as copies need it."""

import gc
import os
import signal
from contextlib import suppress
from importlib import import_module

before = signal.signal(signal.SIGINT, signal.SIG_IGN)  # of Ctrl-C the command itself tells, which has begun this
signal.pthread_sigmask(signal.SIG_UNBLOCK, {signal.SIGINT})  # without it (`harness.processes`)
os.environ.pop("PYTHONSAFEPATH", None)  # of this process alone, not of what vehicles start (`harness.processes`)
os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")
for name in ("harness.runner.workers", "pandas", "libsumo"):  # pandas is loaded by pyarrow
    with suppress(Exception):  # who needs it will say so
        import_module(name)
signal.signal(signal.SIGINT, before)
gc.freeze()  # what is never looked through is never copied
