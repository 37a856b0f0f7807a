"""Tests of the challenge tables against direct simulation."""
