"""Run campaigns: shards over worker processes, stopping, resuming, replaying."""
