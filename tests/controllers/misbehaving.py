"""Controllers that are the built-in IDM until an episode in which they go wrong, in each in its own way."""

import ctypes
import math
import os
import pkgutil
import random
import resource
import signal
import socket
import subprocess
import sys
import time
from contextlib import suppress
from pathlib import Path

import numpy as np

from examples.idm import IDM, idm_acceleration

THIRD_CALL = 3


class Lying(float):
    """A number that says it is within any limits."""

    def __le__(self, other):
        return True

    __lt__ = __ge__ = __gt__ = __le__


class UnprintableError(Exception):
    def __str__(self):
        raise ValueError


class LyingError(Exception):
    __module__ = property(lambda _: 1)


def raises(error):
    raise error


def hangs(seconds=3600):
    time.sleep(seconds)


def hangs_and_swallows():
    while True:
        with suppress(Exception):
            hangs()


def hangs_for_good():
    """As compiled code that does not let go of the interpreter lock."""
    signal.pthread_sigmask(signal.SIG_BLOCK, [signal.SIGALRM])
    sum(range(10**15))


def computes_otherwise(word, bits):
    """Sets bits of ``fenv_t``: of the x87's control word, or of MXCSR."""
    libm, modes = ctypes.CDLL("libm.so.6"), (ctypes.c_uint32 * 16)()
    libm.fegetenv(modes)
    modes[word] = modes[word] ^ bits
    return 0.0 * libm.fesetenv(modes)


def rounds_up_and_raises():
    computes_otherwise(7, 0x4000)
    raises(ZeroDivisionError("no such thing"))


FAULTS = {
    "rounds_down": lambda: 0.0 * ctypes.CDLL("libm.so.6").fesetround(0x400),
    "rounds_up_and_raises": rounds_up_and_raises,
    "flushes_to_zero": lambda: computes_otherwise(7, 0x8040),
    "asks_another_traci": lambda: __import__("traci").vehicle.getSpeed("AV"),
    "none": lambda: None,
    "nan": lambda: math.nan,
    "masked": lambda: np.ma.masked,
    "time": lambda: np.timedelta64(1, "ns"),
    "raises_what_lies": lambda: raises(LyingError("so")),
    "boolean": lambda: True,
    "impossible": lambda: -99.0,
    "lies": lambda: Lying(-1e6),
    "raises": lambda: raises(ZeroDivisionError("no such thing")),
    "raises_what_cannot_be_printed": lambda: raises(UnprintableError()),
    "raises_what_is_no_utf_8": lambda: raises(FileNotFoundError("no file \udce9.csv")),
    "exits": lambda: sys.exit(5),
    "interrupts": lambda: raises(KeyboardInterrupt()),
    "hangs": hangs,
    "hangs_and_swallows": hangs_and_swallows,
    "hangs_for_good": hangs_for_good,
    "closes_descriptors": lambda: os.closerange(3, 200) or 0.0,
    "ends_the_process": lambda: os._exit(7),
    "crashes": lambda: os.kill(os.getpid(), signal.SIGSEGV),
    "is_killed": lambda: os.kill(os.getpid(), signal.SIGKILL),
}


class Misbehaving(IDM):
    """``bad`` maps an episode to its fault, in its third step or ``_in_start``; a file remembers what is done once."""

    def __init__(self, bad, once=None):
        super().__init__()
        self.bad, self.once = bad, once

    def start(self, episode):
        self.fault, _, in_start = self.bad.get(str(episode.episode), "").partition("_in_")
        self.calls = 0
        if in_start:
            FAULTS[self.fault]()

    def step(self, seen):
        self.calls += seen.bv_overlaps  # not while it is shown what was before
        if self.fault and self.calls == THIRD_CALL and not (self.once and Path(self.once).exists()):
            if self.once:
                Path(self.once).touch()
            return FAULTS[self.fault]()
        return super().step(seen)


class StartsPrograms(IDM):
    """One in a session of its own, and one that is left to whoever adopts it."""

    def __init__(self, note):
        super().__init__()
        daemon = f"sleep 600 & echo $! >> {note}"
        subprocess.Popen(["sh", "-c", daemon])
        started = subprocess.Popen(["sleep", "600"], start_new_session=True)
        with Path(note).open("a") as file:
            file.write(f"{started.pid}\n")


class Always(IDM):
    """Commits its fault in every step, or in the constructor."""

    def __init__(self, where, how="ends_the_process"):
        super().__init__()
        if where == "constructor":
            FAULTS[how]()
        self.step = lambda _: FAULTS[how]()


def only_a_function(seen, min_acceleration_mps2):
    return idm_acceleration(seen.speed_mps, seen.lead_speed_mps, seen.gap_m, min_acceleration_mps2)


class OnlyStep:
    def step(self, seen):
        return only_a_function(seen, -4.0)


class RaisesForOtherNames(OnlyStep):
    def __getattr__(self, name):
        raise RuntimeError(name)


class OnlyStepBatch:
    def step_batch(self, seen):
        columns = zip(seen.speed_mps, seen.lead_speed_mps, seen.gap_m, strict=True)
        return [idm_acceleration(*map(float, row)) for row in columns]


