"""The commands, one file per thing that a user is busy with; `harness.cli` puts them together."""
