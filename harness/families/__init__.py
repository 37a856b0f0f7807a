"""Kinds of events that tests are made of, one package each; `protocol` says what a family brings."""
