"""Pool and shells: all events of the environment with their probabilities, ordered by who crashes on them.

Built once per environment and surrogate library, in the twin: initial states, paths, their event times with exact
probabilities, and the outcome of every surrogate on each. The probability of a shell is known, so that crashes of the
AV counted within shells add up to its rate.

What a shell is says `shells`: `shells_of` and `cells_of`, and `shells_in_strata` for the strata made of them. A change
goes through `build.pool_of` as well, which asks for it, and `harness.strata`, which tells estimators and allocation
what strata there are: these know nothing else of a shell.
"""
