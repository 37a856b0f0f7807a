"""Crash rates from blocks of weighted tests: estimators, intervals, diagnostics, stopping.

Estimators have one shape (``estimate.Accumulator``): add blocks, ask for the result. ``one_pass`` feeds them all.
"""
