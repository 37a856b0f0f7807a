"""The report: one self-contained HTML page per run, and its plots as PNG and SVG.

The page is made from a finished run folder alone, so it can be made again at any time and on any machine. ``summary``
reads, ``rate_plots``, ``test_plots`` and ``crashes`` draw (in one ``style``), ``page`` puts all together.
"""
