"""Estimators on the exact Markov chains of `studies.chains`."""
