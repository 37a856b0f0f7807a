"""The report: one self-contained HTML page per run, and its plots as PNG and SVG.

The page is made from a finished run folder alone, so it can be made again at any time and on any machine. Its parts:
``run_folder`` reads, ``summary`` streams over the episodes, each ``*_plot`` module draws one family of plots,
``tables`` writes what is told in rows, ``page`` puts them together.
"""

from harness.report.page import write_report

__all__ = ["write_report"]
