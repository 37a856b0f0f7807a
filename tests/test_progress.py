"""Progress: what a terminal and a log show, and how the time left is reckoned."""

from __future__ import annotations

import io
import math
import re
import threading
from unittest.mock import Mock

import pytest

from harness import numbers as n
from harness.progress import Progress, ShownProgress, shown_progress
from harness.resolved import resolve
from harness.sampling.shells import Shells
from tests.stored_runs import golden


class Terminal(io.StringIO):
    def isatty(self):
        return True


class Log(io.StringIO):
    """Tells when a line has come."""

    def __init__(self):
        super().__init__()
        self.came = threading.Event()

    def flush(self):
        self.came.set()


def test_a_narrow_terminal_shows_rate_figures_and_time_left(monkeypatch):
    monkeypatch.setenv("COLUMNS", "80")
    stream = Terminal()
    with ShownProgress(stream) as bar:
        bar.advance(1)  # before any stage it is no error
        bar.stage("criticality tables", total=3)
        bar.advance(3)
        bar.stage("episodes", total=None)
        bar.status(crashes=3, rhw=96.0)
        bar.advance(10)
        assert not {"left", "RHW"} & set(stream.getvalue().splitlines()[-1].split())
        bar.status(crashes=1_234, rhw=0.0812)
        bar.advance(4_990)
    last_line = stream.getvalue().splitlines()[-2]
    for text in ("episodes", "/s · crashes 1,234 · RHW 0.081"):
        assert text in last_line
    assert "criticality" not in last_line


def test_a_pool_of_its_own_says_why_it_is_built(monkeypatch):
    told = []
    progress = Mock(stage=lambda name, *_: told.append(name + progress.remark), remark="")
    monkeypatch.setattr("harness.sampling.shells.Shells._draw_from", lambda *_: None)
    monkeypatch.setattr("harness.sampling.shells.campaign_pool", lambda _, bar: bar.stage("pool of cut-ins", 9))
    Shells(resolve(golden("shells-twin", "crash.counts_above_mps=2")), progress)
    assert told == ["pool of cut-ins (one of its own, once: only impacts above 2 m/s are crashes)"]
    assert progress.remark == ""


def test_work_of_an_earlier_run_is_not_its_speed():
    bar = ShownProgress(io.StringIO())
    bar.stage("episodes", total=200_000, done=5_000)
    assert "/s" not in next(bar.lines())


def test_a_log_gets_a_line_now_and_then_and_none_of_what_is_quickly_done(monkeypatch):
    log = Log()
    monkeypatch.setattr("sys.stderr", log)
    assert type(shown_progress(quiet=True)) is Progress
    assert isinstance(shown_progress(), ShownProgress)
    with ShownProgress(interval_s=1e-3) as lines:
        lines.stage("episodes", total=13_187)
        lines.advance(5_000)
        lines.status(crashes=1_234, rhw=0.0812)
        assert log.came.wait(60)
        lines._interval_s = 60.0
    text = r"\d\d:\d\d:\d\d episodes: 5,000 of 13,187 · [\d,]+/s · crashes 1,234 · RHW 0.081 · 0.\d s left"
    assert re.fullmatch(text, next(lines.lines()))
    assert re.match(r"\d\d:\d\d:\d\d ", log.getvalue())
    lines.stage("writing estimates and report", None)  # at once: it may be a while until the next line
    assert log.getvalue().endswith("writing estimates and report\n")
    quick = Log()
    with ShownProgress(stream=quick) as lines:
        lines.stage("episodes", total=10)
        lines.advance(10)
    assert quick.getvalue() == ""


# -- how numbers are written --


@pytest.mark.parametrize(
    ("written", "text"),
    [
        (n.number(1.2345e-7), "1.23 × 10⁻⁷"),
        (n.number(0.0), "0"),
        (n.number(-2.5), "−2.50"),
        (n.number(None), "–"),
        (n.number(math.inf), "∞"),
        (n.number(1.2e-7, 2, exponent=-8), "12"),
        (n.number(1.2e-7, exponent=-7, like=4e-9), "1.2000"),
        (n.interval(9.67e-8, 1.11e-7), "(0.97 to 1.11) × 10⁻⁷"),
        (n.interval(9.67e-8, 1.11e-7, 1.04e-7), "1.04 (0.97 to 1.11) × 10⁻⁷"),
        (n.interval(1e-10, 2e-7), "1.00 × 10⁻¹⁰ to 2.00 × 10⁻⁷"),  # in one power of ten the lower end would be 0.00
        (n.interval(0.0, 5.8e-8, 0.0), "0 (0.00 to 5.80) × 10⁻⁸"),
        (n.interval(None, 1.0), "– to 1.00"),
        (n.share(0.0), "0 %"),
        (n.share(1e-7), "1.0 × 10⁻⁵ %"),
        (n.share(1e-7, least=1e-3), "< 0.1 %"),
        (n.half_width(842.79), "> 10"),
        (n.half_width(None), "–"),
        (n.duration(200.0), "3 min 20 s"),
        (n.duration(3720.0), "1 h 02 min"),
        (n.size(999), "999 B"),
        (n.size(1_500_000), "1.5 MB"),
        (n.tenths(-10.71), "−10.7"),
        (n.words([1.0, True, None], 4), "1.000, yes, –"),
    ],
)
def test_numbers_are_written_with_few_digits_and_never_more_than_there_are(written, text):
    assert written == text