class EndsAtTheStart(OnlyStepBatch):
    def start_batch(self, cells, episodes, random):
        os._exit(7)


class CallsSumo(IDM):
    def __init__(self, call):
        super().__init__()
        self.call = call

    def step(self, seen):
        eval(self.call, {"libsumo": __import__("libsumo")})
        return super().step(seen)


def says_nothing():
    Path("called").touch()


class Prints(IDM):
    def __init__(self):
        super().__init__()
        self.prints("made")

    def start(self, episode):
        self.prints("started")

    def prints(self, what):
        print(f"{what}, in Python")  # noqa: T201 - what it is for
        os.write(1, f"{what}, below Python\n".encode())


class PrintsMuch(IDM):
    def step(self, seen):
        print(f"{seen.time_s:.1f} s {1000 * 'x'}")  # noqa: T201 - what it is for
        return super().step(seen)


class Global(IDM):
    """Draws from a stream of its own."""

    def step(self, seen):
        return super().step(seen) - 1e-9 * random.random()


class Tires(IDM):
    """Answers otherwise once its class has driven 150 tests."""

    n_driven = 0

    def start(self, episode):
        Tires.n_driven += 1

    def step(self, seen):
        return super().step(seen) - 1e-9 * (Tires.n_driven > 150)


class Stops(IDM):
    """Stops its process in one test."""

    def start(self, episode):
        super().start(episode)
        if episode.episode == 7:
            os.kill(os.getpid(), signal.SIGSTOP)


class Replaces(IDM):
    """Puts nothing in place of a module, or of what it or a class of it holds; of the judge one that ends no test."""

    def __init__(self, what, at):
        super().__init__()
        (self.module, _, self.name), self.at = what.rpartition("."), at
        self.replace("constructor")

    def replace(self, at):
        if at == self.at and self.module:
            setattr(pkgutil.resolve_name(self.module), self.name, (lambda *_: 0) if self.name == "judge" else None)
        elif at == self.at:
            sys.modules[self.name] = None

    def step(self, seen):
        self.replace("step" if seen.bv_overlaps else "warm-up")
        return super().step(seen)


class KeepsOpen(IDM):
    """Closes no file, of which its process may open few."""

    def __init__(self):
        super().__init__()
        resource.setrlimit(resource.RLIMIT_NOFILE, (200, resource.getrlimit(resource.RLIMIT_NOFILE)[1]))
        self.files = []

    def step(self, seen):
        with suppress(OSError):
            self.files.append(Path(os.devnull).open())  # noqa: SIM115 - what it is for
        return super().step(seen)


class Learned(IDM):
    """Has weights, which take long to load."""

    made = []

    @staticmethod
    def load(note, episodes=3):
        with Path(note).open("a") as file:
            file.write(f"loaded {episodes}\n")
        return object()

    def __init__(self, loaded, braking):
        super().__init__()
        self.loaded, self.braking = loaded, braking
        braking.append(0.01)
        self.made.append(self)


class LoadsByItself(IDM):
    def load(self): ...

    def __init__(self, loaded): ...


class ChangesItsProcess(IDM):
    def __init__(self):
        super().__init__()
        socket.setdefaulttimeout(0.001)
        signal.signal(signal.SIGCHLD, signal.SIG_IGN)


class Batch:
    """Over arrays: NaN for one episode, once an array of the wrong kind, or it writes into what it is handed."""

    def __init__(self, nan=-1, wrong_shape=False, wrong_type="", overwrites=""):
        self.nan, self.wrong_shape, self.wrong_type, self.overwrites = nan, wrong_shape, wrong_type, overwrites

    def start_batch(self, cells, episodes, random):
        for name, handed in (("cells", cells), ("episodes", episodes)):
            if name == self.overwrites:
                handed[:] = 0

    def step_batch(self, seen):
        if self.overwrites in seen._fields:
            getattr(seen, self.overwrites)[:] = 0
        if self.wrong_shape and seen.bv_overlaps.all():
            self.wrong_shape = False
            return np.zeros((seen.episode.size, 2))
        if self.wrong_type and seen.bv_overlaps.all():
            wrong_type, self.wrong_type = self.wrong_type, ""
            return np.zeros(seen.episode.size).astype(wrong_type)
        return np.where(seen.episode == self.nan, np.nan, 0.0)

    def close(self): ...


class StepMisspelt:
    def stp(self, seen):
        return 0.0


an_object = StepMisspelt()


class StepOfProperty:
    step = property(lambda _: lambda seen: 0.0)


class StartOfNothing:
    """Whose start takes no episode."""

    def start(self): ...

    def step(self, _seen):
        return 0.0


class StepOfNothing:
    """Whose step takes no observation."""

    def step(self):
        return 0.0


class Moody(IDM):
    """Fails in some tests, sleeps in others, and never does the same twice."""

    def start(self, episode):
        self.mood = episode.episode % 4

    def step(self, seen):
        if self.mood == 1 and seen.gap_m < 30.0:
            raise RuntimeError("no")
        return 3.0 if self.mood == 2 else super().step(seen) - random.random()
