"""Batches of logs, each run in its own process."""
