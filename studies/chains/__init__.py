"""Exact Markov chains behind the same interface as SUMO's records.

A chain is an overtaking in miniature: a background vehicle closes in state by state, may cut in, may brake after it,
and an automated vehicle with noise escapes or crashes. Everything is a small table, so crash probabilities, importance
functions and moments of weights are known by backward induction or by enumeration of all paths.
"""
