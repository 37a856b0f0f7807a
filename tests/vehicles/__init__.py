"""Tests of the driver models and of motion within a step."""
