"""Progress: what a terminal and a log show, and how the time left is reckoned."""

from __future__ import annotations

import io
import math
import re
import threading

import click
import pytest

from harness import numbers as n
from harness.commands.options import progress_bar
from harness.progress import Progress, ShownProgress


class Log(io.StringIO):
    """Tells when a line has come."""

    def __init__(self):
        super().__init__()
        self.came = threading.Event()

    def flush(self):
        self.came.set()


def test_a_log_gets_a_line_now_and_then_and_none_of_what_is_quickly_done(monkeypatch):
    log = Log()
    monkeypatch.setattr("sys.stderr", log)
    for quiet, kind in ((True, Progress), (False, ShownProgress)):
        with click.Context(click.Command("run")) as context:
            context.meta["quiet"] = quiet
            assert type(progress_bar()) is kind
    with ShownProgress(interval_s=1e-3) as lines:
        lines.stage("episodes", total=13_187)
        lines.advance(5_000, crashes=5)
        lines.advance(0, crashes=7)
        lines.status(rhw=0.0812, asked=0.05)
        assert log.came.wait(60)
        lines._interval_s = 60.0
    text = r"\d\d:\d\d:\d\d episodes: 5,000 of 13,187 · [\d,]+/s · crashes 12 · ± 8.1 % · asked ± 5.0 % · 0.\d s left"
    assert re.fullmatch(text, next(lines.lines()))
    assert re.match(r"\d\d:\d\d:\d\d ", log.getvalue())
    lines.stage("writing estimates and report", None)  # at once: it may be a while until the next line
    assert log.getvalue().endswith("writing estimates and report\n")
    lines.stage("writing estimates and report", None)  # of another scenario
    assert log.getvalue().count("writing estimates and report\n") == 1
    quick = Log()
    with ShownProgress(stream=quick) as lines:
        lines.stage("episodes", total=10)
        lines.advance(10)
        assert quick.getvalue() == ""
        lines.stage("tests", None, done=1_184)
    assert quick.getvalue().endswith("tests (1,184 kept): 1,184\n")


@pytest.mark.parametrize(
    ("written", "text"),
    [
        (n.number(1.2345e-7), "1.23 × 10⁻⁷"),
        (n.number(-2.5), "−2.50"),
        (n.number(None), "–"),
        (n.number(math.inf), "∞"),
        (n.number(1.2e-7, exponent=-7, like=4e-9), "1.2000"),
        (n.interval(9.67e-8, 1.11e-7), "(0.97 to 1.11) × 10⁻⁷"),
        (n.interval(9.67e-8, 1.11e-7, 1.04e-7), "1.04 (0.97 to 1.11) × 10⁻⁷"),
        (n.interval(9.67e-9, 1.44e-7, beside=1.22e-8), "(0.97 to 14.4) × 10⁻⁸"),
        (n.interval(0.0, 6.641e-6, beside=2.45e-9), "(0.00 to 6.64) × 10⁻⁶"),
        (n.interval(1e-10, 2e-7), "1.00 × 10⁻¹⁰ to 2.00 × 10⁻⁷"),  # in one power of ten the lower end would be 0.00
        (n.share(1e-7, least=1e-3), "< 0.1 %"),
        (n.half_width(842.79), "> 10"),
        (n.duration(3720.0), "1 h 02 min"),
    ],
)
def test_numbers_are_written_with_few_digits_and_never_more_than_there_are(written, text):
    assert written == text
