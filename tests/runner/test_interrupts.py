"""Ctrl-C ends a run even where Python swallows its exception."""

from __future__ import annotations

import os
import signal

import pytest

from harness.runner.interrupts import remembered_interrupt


class InterruptedWhileItIsFinalised:
    def __del__(self) -> None:
        os.kill(os.getpid(), signal.SIGINT)
        for _ in range(1000):  # the handler runs between two of these
            pass


@pytest.mark.filterwarnings("ignore::pytest.PytestUnraisableExceptionWarning")
def test_an_interrupt_that_python_swallows_is_remembered():
    with remembered_interrupt() as check:
        check()
        thing = InterruptedWhileItIsFinalised()
        del thing  # prints "Exception ignored in", and goes on
        with pytest.raises(KeyboardInterrupt):
            check()


def test_an_interrupt_elsewhere_is_raised_at_once_and_the_handler_is_put_back():
    before = signal.getsignal(signal.SIGINT)
    with pytest.raises(KeyboardInterrupt), remembered_interrupt():
        os.kill(os.getpid(), signal.SIGINT)
    assert signal.getsignal(signal.SIGINT) is before
