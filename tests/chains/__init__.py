"""Estimators on the exact Markov chains of `harness.studies.chains`."""
