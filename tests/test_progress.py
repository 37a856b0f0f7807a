"""Progress: what a terminal shows, and how the time left is reckoned."""

import io
import re
import threading
import time

import pytest
from hypothesis import given
from hypothesis import strategies as st

from harness.progress import LineProgress, RichProgress, ShownProgress, episodes_left, shown_progress


class Terminal(io.StringIO):
    def isatty(self):
        return True


@pytest.mark.parametrize(
    ("figures", "left"),
    [
        ({}, 9_000),
        ({"rhw": 0.2, "target_rhw": 0.1, "crashes": 50}, 3_000),
        ({"rhw": 0.2, "target_rhw": 0.1, "crashes": 50, "min_crashes": 300}, 5_000),
        ({"rhw": 0.2, "target_rhw": 0.1, "crashes": 50, "heaviest": 0.5}, 4_000),
        ({"rhw": 0.2, "target_rhw": 0.1, "crashes": 50, "heaviest": float("inf")}, 9_000),
        ({"rhw": 0.2, "target_rhw": 0.01, "crashes": 50}, 9_000),
        ({"rhw": 0.1, "target_rhw": 0.2, "crashes": 50}, 0),
        ({"rhw": 0.2, "target_rhw": 0.1, "crashes": 0}, 9_000),
        ({"rhw": float("inf"), "target_rhw": 0.1, "crashes": 1}, 9_000),
    ],
)
def test_episodes_left(figures, left):
    assert episodes_left(1_000, 10_000, **figures) == left


@given(
    done=st.integers(0, 10**10),
    total=st.integers(1, 10**10),
    rhw=st.none() | st.floats(0, allow_nan=False),
    crashes=st.none() | st.integers(0, 10**9),
)
def test_episodes_left_stays_within_the_budget(done, total, rhw, crashes):
    left = episodes_left(done, total, rhw=rhw, target_rhw=0.05, crashes=crashes, min_crashes=3_000)
    assert 0 <= left <= max(total - done, 0)


def test_bar_shows_rate_figures_and_time_left_on_a_narrow_terminal(monkeypatch):
    monkeypatch.setenv("COLUMNS", "80")
    stream = Terminal()
    with RichProgress(0.05, 3_000, stream) as bar:
        bar.stage("criticality tables", total=3)
        bar.advance(3)
        bar.stage("episodes", total=400_000)
        bar.advance(5_000)
        bar.status(crashes=1_234, rhw=0.0812)
    last_line = stream.getvalue().splitlines()[-2]
    for text in ("episodes", " 38%", "/s · crashes 1,234 · RHW 0.081 · 0:0", " left"):
        assert text in last_line
    assert "criticality" not in last_line


def last_share(stream):
    return re.findall(r"(\d+)%", stream.getvalue())[-1]


@pytest.mark.parametrize(
    ("watched", "share"),
    [("rhw", "100"), ("half_width", "5")],
    ids=["a campaign that stops on precision ends with all of its work", "else the share is that of the budget"],
)
def test_the_share_is_that_of_the_work_thought_necessary(watched, share):
    stream = Terminal()
    with RichProgress(0.05, 3_000, stream) as bar:
        bar.stage("episodes", total=200_000)
        bar.advance(5_000)
        bar.status(crashes=1_500, **{watched: 0.2})
        bar.advance(5_000)
        bar.status(crashes=3_280, **{watched: 0.036})
    assert last_share(stream) == share


def test_work_of_an_earlier_run_does_not_count_as_speed():
    stream = Terminal()
    with RichProgress(stream=stream) as bar:
        bar.stage("episodes", total=10_000, done=5_000)
        bar.status(crashes=3)
    assert "50%" in stream.getvalue()
    assert "/s" not in stream.getvalue()


def test_slow_tests_show_the_time_of_each_and_the_expected_end(monkeypatch):
    now_s = 100.0
    monkeypatch.setattr("time.monotonic", lambda: now_s)
    monkeypatch.setattr("time.time", lambda: 0.0)
    monkeypatch.setattr("time.localtime", time.gmtime)
    log = LineProgress(stream=Log())
    log.stage("episodes", total=1_600)
    now_s += 120.0
    log.advance(30)
    assert log.line().endswith("episodes: 30 of 1,600 · 4 s each · 1:44:40 left, until 01:44")
    now_s += 4_890.0
    assert log.line().endswith(" · 167 s each · 72:49:50 left, until Sun 00:49")
    log.advance(1_400)
    assert log.line().endswith(" · 3.5 s each · 9:56 left")


def test_figures_before_any_stage_are_no_error():
    stream = Terminal()
    with RichProgress(stream=stream) as bar:
        bar.advance(1)
        bar.status(crashes=1)
    assert "crashes" not in stream.getvalue()


def test_a_bar_only_on_a_terminal(monkeypatch):
    monkeypatch.setattr("sys.stderr", io.StringIO())
    assert isinstance(shown_progress(), LineProgress)
    assert type(shown_progress(quiet=True)) is ShownProgress
    monkeypatch.setattr("sys.stderr", Terminal())
    assert isinstance(shown_progress(), RichProgress)


class Log(io.StringIO):
    """Tells when a line has come."""

    def __init__(self):
        super().__init__()
        self.came = threading.Event()

    def flush(self):
        self.came.set()


def test_a_log_gets_a_line_now_and_then_while_a_shard_is_under_way():
    log = Log()
    with LineProgress(0.05, 3_000, log, interval_s=1e-3) as lines:
        lines.stage("episodes", total=400_000)
        lines.advance(5_000)
        lines.status(crashes=1_234, rhw=0.0812)
        assert log.came.wait(60)
    text = r"\d\d:\d\d:\d\d episodes: 5,000 of 13,187 · [\d,]+/s · crashes 1,234 · RHW 0.081 · 0:\d\d left"
    assert re.fullmatch(text, lines.line())
    assert re.match(r"\d\d:\d\d:\d\d ", log.getvalue())


def test_a_log_gets_no_line_of_what_is_quickly_done():
    log = Log()
    with LineProgress(stream=log) as lines:
        lines.stage("episodes", total=10)
        lines.advance(10)
    assert log.getvalue() == ""


def test_a_stage_of_unknown_length_is_named():
    lines = LineProgress()
    lines.stage("estimates and report", None)
    assert lines.line().endswith(" estimates and report")


def test_a_precision_that_is_not_known_is_not_shown_as_one(monkeypatch):
    monkeypatch.setenv("COLUMNS", "120")
    stream = Terminal()
    with RichProgress(stream=stream) as bar:
        bar.stage("episodes", total=10)
        bar.status(half_width=float("inf"), rhw=0.25)
    assert "half width unknown · RHW 0.25" in stream.getvalue()
