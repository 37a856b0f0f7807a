"""Cut-ins: BV, ahead of the AV on the left lane, comes over in front of it.

LV drives ahead of BV. Naturalistic traffic says how the five numbers of the beginning are distributed, how LV and BV
accelerate, and how probable a cut-in is in each step: `laws`. `path` walks their motion, `events` lists the cut-ins on
it, `script` makes motion of one. `nade` is a method of its own, which draws the cut-in in the loop.
"""
