"""Tests of the importance functions: identities at recorded and at arbitrary states."""
