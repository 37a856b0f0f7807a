"""Tests of whole episodes in the twin: weights, paths, crash rates."""
