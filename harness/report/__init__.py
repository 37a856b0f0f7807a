"""The report: one self-contained HTML page per run or comparison, and its plots as SVG.

The page is made from a finished run folder alone, so it can be made again at any time and on any machine. ``summary``
reads, ``rate_plots``, ``test_plots`` and ``crashes`` draw (in one ``style``), ``page`` puts all together;
``pairs_map`` and ``compare_page`` do so of a comparison, ``player`` plays a test, ``openscenario`` writes one.
"""
