"""Tests of the naturalistic environment against scipy, numpy and the formulas written out again."""
