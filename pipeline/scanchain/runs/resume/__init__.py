"""Checkpoints of a run, and resuming it after it was stopped."""
