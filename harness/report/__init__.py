"""The report: what a run or comparison says, in words and rows; one self-contained HTML page of it, with plots as SVG.

All is made from a finished folder alone, so it can be made again at any time and on any machine. ``summary`` reads;
``notes``, ``rows``, ``words`` and ``several`` say it, ``junit`` for a gate; ``plots`` and ``crashes`` draw, ``page``
puts all together by ``templates``; ``player`` plays a test, ``motion`` and ``openscenario`` write one.
"""
