"""Controllers that are the built-in IDM until an episode in which they go wrong, in each in its own way."""

import os
import signal
import sys
import time
from contextlib import suppress
from pathlib import Path

import numpy as np

from examples.idm import IDM

THIRD_CALL = 3


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
        self.calls += 1
        if self.fault is not None and self.calls == THIRD_CALL and not self.fault.endswith("_in_start"):
            answer = getattr(self, self.fault)()
            if answer != "drive on":
                return answer
        return super().step(observation)

    def raises(self):
        raise ZeroDivisionError("no such thing")

    def none(self):
        return None

    def nan(self):
        return float("nan")

    def inf(self):
        return float("inf")

    def string(self):
        return "fast"

    def boolean(self):
        return True

    def shape(self):
        return Array([0.0, 0.0])

    def impossible(self):
        return -99.0

    def exits(self):
        sys.exit(5)

    def hangs(self):
        time.sleep(3600)

    def hangs_in_start(self):
        time.sleep(3600)

    def hangs_and_swallows(self):
        while True:
            with suppress(Exception):
                time.sleep(3600)

    def hangs_for_good(self):
        signal.pthread_sigmask(signal.SIG_BLOCK, [signal.SIGALRM])
        time.sleep(3600)

    def ends_the_process(self):
        os._exit(7)

    def ends_the_process_in_start(self):
        os._exit(7)

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


class Array(np.ndarray):
    """An array that can be compared with a word."""

    def __new__(cls, values):
        return np.asarray(values).view(cls)

    def __ne__(self, other):
        return True


class RaisesWhenMade(IDM):
    def __init__(self):
        raise RuntimeError("no licence")


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
        observation.cell[:] = 0  # its own copy
        if self.wrong_shape:
            self.wrong_shape = False
            return np.zeros((answer.size, 2))
        return answer

    def close(self):
        pass
