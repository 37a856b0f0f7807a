"""What the process imports that workers are copies of: all that takes long. It has one thread, as copies need it."""

import gc
import os
from contextlib import suppress
from importlib import import_module

os.environ.pop("PYTHONSAFEPATH", None)  # of this process alone, not of what vehicles start (`harness.processes`)
os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")
for name in ("harness.runner.workers", "pandas", "libsumo"):  # pandas is loaded by pyarrow
    with suppress(Exception):  # who needs it will say so
        import_module(name)
gc.freeze()  # what is never looked through is never copied
