"""Tests of the estimators: identities, references that are solved otherwise, and what users read."""
