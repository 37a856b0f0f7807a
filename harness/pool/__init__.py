"""Pool and shells: all events of the environment with their probabilities, ordered by who crashes on them.

Built once per environment and surrogate library, in the twin: initial states, paths, their event times with exact
probabilities, and the outcome of every surrogate on each. The probability of a shell is known, so that crashes of the
AV counted within shells add up to its rate.

A shell is defined in `shells`: `shells_of` and `cells_of`, and `shells_in_strata` for the strata made of them. Others
that have to change with it: `build.pool_of`, which sorts events into shells, and `harness.strata`, which is all that
estimators and allocation know of them.
"""
