"""Tests: shared pieces are imported as ``tests....``, so that no folder here hides a package beside it."""
