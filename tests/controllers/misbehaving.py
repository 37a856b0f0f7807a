"""Controllers that are the built-in IDM until an episode in which they go wrong, in each in its own way."""

import os
import random
import signal
import subprocess
import sys
import time
from contextlib import suppress
from pathlib import Path

import numpy as np

from examples.idm import IDM

THIRD_CALL = 3


class Array(np.ndarray):
    """An array that can be compared with a word."""

    def __ne__(self, other):
        return True


class Lying(float):
    """A number that says it is within any limits."""

    def __le__(self, other):
        return True

    __lt__ = __ge__ = __gt__ = __le__


class UnprintableError(Exception):
    def __str__(self):
        raise ValueError


ANSWERS = {
    "none": None,
    "nan": float("nan"),
    "inf": float("inf"),
    "string": "fast",
    "boolean": True,
    "shape": np.zeros(2).view(Array),
    "impossible": -99.0,
    "lies": Lying(-1e6),
}


class Misbehaving(IDM):
    """``bad`` maps an episode to what is done in its third step, or in its start if the name says so."""

    def __init__(self, bad, path=None):
        super().__init__()
        self.bad = bad
        self.path = path
        self.calls = 0

    def start(self, episode):
        self.fault, self.calls = self.bad.get(str(episode.episode)), 0
        if self.fault is not None and self.fault.endswith("_in_start"):
            getattr(self, self.fault)()

    def step(self, observation):
        self.calls += observation.bv_overlaps  # not while it is shown what was before
        if self.fault is not None and self.calls == THIRD_CALL and not self.fault.endswith("_in_start"):
            answer = ANSWERS[self.fault] if self.fault in ANSWERS else getattr(self, self.fault)()
            if answer != "drive on":
                return answer
        return super().step(observation)

    def raises(self):
        raise ZeroDivisionError("no such thing")

    def raises_what_cannot_be_printed(self):
        raise UnprintableError

    def raises_what_is_no_utf_8(self):
        raise FileNotFoundError("no file \udce9.csv")

    def exits(self):
        sys.exit(5)

    def hangs(self):
        time.sleep(3600)

    hangs_in_start = hangs

    def hangs_and_swallows(self):
        while True:
            with suppress(Exception):
                time.sleep(3600)

    def hangs_for_good(self):
        signal.pthread_sigmask(signal.SIG_BLOCK, [signal.SIGALRM])
        time.sleep(3600)

    def interrupts(self):
        raise KeyboardInterrupt

    def generator_exit(self):
        raise GeneratorExit

    def copies_the_process(self):
        os.fork()
        return 0.0

    def copies_the_process_for_good(self):
        if os.fork() == 0:
            time.sleep(3600)
        return 0.0

    def copies_and_ends_the_process(self):
        """What is left of it keeps the worker's pipe open."""
        if os.fork() == 0:
            time.sleep(3600)
        os._exit(7)

    def closes_descriptors(self):
        os.closerange(3, 200)
        return 0.0

    def ends_the_process(self):
        os._exit(7)

    ends_the_process_in_start = ends_the_process

    def crashes(self):
        os.kill(os.getpid(), signal.SIGSEGV)

    def is_killed(self):
        os.kill(os.getpid(), signal.SIGKILL)

    def is_killed_once(self):
        """By an operator, say; a file remembers."""
        try:
            Path(self.path).touch(exist_ok=False)
            os.kill(os.getpid(), signal.SIGKILL)
        except FileExistsError:
            pass
        return "drive on"


class RaisesWhenMade(IDM):
    def __init__(self):
        raise RuntimeError("no licence")


class HangsWhenMade(IDM):
    """The n-th one that is made in a process, and all later ones."""

    n_made = 0

    def __init__(self, first=1, swallows=False):
        super().__init__()
        HangsWhenMade.n_made += 1
        while HangsWhenMade.n_made >= first:
            if swallows:
                signal.pthread_sigmask(signal.SIG_BLOCK, [signal.SIGALRM])
            time.sleep(3600)


class StartsPrograms(IDM):
    """In sessions of their own; one is left to whoever adopts it."""

    def __init__(self, note):
        super().__init__()
        daemon = f"sleep 600 & echo $! >> {note}"
        apart = [["sleep", "600"], ["sh", "-c", daemon]]
        started = [subprocess.Popen(words, start_new_session=True) for words in apart]
        with Path(note).open("a") as file:
            file.write(f"{started[0].pid}\n")


class EndsTheProcess(IDM):
    """In every call of one name."""

    end = staticmethod(lambda: os._exit(7))

    def __init__(self, where):
        super().__init__()
        for name in ("start", "step", "start_batch", "step_batch", "close"):
            if name == where:
                setattr(self, name, lambda *_: self.end())
            elif name.endswith("batch") and where.endswith("batch"):
                setattr(self, name, lambda *_: None)
        if where == "constructor":
            self.end()


class ClosesDescriptors(EndsTheProcess):
    """In every call of one name."""

    end = staticmethod(lambda: os.closerange(3, 200))


def idm_of_a_function() -> IDM:
    return IDM()


def says_nothing():
    Path("called").touch()


class Prints(IDM):
    def __init__(self):
        super().__init__()
        print("made, in Python")  # noqa: T201 - what it is for
        os.write(1, b"made, below Python\n")

    def start(self, episode):
        print("started, in Python")  # noqa: T201 - what it is for
        os.write(1, b"started, below Python\n")


class Global(IDM):
    """Draws from a stream of its own."""

    def step(self, observation):
        return super().step(observation) - 1e-9 * random.random()


class ChangesItsParameters(IDM):
    made = []

    def __init__(self, braking):
        super().__init__()
        braking.append(0.01)
        self.made.append(braking)


class RaisesInClose(IDM):
    def __init__(self, path):
        super().__init__()
        self.path = Path(path)

    def close(self):
        with self.path.open("a") as file:
            file.write("closed\n")
        raise RuntimeError("cannot be closed")


class Batch:
    """A batch controller that returns NaN for one episode, and once an array of the wrong shape."""

    def __init__(self, nan=-1, wrong_shape=False):
        self.nan = nan
        self.wrong_shape = wrong_shape

    def start_batch(self, cells, episodes, random):
        pass

    def step_batch(self, observation):
        answer = np.where(observation.episode == self.nan, np.nan, 0.0)
        if self.wrong_shape and observation.bv_overlaps.all():
            self.wrong_shape = False
            return np.zeros((answer.size, 2))
        return answer

    def close(self):
        pass


class BatchThatWrites(Batch):
    """Brakes harder the higher the speed, and then writes into what it was handed."""

    def __init__(self, field):
        super().__init__()
        self.field = field

    def start_batch(self, cells, episodes, random):
        if self.field in ("cells", "episodes"):
            {"cells": cells, "episodes": episodes}[self.field][:] = 0

    def step_batch(self, observation):
        answer = -0.1 * observation.speed_mps
        if self.field in observation._fields:
            getattr(observation, self.field)[:] = 0
        return answer
